"""Breaths as smoothed signals: pressure, volume, flow, and their derivatives.

The same window smooths all signals, which preserves the linear relations between them: the
derivative of a smoothed volume is the smoothed flow, whatever the window. Missing samples and
readings that are clipped at an end of the sensor's range are left out. A flow that is missing for a
moment is interpolated for the volume that it adds, if that is known well enough; else a breath is
split there, and each part has an offset of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from ventbench.base.arrays import Bools, Floats, Ints, runs
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths

#: Pressure at the compared samples; time, volume, flow, its slope, and dose.
_Signals: TypeAlias = tuple[Floats, Floats, Floats, Floats, Floats, Floats]

#: Half the width of the window, s.
WINDOW = 0.04

#: Fewest smoothed samples of a segment.
FEWEST_SAMPLES = 12

#: Samples at which flow is known in half a window, about: a lag is exact for a signal that is
#: linear between them.
_PER_HALF_WINDOW = 4

#: Longest gap of the flow that is bridged, s, and most of the breath's volume that it may make
#: uncertain.
_BRIDGED, _UNCERTAIN = 0.12, 0.003

#: Number of successive samples at the highest or lowest reading that count as clipped.
_CLIPPED_RUN = 3


@dataclass(frozen=True, eq=False)
class Segment:
    """A breath, or a part of it over which the volume is known, as smoothed signals.

    What flows is known at m closely spaced samples, since a lag needs all of its course. The
    pressure is compared at n of them, half a window apart.
    """

    breath: int  #: index of the breath.
    first: bool  #: whether the segment begins where the breath does.
    rows: Ints  #: which of the m samples are compared, ``(n,)``.
    begins: Bools  #: True at the first compared sample after a gap, bool ``(n,)``.
    pressure: Floats  #: at the compared samples, cmH2O, ``(n,)``.
    time: Floats  #: time from the start of the breath, s, ``(m,)``.
    volume: Floats  #: volume from the start of the segment, L, ``(m,)``.
    flow: Floats  #: L/s, ``(m,)``.
    slope: Floats  #: derivative of the flow, L/s2, ``(m,)``.
    dose: Floats  #: integral of the pressure from the start of the segment, cmH2O s, ``(m,)``.
    lag: float = 0.0  #: time constant of the pressure sensor, s.

    def __len__(self) -> int:
        """Number of compared samples n."""
        return len(self.rows)


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
            flow[i, :end], bridged = _bridged(breaths.time[i, :end], flow[i, :end])
            pressure[i, :end][bridged] = np.nan
            parts = runs(np.isfinite(flow[i, :end]))
        for start, stop in parts:
            part = slice(start, stop)
            signals = _smoothed(
                breaths.time[i, part],
                pressure[i, part],
                None if flow is None else flow[i, part],
                None if volume is None else volume[i, part],
            )
            if signals is not None:
                smoothed.append(Segment(i, start == 0, *signals))
    return tuple(smoothed)


def _bridged(time: Floats, flow: Floats) -> tuple[Floats, Bools]:
    """Flow, L/s, with short gaps interpolated, and where, ``(m,)`` each."""
    finite = np.isfinite(flow)
    bridged = np.zeros(len(flow), bool)
    at = np.flatnonzero(finite)
    if finite.all() or len(at) < 2:
        return flow, bridged
    volume = np.ptp(cumulative_trapezoid(flow[at], time[at], initial=0.0))
    for k in np.flatnonzero(np.diff(at) > 1):
        before, after = at[k], at[k + 1]
        gap, change = time[after] - time[before], abs(flow[after] - flow[before])
        if gap <= _BRIDGED and 0.5 * gap * change <= _UNCERTAIN * volume:
            bridged[before + 1 : after] = True
    filled = np.interp(time, time[at], flow[at])
    return np.where(finite | bridged, np.where(finite, flow, filled), np.nan), bridged


def _smoothed(
    time: Floats, pressure: Floats, flow: Floats | None, volume: Floats | None
) -> tuple[Ints, Bools, *_Signals] | None:
    """Fields of a segment from ``rows`` on; None if the segment would be too short."""
    if len(time) < 3:
        return None
    half = max(1, round(WINDOW / float(np.median(np.diff(time)))))
    step = max(1, half // _PER_HALF_WINDOW)
    filled: Any = volume
    if volume is None and flow is not None:
        filled = cumulative_trapezoid(flow, time, initial=0.0)
    flows = np.isfinite(filled)
    flows &= True if flow is None else np.isfinite(flow)
    fine = np.concatenate(
        [np.arange(start + half, stop - half, step) for start, stop in runs(flows)]
        or [np.zeros(0, int)]
    )
    rows, begins = _compared(fine, flows & np.isfinite(pressure), half, step)
    if len(rows) < FEWEST_SAMPLES:
        return None
    value, change = window_weights(time, half, fine)
    filled = filled - filled[np.isfinite(filled)][0]
    at = np.isfinite(pressure)
    known = np.interp(time, time[at], pressure[at])
    dose = cumulative_trapezoid(known, time, initial=0.0)
    t, v, dose = (weighted_sum(windows(x, half)[fine - half], value) for x in (time, filled, dose))
    p = weighted_sum(windows(pressure, half)[fine[rows] - half], value[rows])
    if flow is None:
        flow = differentiate(time, filled, half)
        q = flow[fine]
    else:
        q = weighted_sum(windows(flow, half)[fine - half], value)
    slope = weighted_sum(windows(flow, half)[fine - half], change)
    return rows, begins, p, t, v, q, slope, dose


def _compared(fine: NDArray[np.intp], valid: Bools, half: int, step: int) -> tuple[Ints, Bools]:
    """Centres of windows of known samples, half a window apart, and which of them follow a gap.

    They are indices into ``fine``, centres of windows in which flow and volume are known, ``step``
    samples apart; at the samples ``known`` the pressure is known too.
    """
    complete = np.zeros(len(valid), bool)
    for start, stop in runs(valid):
        complete[start + half : max(stop - half, 0)] = True
    complete_windows = complete[fine]
    # A run ends where a window is incomplete, and where the next centre is further away.
    ends = np.flatnonzero(np.diff(fine) > step) + 1
    rows: list[Ints] = []
    for part in np.split(np.arange(len(fine)), ends):
        offset = int(part[0]) if len(part) else 0
        for start, stop in runs(complete_windows[part]):
            rows.append(np.arange(offset + start, offset + stop, -(-(half + 1) // step)))
    if not rows:
        return np.zeros(0, np.int64), np.zeros(0, bool)
    begins = np.concatenate([np.arange(len(run)) == 0 for run in rows])
    return np.concatenate(rows), begins


def _unclipped(values: Floats) -> Floats:
    """The readings ``(n, T)``, NaN in runs at the highest or the lowest of all."""
    out = values.copy()
    for end in (np.fmax.reduce(values, axis=None), np.fmin.reduce(values, axis=None)):
        for row, at_end in enumerate(values == end):
            for start, stop in runs(at_end):
                if stop - start >= _CLIPPED_RUN:
                    out[row, start:stop] = np.nan
    return out


def window_weights(time: Floats, half: int, centres: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Weights of a smoothed value and of a smoothed derivative, each ``(c, 2 half + 1)``.

    Hann's window and its derivative at the true times, corrected to be exact for straight lines.
    """
    samples = windows(time, half)[centres - half]
    offsets = samples - time[centres][:, None]
    width = (half + 1) * float(np.median(np.diff(time)))
    angle = np.clip(0.5 * np.pi * offsets / width, -0.5 * np.pi, 0.5 * np.pi)
    span = np.gradient(samples, axis=1)
    value = span * np.cos(angle) ** 2
    value /= value.sum(axis=1, keepdims=True)
    change = span * np.sin(2.0 * angle)
    change -= value * change.sum(axis=1, keepdims=True)
    change /= np.sum(change * offsets, axis=1, keepdims=True)
    return value, change


def differentiate(time: Floats, values: Floats, half: int) -> Floats:
    """Smoothed derivative of every sample; near the ends, that of the nearest complete window."""
    fine = np.arange(half, len(time) - half)
    slope = np.full(len(time), np.nan)
    slope[fine] = weighted_sum(windows(values, half), window_weights(time, half, fine)[1])
    finite = np.flatnonzero(np.isfinite(slope))
    nearest = np.clip(np.searchsorted(finite, np.arange(len(time))), 0, max(len(finite) - 1, 0))
    return slope[finite[nearest]] if len(finite) else slope


def windows(values: Floats, half: int) -> Floats:
    """Return the windows of ``2 half + 1`` samples, the first of them around sample ``half``."""
    return np.lib.stride_tricks.sliding_window_view(values, 2 * half + 1)


def weighted_sum(samples: Floats, weights: Floats) -> Floats:
    """Weighted sum of each window, ``(c,)``."""
    return np.einsum("cw,cw->c", samples, weights)
