"""Scores: the mean absolute error of the pressure, its safety gate, and the normalised score.

The normalised score says how much of what is attainable a controller misses:
0 is the best that any commands attain in a cell, everything known; 100 is the best PID of the lung
in that cell. The first step of an inspiration is left out: no command can change its pressure.

Secondary figures are of single inspirations; one line of :data:`FIGURES` adds one to scores and to
its tests. In all of them ``pressure`` (cmH2O) has shape ``(..., T)``: one sample at each step, the
first at the start, ``dt`` s apart; commands, %, have the same. ``peep``, ``pip`` (cmH2O) and ``dt``
(s) have the shape ``(...)`` or broadcast against it; ``pip - peep`` is called the step. Results
have shape ``(...)``. A figure of an inspiration with a NaN pressure or command is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.task import protocol


def run_error(pressure: ArrayLike, target: ArrayLike) -> Floats:
    """Error of one run of three breaths: mean of ``|p - p*|`` over the steps of breaths 2 and 3.

    Args:
        pressure: true airway pressure at each inspiratory step, cmH2O, shape
            ``(..., BREATHS, INSPIRATION_STEPS)``; a NaN that is scored gives NaN.
        target: target pressure, cmH2O, broadcast against ``pressure``.

    Raises:
        ValueError: if the last two axes are not those of a run.
    """
    pressure = np.asarray(pressure, float)
    expected = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    if pressure.shape[-2:] != expected:
        raise ValueError(f"inspirations of shape {pressure.shape} do not end in {expected}")
    error = np.abs(pressure - np.asarray(target, float))
    return np.mean(error[..., protocol.SCORED_BREATHS, :], axis=(-2, -1))


def lung_score(errors: ArrayLike) -> Floats:
    """Score on each lung: mean of :func:`run_error` ``(..., P)`` over PIPs; NaN if one is."""
    return np.mean(np.asarray(errors, float), axis=-1)


def longest_run(flags: ArrayLike) -> Ints:
    """Length of the longest run of true values along the last axis of ``(..., T)``."""
    flags = np.asarray(flags, bool)
    steps = np.arange(1, flags.shape[-1] + 1)
    last_false = np.maximum.accumulate(np.where(flags, 0, steps), axis=-1)
    return np.max(steps - last_false, axis=-1, initial=0)


def safety_limit(pip: ArrayLike) -> Floats:
    """Pressure that the safety gate allows, cmH2O, of any shape: ``min(60, pip + 15)``."""
    return np.minimum(protocol.SAFETY_PRESSURE, np.asarray(pip, float) + protocol.SAFETY_MARGIN)


def time_above(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Floats:
    """Time above the limit in all, s: n samples of a breath last ``n dt``, whatever is between.

    Shapes as of :func:`passes_safety_gate`; a NaN is above.
    """
    # "Not below" instead of "above", so that NaN is unsafe.
    above = ~(np.asarray(pressure, float) <= safety_limit(_column(pip)))
    return np.sum(above, axis=-1) * np.asarray(dt, float)


def is_brief(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Bools:
    """Whether breaths are above ``min(60, pip + 15)`` for 0.1 s at most; shapes as of the gate."""
    # 1e-9: 0.1 s exactly passes despite rounding.
    brief: Bools = time_above(pressure, pip, dt) <= protocol.SAFETY_TIME + 1e-9
    return brief


def passes_safety_gate(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Bools:
    """Whether breaths pass the protocol's safety gate.

    No sample may be above 70 cmH2O; more than 0.1 s in all above ``min(60, pip + 15)`` (4 samples
    at 30 ms) fails.

    Pressure is that at the airway in a breath, or what was measured of it, cmH2O, ``(..., T)``;
    ``pip``, cmH2O, and the time between samples ``dt``, s, have shape ``(...)`` or broadcast
    against it. False if a pressure is NaN.
    """
    capped = np.all(np.asarray(pressure, float) <= protocol.SAFETY_CAP, axis=-1)
    return is_brief(pressure, pip, dt) & capped


#: Least distance between the best PID and the best attainable, cmH2O, by which errors are divided:
#: about one step of the sensor's converter (0.07) and half of its noise (0.20 to 0.25). Where the
#: PID is closer than that, a cell tells controllers apart no better.
LEAST_HEADROOM = 0.1


def controllable_error(pressure: ArrayLike, target: ArrayLike) -> Floats:
    """As :func:`run_error`, without the first step of each inspiration: over steps 2 to 34."""
    error = np.abs(np.asarray(pressure, float) - np.asarray(target, float))
    return np.mean(error[..., protocol.SCORED_BREATHS, 1:], axis=(-2, -1))


def normalised(error: ArrayLike, attainable: ArrayLike, pid: ArrayLike) -> Floats:
    """Normalised score, ``100 (error - attainable) / max(pid - attainable, LEAST_HEADROOM)``.

    Args:
        error: :func:`controllable_error` of the controller, cmH2O, shape ``(...)``.
        attainable: least error of any commands, cmH2O, shape ``(...)``.
        pid: error of the lung's best PID, cmH2O, shape ``(...)``.
    """
    error, attainable, pid = (np.asarray(x, float) for x in (error, attainable, pid))
    result: Any = 100.0 * (error - attainable) / np.maximum(pid - attainable, LEAST_HEADROOM)
    return result


#: Shares of the step between which the rise is timed.
RISE = (0.1, 0.9)

#: Settled within this share of the step, or within so many cmH2O if that is wider (twice the
#: sensor's noise: a smaller band would judge the sensor).
SETTLING_SHARE = 0.05
SETTLING_FLOOR = 0.5

#: Dead band of a swing around the target, cmH2O (the sensor's noise).
RINGING_BAND = 0.25

#: The end of an inspiration that counts as steady, steps (0.3 s).
STEADY_STEPS = 10


def _column(value: ArrayLike) -> Floats:
    return np.asarray(value, float)[..., None]


def _unless_nan(pressure: Floats, figure: ArrayLike) -> Floats:
    return np.where(np.any(np.isnan(pressure), axis=-1), np.nan, figure)


def _crossing(pressure: Floats, level: Floats) -> Floats:
    """Steps until the pressure first reaches a level, between samples by interpolation, or NaN."""
    above = pressure >= level[..., None]
    first = np.argmax(above, axis=-1)
    before = np.maximum(first - 1, 0)
    high = np.take_along_axis(pressure, first[..., None], -1)[..., 0]
    low = np.take_along_axis(pressure, before[..., None], -1)[..., 0]
    slope = np.where(first > 0, high - low, 1.0)
    steps = np.where(first > 0, before + (level - low) / slope, 0.0)
    return np.where(np.any(above, axis=-1), steps, np.nan)


def rise_time(pressure: ArrayLike, peep: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Floats:
    """Time from 10 % to 90 % of the step, s: first crossings, interpolated between samples.

    A level that the first sample already exceeds is crossed at time 0. NaN if 90 % is never
    reached.
    """
    pressure, peep, pip = np.asarray(pressure, float), np.asarray(peep, float), np.asarray(pip)
    levels = (np.broadcast_to(peep + share * (pip - peep), pressure.shape[:-1]) for share in RISE)
    start, end = (_crossing(pressure, level) for level in levels)
    return _unless_nan(pressure, (end - start) * np.asarray(dt, float))


def overshoot(pressure: ArrayLike, pip: ArrayLike) -> Floats:
    """Highest pressure above PIP, ``max(0, max p - pip)``, cmH2O."""
    pressure = np.asarray(pressure, float)
    return np.maximum(np.max(pressure, axis=-1) - np.asarray(pip, float), 0.0)


def overshoot_percent(pressure: ArrayLike, peep: ArrayLike, pip: ArrayLike) -> Floats:
    """:func:`overshoot` as a share of the step, %."""
    pip = np.asarray(pip, float)
    return 100.0 * overshoot(pressure, pip) / (pip - np.asarray(peep, float))


def settling_time(pressure: ArrayLike, peep: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Floats:
    """Time after which the pressure stays within the band around PIP, s.

    The band is ``max(5 % of the step, 0.5 cmH2O)`` to either side. The time is that of the first
    sample of the last stretch inside it, which lasts to the end of the inspiration; NaN if the last
    sample is outside.
    """
    pressure, pip = np.asarray(pressure, float), _column(pip)
    band = np.maximum(SETTLING_SHARE * (pip - _column(peep)), SETTLING_FLOOR)
    # 1e-9: a sample on the edge is inside despite rounding.
    outside = np.abs(pressure - pip) > band + 1e-9
    last_outside = pressure.shape[-1] - 1 - np.argmax(outside[..., ::-1], axis=-1)
    first_inside = np.where(np.any(outside, axis=-1), last_outside + 1, 0)
    steps = np.where(first_inside < pressure.shape[-1], first_inside, np.nan)
    return _unless_nan(pressure, steps * np.asarray(dt, float))


def steady_error(pressure: ArrayLike, pip: ArrayLike) -> Floats:
    """Absolute value of the mean error over the last 10 steps, ``|mean(p - pip)|``, cmH2O."""
    end = np.asarray(pressure, float)[..., -STEADY_STEPS:]
    return np.abs(np.mean(end, axis=-1) - np.asarray(pip, float))


def swings(pressure: ArrayLike, pip: ArrayLike) -> Floats:
    """Ringing: how often the error changes sign beyond a dead band of 0.25 cmH2O.

    The sign is that of the last sample outside the band, so that noise inside it counts nothing. 0
    for a monotone rise, 1 for a single overshoot that does not fall below the band again.
    """
    pressure = np.asarray(pressure, float)
    error = pressure - _column(pip)
    sign = np.where(np.abs(error) > RINGING_BAND, np.sign(error), 0.0)
    steps = np.arange(pressure.shape[-1])
    held = np.maximum.accumulate(np.where(sign != 0, steps, 0), axis=-1)
    sign = np.take_along_axis(sign, held, axis=-1)
    return _unless_nan(pressure, np.sum(sign[..., 1:] * sign[..., :-1] < 0, axis=-1))


def ripple(pressure: ArrayLike) -> Floats:
    """Ringing: peak-to-peak pressure over the last 10 steps, ``max p - min p``, cmH2O."""
    return np.ptp(np.asarray(pressure, float)[..., -STEADY_STEPS:], axis=-1)


#: The PVP's high-pressure alarm: this share above PIP.
ALARM_SHARE = 0.15


def mean_command(u_in: ArrayLike) -> Floats:
    """Mean of the applied command over an inspiration, %."""
    return np.mean(np.asarray(u_in, float), axis=-1)


def mean_change(u_in: ArrayLike) -> Floats:
    """Wear of the valve: mean over steps of ``|u_t - u_(t-1)|``, % a step.

    The valve is closed before the first command, so that ``u_(-1) = 0``.
    """
    return np.mean(np.abs(np.diff(np.asarray(u_in, float), axis=-1, prepend=0.0)), axis=-1)


def clipped_share(requested: ArrayLike) -> Floats:
    """Share of requested commands outside the valve's range of 0 to 100 %, 0..1."""
    requested = np.asarray(requested, float)
    outside = (requested < 0.0) | (requested > protocol.U_MAX)
    return _unless_nan(requested, np.mean(outside, axis=-1))


