"""Scores: the mean absolute error of the pressure, its safety gate, and the normalised score.

The normalised score says how much of what is attainable a controller misses:
0 is the best that any commands attain in a cell, everything known; 100 is the best PID of the lung
in that cell. The first step of an inspiration is left out: no command can change its pressure.
"""

from __future__ import annotations

from typing import Any

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


def passes_safety_gate(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> Bools:
    """Whether inspirations pass the protocol's safety gate.

    The limit is ``min(60, pip + 15)`` cmH2O. A run of n samples above it lasts ``n dt``; longer
    than 0.1 s (4 samples at 30 ms) fails.

    Pressure is that at the airway, cmH2O, ``(..., T)``; ``pip``, cmH2O, and the time between
    samples ``dt``, s, have shape ``(...)`` or broadcast against it. False if a pressure is NaN.
    """
    pressure, pip = np.asarray(pressure, float), np.asarray(pip, float)[..., None]
    # "Not below" instead of "above", so that NaN is unsafe.
    above = longest_run(~(pressure <= safety_limit(pip)))
    # 1e-9: a run of exactly 0.1 s passes despite rounding.
    gate = above * np.asarray(dt, float) <= protocol.SAFETY_TIME + 1e-9
    return gate & ~np.any(np.isnan(pressure), axis=-1)


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
