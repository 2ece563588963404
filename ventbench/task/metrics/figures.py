"""Secondary figures of scored inspirations: one line adds a figure to scores and to its tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats
from ventbench.task import protocol
from ventbench.task.metrics import step_response

#: The PVP's high-pressure alarm: this share above PIP.
ALARM_SHARE = 0.15


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


def mean_command(u_in: ArrayLike) -> Floats:
    """Mean of the applied command over an inspiration, %.

    Args:
        u_in: commands as applied, %, shape ``(..., T)``.

    Returns:
        Shape ``(...)``; NaN if a command is.
    """
    return np.mean(np.asarray(u_in, float), axis=-1)


def mean_change(u_in: ArrayLike) -> Floats:
    """Wear of the valve: mean over steps of ``|u_t - u_(t-1)|``, % a step.

    The valve is closed before the first command, so that ``u_(-1) = 0``.

    Args:
        u_in: commands as applied, %, shape ``(..., T)``.

    Returns:
        Shape ``(...)``; NaN if a command is.
    """
    return np.mean(np.abs(np.diff(np.asarray(u_in, float), axis=-1, prepend=0.0)), axis=-1)


def clipped_share(requested: ArrayLike) -> Floats:
    """Share of commands outside the valve's range of 0 to 100 %, which were clipped, 0..1.

    Args:
        requested: what the controller asked for, %, shape ``(..., T)``.

    Returns:
        Shape ``(...)``; NaN if a command is.
    """
    requested = np.asarray(requested, float)
    outside = (requested < 0.0) | (requested > protocol.U_MAX)
    return np.where(np.any(np.isnan(requested), axis=-1), np.nan, np.mean(outside, axis=-1))


def time_above_alarm(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Floats:
    """Time above PIP + 15 %, s: number of samples above ``1.15 pip`` times ``dt``.

    Args:
        pressure: true airway pressure, cmH2O, shape ``(..., T)``.
        pip: cmH2O, shape ``(...)`` or broadcast against it.
        dt: time between samples, s, shape ``(...)`` or broadcast against it.

    Returns:
        Shape ``(...)``; NaN if a pressure is.
    """
    pressure, pip = np.asarray(pressure, float), np.asarray(pip, float)[..., None]
    above = np.sum(pressure > (1.0 + ALARM_SHARE) * pip, axis=-1)
    time = above * np.asarray(dt, float)
    return np.where(np.any(np.isnan(pressure), axis=-1), np.nan, time)


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
    "time_above_alarm_s": lambda s: time_above_alarm(s.pressure, s.pip, s.dt),
    "mean_u_in_percent": lambda s: mean_command(s.u_in),
    "mean_change_percent_per_step": lambda s: mean_change(s.u_in),
    "clipped_share": lambda s: clipped_share(s.requested),
}


def figures(signals: InspirationSignals) -> dict[str, Floats]:
    """All figures of inspirations, by name, each of shape ``(...)``."""
    return {name: figure(signals) for name, figure in FIGURES.items()}
