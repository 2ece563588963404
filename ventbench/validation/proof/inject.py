"""Recordings as a slower sensor would have shown them. Shares no code with the physics library."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]


def slower_sensor(breaths: Breaths, tau: float) -> Breaths:
    """Pass the recorded pressures of each breath through ``tau dy/dt = p - y``.

    The noise in them is smoothed with them.

    Args:
        breaths: n recorded breaths.
        tau: time constant, s, positive.

    Returns:
        The same breaths with other pressures; they are no longer those of a file.
    """
    pressure = np.stack(
        [lagged(t, p, tau) for t, p in zip(breaths.time, breaths.pressure, strict=True)]
    )
    return replace(breaths, pressure=pressure, sha256=None)


def lagged(time: Floats, pressure: Floats, tau: float) -> Floats:
    """Answer of a first-order lag, at rest before the first sample, ``(T,)``.

    Exact for a pressure that is straight between its samples, at whatever times they are.

    Args:
        time: s, increasing, ``(T,)``.
        pressure: cmH2O, ``(T,)``; NaN where it is unknown, which stays so and is bridged.
        tau: time constant, s, positive.
    """
    known = np.flatnonzero(np.isfinite(pressure))
    shown = np.full(len(pressure), np.nan)
    if known.size == 0:
        return shown
    y = pressure[known[0]]
    shown[known[0]] = y
    for before, now in pairwise(known):
        h = time[now] - time[before]
        behind = tau * (pressure[now] - pressure[before]) / h  # that a ramp is followed at
        y = pressure[now] - behind + (y - pressure[before] + behind) * np.exp(-h / tau)
        shown[now] = y
    return shown
