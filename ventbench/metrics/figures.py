"""Secondary figures of scored inspirations: one line adds a figure to scores and to its tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ventbench.metrics import effort, safety, step_response

Floats = NDArray[np.float64]


class InspirationSignals(NamedTuple):
    """Inspirations of T steps, and what was asked of them; ``(...)`` is any batch shape.

    Attributes:
        pressure: true airway pressure at each step, cmH2O, shape ``(..., T)``.
        u_in: inspiratory valve as applied, %, shape ``(..., T)``.
        requested: what the controller asked for, %, shape ``(..., T)``.
        peep: cmH2O, shape ``(...)`` or broadcast against it.
        pip: cmH2O, shape ``(...)`` or broadcast against it.
        dt: control step, s, shape ``(...)`` or broadcast against it.
    """

    pressure: Floats
    u_in: Floats
    requested: Floats
    peep: Floats
    pip: Floats
    dt: Floats


#: Takes inspirations and returns a figure of each, shape ``(...)``; NaN where it does not exist.
Figure = Callable[[InspirationSignals], Floats]

#: By the name that a score's JSON has, with the unit at its end.
FIGURES: dict[str, Figure] = {
    "rise_time_s": lambda s: step_response.rise_time(s.pressure, s.peep, s.pip, s.dt),
    "overshoot_cmH2O": lambda s: step_response.overshoot(s.pressure, s.pip),
    "overshoot_percent": lambda s: step_response.overshoot_percent(s.pressure, s.peep, s.pip),
    "settling_time_s": lambda s: step_response.settling_time(s.pressure, s.peep, s.pip, s.dt),
    "steady_error_cmH2O": lambda s: step_response.steady_error(s.pressure, s.pip),
    "swings": lambda s: step_response.swings(s.pressure, s.pip),
    "ripple_cmH2O": lambda s: step_response.ripple(s.pressure),
    "time_above_alarm_s": lambda s: safety.time_above_alarm(s.pressure, s.pip, s.dt),
    "mean_u_in_percent": lambda s: effort.mean_command(s.u_in),
    "mean_change_percent_per_step": lambda s: effort.mean_change(s.u_in),
    "clipped_share": lambda s: effort.clipped_share(s.requested),
}


def figures(signals: InspirationSignals) -> dict[str, Floats]:
    """All figures of inspirations, by name, each of shape ``(...)``."""
    return {name: figure(signals) for name, figure in FIGURES.items()}
