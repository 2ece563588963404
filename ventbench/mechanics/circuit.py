"""How much gas the tubing swallows between the flow sensor and the lung.

Where a compliant circuit lies between them, the lung's flow is that of the sensor less the
circuit's compliance times the rise of the pressure. It acts inside of every other term, so that it
is found first, on a grid, and the flow and volume are corrected for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ventbench.mechanics.lung_match import Estimate
from ventbench.mechanics.regression import GRID, Table, log_likelihood, solve, table
from ventbench.mechanics.segments import Segment
from ventbench.mechanics.select import FEWEST, GATE, splits
from ventbench.mechanics.terms import BASE, columns_of
from ventbench.system_id.intervals import quantile

#: Compliances that are tried, mL/cmH2O.
_GRID = tuple(float(x) for x in np.arange(0.0, 4.01, 0.25))

#: Least that is believed, mL/cmH2O.
_LEAST = 0.1


@dataclass(frozen=True)
class Circuit:
    """What was found of the circuit.

    Attributes:
        compliance: mL/cmH2O.
        nats: held-out evidence.
        effect: what it alone explains, root mean square, cmH2O.
    """

    compliance: Estimate
    nats: float
    effect: float


def circuit(pieces: Sequence[Segment]) -> Circuit | None:
    """Find the compliance of the circuit, or None if the breaths do not need it."""
    columns = (*range(len(BASE)), *columns_of("turbulent_resistance"))
    tables = [table([behind(s, c) for s in pieces], columns) for c in _GRID]
    null, count = tables[0], len(tables[0])
    if count < FEWEST:
        return None
    ratios = []
    for train in splits(count):
        best = max(tables, key=lambda one: _value(one, train))
        found = solve(best, train, range(len(columns)))
        known = solve(null, ~train, range(len(columns)))
        gain = log_likelihood(best, found) - log_likelihood(null, known)
        ratios.append(float(gain[~train].sum()))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    every = np.ones(count, bool)
    value = _peak(tables, every)
    if nats <= GATE or value < _LEAST:
        return None
    without = [_peak(tables, np.arange(count) != i) for i in range(count)]
    sd = float(np.sqrt((count - 1) * np.var(without)))
    reach = quantile(max(count - 1, 4)) * max(sd, 0.02)
    ends = (max(value - reach, 0.0), value + reach)
    nearest = tables[round(value / (_GRID[1] - _GRID[0]))]
    squares = [_square(one, every) for one in (null, nearest)]
    effect = float(np.sqrt(max(squares[0] - squares[1], 0.0)))
    return Circuit(Estimate(value, "mL/cmH2O", ends), nats, effect)


def behind(segment: Segment, compliance: float) -> Segment:
    """What flows on into the lung, behind a circuit of some mL/cmH2O."""
    if compliance == 0.0:
        return segment
    c = compliance / 1000.0
    return replace(
        segment,
        flow=segment.flow - c * segment.rise,
        slope=segment.slope - c * segment.bend,
        volume=segment.volume - c * (segment.pressure - segment.pressure[0]),
    )


def _value(one: Table, which: np.ndarray) -> float:
    found = solve(one, which, range(one.products.shape[-1] - 1))
    return float(log_likelihood(one, found)[which].sum())


def _square(one: Table, which: np.ndarray) -> float:
    """Mean square of what is left, autocorrelation included, cmH2O2."""
    found = solve(one, which, range(one.products.shape[-1] - 1))
    return found.sigma**2 / (1.0 - GRID[found.grid] ** 2)


def _peak(tables: Sequence[Table], which: np.ndarray) -> float:
    """Where the likelihood is largest, by a parabola through the best of the grid."""
    values = np.array([_value(one, which) for one in tables])
    k = int(np.argmax(values))
    if k in (0, len(values) - 1):
        return _GRID[k]
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return _GRID[k] + float(np.clip(shift, -0.5, 0.5)) * (_GRID[1] - _GRID[0])
