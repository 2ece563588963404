"""Breaths as smoothed signals: pressure, volume, flow, and their derivatives.

The same window smooths all signals, which preserves the linear relations between them: the
derivative of a smoothed volume is the smoothed flow, whatever the window. Missing samples and
readings that are clipped at an end of the sensor's range are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]

#: Half the width of the window, s.
WINDOW = 0.04

#: Fewest smoothed samples of a segment.
FEWEST_SAMPLES = 12

#: Number of successive samples at the highest or lowest reading that count as clipped.
_CLIPPED_RUN = 3


@dataclass(frozen=True, eq=False)
class Segment:
    """A breath, or a part of it over which the volume is known, as n smoothed samples.

    Attributes:
        breath: index of the breath.
        first: whether the segment begins where the breath does.
        begins: True at the first sample after a gap, bool ``(n,)``.
        time: time from the start of the breath, s, ``(n,)``.
        pressure: cmH2O, ``(n,)``.
        volume: volume from the start of the segment, L, ``(n,)``.
        flow: L/s, ``(n,)``.
        slope: derivative of the flow, L/s2, ``(n,)``.
        dose: integral of the pressure from the start of the segment, cmH2O s, ``(n,)``.
        rise: derivative of the pressure, cmH2O/s, ``(n,)``.
        bend: second derivative of the pressure, cmH2O/s2, ``(n,)``.
    """

    breath: int
    first: bool
    begins: NDArray[np.bool_]
    time: Floats
    pressure: Floats
    volume: Floats
    flow: Floats
    slope: Floats
    dose: Floats
    rise: Floats
    bend: Floats

    def __len__(self) -> int:
        """Number of samples n."""
        return len(self.time)


def segments(breaths: Breaths) -> tuple[Segment, ...]:
    """Smooth breaths; where only flow is measured, split them where it is missing.

    Without measured flow, the derivative of volume takes its place; without measured volume, the
    integral of flow, which is zero at the start of each segment.

    Raises:
        InputError: if neither flow nor volume is recorded.
    """
    if breaths.flow is None and breaths.volume is None:
        raise InputError(
            "the recording has neither flow nor volume; without them mechanics cannot be told from "
            "the valve"
        )
    flow = None if breaths.flow is None else _unclipped(breaths.flow / 1000.0)
    volume = None if breaths.volume is None else breaths.volume / 1000.0
    pressure = _unclipped(breaths.pressure)
    smoothed = []
    for i in range(len(breaths)):
        end = int(breaths.valid[i].sum())
        parts = [(0, end)]
        if volume is None:
            assert flow is not None
            parts = _runs(np.isfinite(flow[i, :end]))
        for start, stop in parts:
            part = slice(start, stop)
            signals = _smoothed(
                breaths.time[i, part], pressure[i, part],
                None if flow is None else flow[i, part],
                None if volume is None else volume[i, part],
            )  # fmt: skip
            if signals is not None:
                smoothed.append(Segment(i, start == 0, *signals))
    return tuple(smoothed)


def clipped_share(breaths: Breaths) -> float:
    """Share of the pressures that are clipped at an end of the sensor's range, 0..1."""
    known = np.isfinite(breaths.pressure) & breaths.valid
    return float(np.sum(_clipped(breaths.pressure) & known) / max(known.sum(), 1))


def _smoothed(
    time: Floats, pressure: Floats, flow: Floats | None, volume: Floats | None
) -> tuple[NDArray[np.bool_], *tuple[Floats, ...]] | None:
    """Fields of a segment from ``begins`` on; None if the segment would be too short."""
    if len(time) < 3:
        return None
    half = max(1, round(WINDOW / float(np.median(np.diff(time)))))
    filled = _volume(time, flow, volume)
    known = np.isfinite(pressure) & np.isfinite(filled)
    known &= True if flow is None else np.isfinite(flow)
    centres, begins = _centres(known, half)
    if len(centres) < FEWEST_SAMPLES:
        return None
    value, change = window_weights(time, half, centres)
    filled = filled - filled[np.isfinite(filled)][0]
    at = np.isfinite(pressure)
    unbroken = np.interp(time, time[at], pressure[at])
    dose = integrate(time, unbroken)
    signals = np.stack([time, pressure, filled, dose])
    near = np.lib.stride_tricks.sliding_window_view(signals, 2 * half + 1, axis=1)[
        :, centres - half
    ]
    t, p, v, dose = np.einsum("kcw,cw->kc", near, value)
    rise = weighted_sum(near[1], change)
    bend = weighted_sum(windows(differentiate(time, unbroken, half), half)[centres - half], change)
    if flow is None:
        flow = differentiate(time, filled, half)
        q = flow[centres]
    else:
        q = weighted_sum(windows(flow, half)[centres - half], value)
    slope = weighted_sum(windows(flow, half)[centres - half], change)
    return begins, t, p, v, q, slope, dose, rise, bend


def _volume(time: Floats, flow: Floats | None, volume: Floats | None) -> Floats:
    if volume is not None:
        return volume
    assert flow is not None
    return integrate(time, flow)


def _centres(known: NDArray[np.bool_], half: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Centres of windows of known samples, half a window apart, and which of them follow a gap."""
    runs = [np.arange(start + half, stop - half, half + 1) for start, stop in _runs(known)]
    runs = [run for run in runs if len(run)]
    if not runs:
        return np.zeros(0, np.intp), np.zeros(0, bool)
    begins = np.concatenate([np.arange(len(run)) == 0 for run in runs])
    return np.concatenate(runs), begins


def _runs(known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Starts and ends of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _unclipped(values: Floats) -> Floats:
    """The readings, NaN where they are clipped."""
    return np.where(_clipped(values), np.nan, values)


def _clipped(values: Floats) -> NDArray[np.bool_]:
    """Samples in runs at the highest or the lowest of all readings, bool ``(n, T)``."""
    out = np.zeros(values.shape, bool)
    if not np.isfinite(values).any():
        return out
    for end in (np.nanmax(values), np.nanmin(values)):
        for row, at_end in enumerate(values == end):
            for start, stop in _runs(at_end):
                out[row, start:stop] = stop - start >= _CLIPPED_RUN
    return out


def window_weights(time: Floats, half: int, centres: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Weights of a smoothed value and of a smoothed derivative, each ``(c, 2 half + 1)``.

    Hann's window and its derivative at the true times, corrected to be exact for straight lines.
    """
    near = windows(time, half)[centres - half]
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


def differentiate(time: Floats, values: Floats, half: int) -> Floats:
    """Smoothed derivative of every sample; near the ends, that of the nearest complete window."""
    fine = np.arange(half, len(time) - half)
    slope = np.full(len(time), np.nan)
    slope[fine] = weighted_sum(windows(values, half), window_weights(time, half, fine)[1])
    known = np.flatnonzero(np.isfinite(slope))
    nearest = np.clip(np.searchsorted(known, np.arange(len(time))), 0, max(len(known) - 1, 0))
    return slope[known[nearest]] if len(known) else slope


def windows(values: Floats, half: int) -> Floats:
    """Return the windows of ``2 half + 1`` samples, the first of them around sample ``half``."""
    return np.lib.stride_tricks.sliding_window_view(values, 2 * half + 1)


def weighted_sum(near: Floats, weights: Floats) -> Floats:
    """Weighted sum of each window, ``(c,)``."""
    return np.einsum("cw,cw->c", near, weights)


def integrate(time: Floats, values: Floats) -> Floats:
    """Integral from the first sample to each one, by the trapezoidal rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(time)
    return np.concatenate([[0.0], np.cumsum(steps)])
