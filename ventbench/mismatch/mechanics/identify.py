"""Mechanics of a lung from pressure with flow or volume, whatever the ventilator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.lungs import Lung
from ventbench.mismatch.mechanics import labels
from ventbench.mismatch.mechanics.regression import (
    GRID,
    Solution,
    Table,
    covariance,
    effect,
    solve,
    table,
)
from ventbench.mismatch.mechanics.segments import Segment, segments
from ventbench.mismatch.mechanics.select import Chosen, select
from ventbench.mismatch.mechanics.terms import BASE, COLUMNS
from ventbench.mismatch.result import Estimate, LungMatch
from ventbench.physics.fits.intervals import quantile
from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """What a lung needs beyond R and C.

    Attributes:
        name: of the effect.
        parameters: by short name.
        nats: held-out evidence, natural logarithm of a likelihood ratio.
        effect: what it alone explains, root mean square, cmH2O.
        alternatives: names that would do nearly as well.
    """

    name: str
    parameters: dict[str, Estimate]
    nats: float
    effect: float
    alternatives: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Mechanics:
    """A lung, as pressure and flow show it.

    Attributes:
        label: of the recording.
        R: resistance at small flow, inspiratory, cmH2O s/L.
        C: compliance over the tidal volume, mL/cmH2O.
        offset: pressure at the start of a breath if nothing flowed, cmH2O.
        terms: what is needed beyond R and C, the most important first.
        match: with R at the flow for which its label holds.
        settings: known settings that this lung may be, the nearest first.
        noise: standard deviation of what is left, cmH2O.
        breaths: that were used.
        samples: smoothed ones.
        notes: what the reader should know.
    """

    label: str
    R: Estimate
    C: Estimate
    offset: Estimate
    terms: tuple[Term, ...]
    match: LungMatch
    settings: tuple[Lung, ...]
    noise: float
    breaths: int
    samples: int
    notes: tuple[str, ...]


def identify(breaths: Breaths) -> tuple[Mechanics, ...]:
    """Identify each lung of a recording with flow or volume.

    Raises:
        InputError: if there is neither, or too little of a lung to tell R from C.
    """
    return tuple(_one(name, part) for name, part in breaths.by_lung().items())


def _one(name: str, breaths: Breaths) -> Mechanics:
    pieces = segments(breaths)
    if not pieces:
        raise InputError(
            f"{name}: no piece of a breath has pressure with flow or volume for about a second; "
            "record longer pieces"
        )
    known = table(pieces)
    chosen = select(known)
    columns = (*range(len(BASE)), *(item.column for item in chosen))
    found = solve(known, np.ones(len(known), bool), columns)
    lung = _Fitted(found, covariance(known, found), known, pieces, _blur(breaths))
    label = Lung(float(breaths.R[0]), float(breaths.C[0]))
    C = lung.compliance()
    source = "pressure and flow" if breaths.flow is not None else "pressure and volume"
    return Mechanics(
        name, lung.resistance(0.0), C, lung.offset(), tuple(lung.term(item) for item in chosen),
        labels.match(label, lung.resistance, C, source), labels.matching(lung.resistance, C),
        float(found.sigma / np.sqrt(1.0 - GRID[found.grid] ** 2)), len(known),
        sum(len(piece) for piece in pieces), tuple(_notes(breaths, pieces, known)),
    )  # fmt: skip


def _blur(breaths: Breaths) -> float:
    """Uncertainty of the integral of a flow that may jump between two samples, s."""
    return 0.0 if breaths.volume is not None else 0.25 * float(np.median(breaths.dt))


def _notes(breaths: Breaths, pieces: tuple[Segment, ...], known: Table) -> list[str]:
    notes = []
    if len(known) < 4:
        notes.append("Fewer than 4 breaths: R and C alone, nothing else could be tested.")
    if lost := len(breaths) - len(known):
        notes.append(f"{lost} of {len(breaths)} breaths have no piece long enough to be used.")
    top = max(float(piece.flow.max()) for piece in pieces)
    if top < 0.2:
        notes.append(f"The flow stays below {1000 * top:.0f} mL/s: R is known at small flow only.")
    return notes


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Coefficients with covariance, and what follows from them."""

    solution: Solution
    covariance: Floats
    table: Table
    pieces: tuple[Segment, ...]
    blur: float

    def resistance(self, flow: float) -> Estimate:
        """During inspiration, at half of the volume that is inspired."""
        half = 0.5 * self._tidal()

        def value(x: Callable[[str], float]) -> float:
            bent = x("turbulent_resistance") * flow
            return x("resistance") + bent + x("volume_resistance") * half

        found = self._derived(value, "cmH2O s/L")
        more = self.blur * self._x("elastance")
        reach = np.hypot(0.5 * (found.ci95[1] - found.ci95[0]), more)
        return Estimate(found.value, found.unit, (found.value - reach, found.value + reach))

    def compliance(self) -> Estimate:
        """From the start of a breath to the whole of what is inspired."""
        tidal = self._tidal()
        stiff = self._derived(lambda x: x("elastance") + x("nonlinear_compliance") * tidal, "")
        low, high = (max(end, 1e-3) for end in stiff.ci95)
        return Estimate(1000.0 / stiff.value, "mL/cmH2O", (1000.0 / high, 1000.0 / low))

    def offset(self) -> Estimate:
        """Mean over the breaths that are there from their start."""
        values = []
        for piece in (p for p in self.pieces if p.first):
            rows = np.stack([COLUMNS[c].values(piece) for c in self.solution.columns], axis=1)
            left = piece.pressure - rows @ self.solution.x
            values.append(float(np.polyval(np.polyfit(piece.time, left, 1), 0.0)))
        if not values:
            return Estimate(float("nan"), "cmH2O", (float("nan"), float("nan")))
        mean, count = float(np.mean(values)), len(values)
        spread = float(np.std(values, ddof=1)) / np.sqrt(count) if count > 1 else np.inf
        reach = quantile(max(count - 1, 4)) * spread
        return Estimate(mean, "cmH2O", (mean - reach, mean + reach))

    def term(self, item: Chosen) -> Term:
        """Parameters of an effect, in the units of the library where it has it."""
        name = item.name
        if name == "inertance" and self._x(name) < 0.0:
            name = "sensor_lag"
        others = item.alternatives + (("flow_sensor_lag",) if name == "inertance" else ())
        size = effect(self.table, self.solution, item.column)
        return Term(name, self._parameters(name, item.column), item.nats, size, others)

    def _parameters(self, name: str, column: int) -> dict[str, Estimate]:
        simple = {
            "turbulent_resistance": ("quadratic", "cmH2O s2/L2"),
            "inertance": ("inertance", "cmH2O s2/L"),
            "direction_resistance": ("difference", "cmH2O s/L"),
            "volume_resistance": ("slope", "cmH2O s/L2"),
            "expiratory_flow": ("quadratic", "cmH2O s2/L2"),
        }
        if name in simple:
            short, unit = simple[name]
            return {short: self._derived(lambda x: x(name), unit)}
        if name == "nonlinear_compliance":
            made = self._derived(lambda x: 2.0 * x(name) / x("elastance") ** 2, "1/cmH2O")
            return {"stiffening": made}
        if name == "leak":
            made = self._derived(lambda x: 1000.0 * x(name) / x("elastance"), "mL/s per cmH2O")
            return {"conductance": made}
        if name == "sensor_lag":
            return {"tau": self._derived(lambda x: -x("inertance") / x("resistance"), "s")}
        time = COLUMNS[column].time
        assert time is not None
        near = [t for t in _times() if t != time]
        low = max((t for t in near if t < time), default=time)
        high = min((t for t in near if t > time), default=time)
        return {
            "ratio": self._derived(lambda x: x(name) / x("elastance"), "1"),
            "time": Estimate(time, "s", (low, high)),
        }

    def _derived(self, value: Callable[[Callable[[str], float]], float], unit: str) -> Estimate:
        """A function of the coefficients, with its interval by linear propagation."""
        x = self.solution.x

        def at(point: Floats) -> float:
            named = {
                COLUMNS[c].term: float(v) for c, v in zip(self.solution.columns, point, strict=True)
            }
            return float(value(lambda name: named.get(name, 0.0)))

        step = 1e-4 * np.maximum(np.abs(x), 1e-6)
        slopes = [
            (at(x + h * unit_) - at(x - h * unit_)) / (2.0 * h)
            for h, unit_ in zip(step, np.eye(len(x)), strict=True)
        ]
        sd = float(np.sqrt(max(np.array(slopes) @ self.covariance @ np.array(slopes), 0.0)))
        reach, centre = quantile(max(len(self.table) - 1, 4)) * sd, at(x)
        return Estimate(centre, unit, (centre - reach, centre + reach))

    def _x(self, term: str) -> float:
        names = [COLUMNS[c].term for c in self.solution.columns]
        return float(self.solution.x[names.index(term)]) if term in names else 0.0

    def _tidal(self) -> float:
        """Volume between start and fullest, median over the breaths, L."""
        return float(np.median([np.ptp(piece.volume) for piece in self.pieces]))


def _times() -> tuple[float, ...]:
    return tuple(sorted({c.time for c in COLUMNS if c.time is not None}))
