"""What pressure may depend on besides R and C, as columns of a regression."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.mechanics.segments import Segment

Floats = NDArray[np.float64]

#: Relaxation times that are tried, s.
TIMES = tuple(float(x) for x in np.geomspace(0.3, 3.0, 11))


@dataclass(frozen=True)
class Column:
    """One column; a term with several is tried with each of them.

    Attributes:
        term: name of the effect.
        values: of a segment, ``(n,)``.
        time: relaxation time, s, or None.
    """

    term: str
    values: Callable[[Segment], Floats]
    time: float | None = None


def _stress(time: float, settled: bool) -> Callable[[Segment], Floats]:
    """Volume that relaxes: dS/dt = Q - S / time, from rest or as if the same breath came before."""

    def values(segment: Segment) -> Floats:
        t, v = segment.time, segment.volume
        decay = np.exp(-np.diff(t) / time)
        # Within a step the flow is taken as steady: exact for S, given the change of volume.
        gain = (1.0 - decay) * time / np.diff(t) * np.diff(v)
        start = 0.0
        for _ in range(2 if settled else 1):
            out = np.zeros(len(t))
            out[0] = start
            for i in range(len(t) - 1):
                out[i + 1] = out[i] * decay[i] + gain[i]
            start = out[-1]
        return out

    return values


#: R and C, then what else there may be. Effects whose sign is known must have it.
BASE = (
    Column("resistance", lambda s: s.flow),
    Column("elastance", lambda s: s.volume),
)
COLUMNS = (
    *BASE,
    Column("turbulent_resistance", lambda s: s.flow * np.abs(s.flow)),
    Column("nonlinear_compliance", lambda s: s.volume**2),
    Column("inertance", lambda s: s.slope),
    Column("leak", lambda s: -s.dose),
    Column("direction_resistance", lambda s: np.minimum(s.flow, 0.0)),
    Column("volume_resistance", lambda s: s.flow * s.volume),
    Column("expiratory_flow", lambda s: np.minimum(s.flow, 0.0) * np.abs(s.flow)),
    *(
        Column("viscoelasticity", _stress(time, settled), time)
        for settled in (False, True)
        for time in TIMES
    ),
)

#: Effects in the order of the columns.
TERMS = tuple(dict.fromkeys(column.term for column in COLUMNS[len(BASE) :]))

#: Those whose coefficient can only be positive.
POSITIVE = ("turbulent_resistance", "viscoelasticity", "leak")


def columns_of(term: str) -> tuple[int, ...]:
    """Columns that a term may have, by index."""
    return tuple(i for i, column in enumerate(COLUMNS) if column.term == term)