def time_above_alarm(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Floats:
    """Time above PIP + 15 %, s: number of samples above ``1.15 pip`` times ``dt``."""
    pressure = np.asarray(pressure, float)
    above = np.sum(pressure > (1.0 + ALARM_SHARE) * _column(pip), axis=-1)
    return _unless_nan(pressure, above * np.asarray(dt, float))


class InspirationSignals(NamedTuple):
    """Inspirations of T steps, and what was asked of them; shapes as of the module."""

    pressure: Floats  #: true airway pressure at each step, cmH2O.
    u_in: Floats  #: inspiratory valve as applied, %.
    requested: Floats  #: what the controller asked for, %.
    peep: Floats  #: cmH2O.
    pip: Floats  #: cmH2O.
    dt: Floats  #: control step, s.


#: Takes inspirations and returns a figure of each, shape ``(...)``; NaN where it does not exist.
Figure = Callable[[InspirationSignals], Floats]

#: By the name that a score's JSON has, with the unit at its end.
FIGURES: dict[str, Figure] = {
    "rise_time_s": lambda s: rise_time(s.pressure, s.peep, s.pip, s.dt),
    "overshoot_cmH2O": lambda s: overshoot(s.pressure, s.pip),
    "overshoot_percent": lambda s: overshoot_percent(s.pressure, s.peep, s.pip),
    "settling_time_s": lambda s: settling_time(s.pressure, s.peep, s.pip, s.dt),
    "steady_error_cmH2O": lambda s: steady_error(s.pressure, s.pip),
    "swings": lambda s: swings(s.pressure, s.pip),
    "ripple_cmH2O": lambda s: ripple(s.pressure),
    "time_above_alarm_s": lambda s: time_above_alarm(s.pressure, s.pip, s.dt),
    "mean_u_in_percent": lambda s: mean_command(s.u_in),
    "mean_change_percent_per_step": lambda s: mean_change(s.u_in),
    "clipped_share": lambda s: clipped_share(s.requested),
}


def figures(signals: InspirationSignals) -> dict[str, Floats]:
    """All figures of inspirations, by name, each of shape ``(...)``."""
    return {name: figure(signals) for name, figure in FIGURES.items()}
