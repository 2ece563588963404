"""Safety: time above the alarm limit, and the safety gate of the protocol."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench import protocol

#: The PVP's high-pressure alarm: this share above PIP.
ALARM_SHARE = 0.15


def time_above_alarm(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> NDArray[np.float64]:
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


def limit(pip: ArrayLike) -> NDArray[np.float64]:
    """Pressure that the safety gate allows, cmH2O, of any shape: ``min(60, pip + 15)``."""
    return np.minimum(protocol.SAFETY_PRESSURE, np.asarray(pip, float) + protocol.SAFETY_MARGIN)


def safe(pressure: ArrayLike, pip: ArrayLike, dt: ArrayLike) -> NDArray[np.bool_]:
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
    above = longest_run(~(pressure <= limit(pip)))
    # 1e-9: a run of exactly 0.1 s passes despite rounding.
    gate = above * np.asarray(dt, float) <= protocol.SAFETY_TIME + 1e-9
    return gate & ~np.any(np.isnan(pressure), axis=-1)
