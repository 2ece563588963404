"""A window that smooths and differentiates, at unevenly spaced times too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def weights(time: Floats, half: int, centres: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Weights of a smoothed value and of a smoothed derivative, each ``(c, 2 half + 1)``.

    Hann's window and its derivative at the true times, then made exact for straight lines.
    """
    near = view(time, half)[centres - half]
    away = near - time[centres][:, None]
    width = (half + 1) * float(np.median(np.diff(time)))
    angle = np.clip(0.5 * np.pi * away / width, -0.5 * np.pi, 0.5 * np.pi)
    span = np.gradient(near, axis=1)
    value = span * np.cos(angle) ** 2
    value /= value.sum(axis=1, keepdims=True)
    change = span * np.sin(2.0 * angle)
    change -= value * change.sum(axis=1, keepdims=True)
    change /= np.sum(change * away, axis=1, keepdims=True)
    return value, change


def differentiated(time: Floats, volume: Floats, half: int) -> Floats:
    """Flow at every sample; where the window does not fit, that of the nearest sample."""
    fine = np.arange(half, len(time) - half)
    flow = np.full(len(time), np.nan)
    flow[fine] = dot(view(volume, half), weights(time, half, fine)[1])
    known = np.flatnonzero(np.isfinite(flow))
    nearest = np.clip(np.searchsorted(known, np.arange(len(time))), 0, max(len(known) - 1, 0))
    return flow[known[nearest]] if len(known) else flow


def view(values: Floats, half: int) -> Floats:
    """Windows of ``2 half + 1`` samples, the first one around sample ``half``."""
    return np.lib.stride_tricks.sliding_window_view(values, 2 * half + 1)


def dot(near: Floats, weights: Floats) -> Floats:
    """Weighted sum of each window."""
    return np.einsum("cw,cw->c", near, weights)


def integral(time: Floats, values: Floats) -> Floats:
    """From the first sample, by trapezoids."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(time)
    return np.concatenate([[0.0], np.cumsum(steps)])
