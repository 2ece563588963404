"""The score of the protocol, a mean absolute error of the pressure, and its safety gate."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench import protocol


def run_error(pressure: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """Error of one run of three breaths: mean of ``|p - p*|`` over scored inspiratory steps.

    Args:
        pressure: true airway pressure at each inspiratory step, cmH2O, shape
            ``(..., BREATHS, INSPIRATION_STEPS)``.
        target: target pressure, cmH2O, broadcast against ``pressure``.

    Returns:
        Mean over breaths 2 and 3, cmH2O, shape ``(...)``; NaN if a scored pressure is NaN.

    Raises:
        ValueError: if the last two axes are not those of a run.
    """
    pressure = np.asarray(pressure, float)
    expected = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    if pressure.shape[-2:] != expected:
        raise ValueError(f"inspirations of shape {pressure.shape} do not end in {expected}")
    error = np.abs(pressure - np.asarray(target, float))
    return np.mean(error[..., protocol.SCORED_BREATHS, :], axis=(-2, -1))


def lung_score(errors: ArrayLike) -> NDArray[np.float64]:
    """Score on each lung: mean of :func:`run_error` over PIPs.

    Args:
        errors: cmH2O, shape ``(..., P)``.

    Returns:
        cmH2O, shape ``(...)``; NaN if one of the errors is.
    """
    return np.mean(np.asarray(errors, float), axis=-1)


def longest_run(flags: ArrayLike) -> NDArray[np.int64]:
    """Length of the longest run of true values along the last axis.

    Args:
        flags: boolean, shape ``(..., T)``.

    Returns:
        Shape ``(...)``.
    """
    flags = np.asarray(flags, bool)
    steps = np.arange(1, flags.shape[-1] + 1)
    last_false = np.maximum.accumulate(np.where(flags, 0, steps), axis=-1)
    return np.max(steps - last_false, axis=-1, initial=0)


def safety_limit(pip: ArrayLike) -> NDArray[np.float64]:
    """Pressure that the safety gate allows, cmH2O, of any shape: ``min(60, pip + 15)``."""
    return np.minimum(protocol.SAFETY_PRESSURE, np.asarray(pip, float) + protocol.SAFETY_MARGIN)


def passes_safety_gate(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> NDArray[np.bool_]:
    """Whether inspirations pass the protocol's safety gate.

    The limit is ``min(60, pip + 15)`` cmH2O. A run of n samples above it lasts ``n dt``; longer
    than 0.1 s (4 samples at 30 ms) fails.

    Args:
        pressure: true airway pressure, cmH2O, shape ``(..., T)``.
        pip: cmH2O, shape ``(...)`` or broadcast against it.
        dt: time between samples, s, shape ``(...)`` or broadcast against it.

    Returns:
        Shape ``(...)``; false if a pressure is NaN.
    """
    pressure, pip = np.asarray(pressure, float), np.asarray(pip, float)[..., None]
    # "Not below" instead of "above", so that NaN is unsafe.
    above = longest_run(~(pressure <= safety_limit(pip)))
    # 1e-9: a run of exactly 0.1 s passes despite rounding.
    gate = above * np.asarray(dt, float) <= protocol.SAFETY_TIME + 1e-9
    return gate & ~np.any(np.isnan(pressure), axis=-1)
