"""Breaths as pressure, volume, flow and its slope, smoothed all alike.

Everything is seen through the same window, so that what holds between pressure, flow and volume
still holds: the derivative of a smoothed volume is the smoothed flow, whatever the window. Readings
that stand still at the end of a sensor's range are left out, and so is what is not measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.mechanics.windows import differentiated, dot, integral, view, weights
from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]

#: Half the width of the window, s, and the fewest smoothed samples of a piece that is used.
WINDOW, FEWEST = 0.04, 12

#: Samples in a row at the very end of the range from which on a sensor is taken to be clipped.
_STUCK = 3


@dataclass(frozen=True, eq=False)
class Segment:
    """A breath, or a piece of it over which the volume is known; n smoothed samples.

    Attributes:
        breath: index of the breath.
        first: True if it begins where the breath does.
        begins: True for the first sample after a gap, bool ``(n,)``.
        time: since the start of the breath, s, ``(n,)``.
        pressure: cmH2O, ``(n,)``.
        volume: since the start of the piece, L, ``(n,)``.
        flow: L/s, ``(n,)``.
        slope: of the flow, L/s2, ``(n,)``.
        dose: pressure integrated since the start of the piece, cmH2O s, ``(n,)``.
        rise: of the pressure, cmH2O/s, ``(n,)``.
        bend: its second derivative, cmH2O/s2, ``(n,)``.
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
    """Smooth breaths; where only flow is measured, cut them where it is missing.

    Flow is measured, or the derivative of volume; volume is measured, or the integral of flow, from
    zero at the start of each piece.

    Raises:
        InputError: if there is neither flow nor volume.
    """
    if breaths.flow is None and breaths.volume is None:
        raise InputError(
            "the recording has neither flow nor volume; without them mechanics cannot be told from "
            "the valve"
        )
    flow = None if breaths.flow is None else _without(breaths.flow / 1000.0)
    volume = None if breaths.volume is None else breaths.volume / 1000.0
    pressure = _without(breaths.pressure)
    found = []
    for i in range(len(breaths)):
        end = int(breaths.valid[i].sum())
        parts = [(0, end)]
        if volume is None:
            assert flow is not None
            parts = _runs(np.isfinite(flow[i, :end]))
        for start, stop in parts:
            part = slice(start, stop)
            own = _smoothed(
                breaths.time[i, part], pressure[i, part],
                None if flow is None else flow[i, part],
                None if volume is None else volume[i, part],
            )  # fmt: skip
            if own is not None:
                found.append(Segment(i, start == 0, *own))
    return tuple(found)


def clipped(breaths: Breaths) -> float:
    """Share of the pressures that stand still at the end of the sensor's range, 0..1."""
    known = np.isfinite(breaths.pressure) & breaths.valid
    return float(np.sum(_stuck(breaths.pressure) & known) / max(known.sum(), 1))


def _smoothed(
    time: Floats, pressure: Floats, flow: Floats | None, volume: Floats | None
) -> tuple[NDArray[np.bool_], *tuple[Floats, ...]] | None:
    """What a segment has after ``first``, or None if that would be too short."""
    if len(time) < 3:
        return None
    half = max(1, round(WINDOW / float(np.median(np.diff(time)))))
    filled = _volume(time, flow, volume)
    known = np.isfinite(pressure) & np.isfinite(filled)
    known &= True if flow is None else np.isfinite(flow)
    centres, begins = _centres(known, half)
    if len(centres) < FEWEST:
        return None
    value, change = weights(time, half, centres)
    filled = filled - filled[np.isfinite(filled)][0]
    at = np.isfinite(pressure)
    unbroken = np.interp(time, time[at], pressure[at])
    dose = integral(time, unbroken)
    own = np.stack([time, pressure, filled, dose])
    seen = np.lib.stride_tricks.sliding_window_view(own, 2 * half + 1, axis=1)[:, centres - half]
    t, p, v, dose = np.einsum("kcw,cw->kc", seen, value)
    rise = dot(seen[1], change)
    bend = dot(view(differentiated(time, unbroken, half), half)[centres - half], change)
    if flow is None:
        flow = differentiated(time, filled, half)
        q = flow[centres]
    else:
        q = dot(view(flow, half)[centres - half], value)
    slope = dot(view(flow, half)[centres - half], change)
    return begins, t, p, v, q, slope, dose, rise, bend


def _volume(time: Floats, flow: Floats | None, volume: Floats | None) -> Floats:
    if volume is not None:
        return volume
    assert flow is not None
    return integral(time, flow)


def _centres(known: NDArray[np.bool_], half: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Middles of windows of known samples, a window apart; and which come after a gap."""
    runs = [np.arange(start + half, stop - half, half + 1) for start, stop in _runs(known)]
    runs = [run for run in runs if len(run)]
    if not runs:
        return np.zeros(0, np.intp), np.zeros(0, bool)
    begins = np.concatenate([np.arange(len(run)) == 0 for run in runs])
    return np.concatenate(runs), begins


def _runs(known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Starts and ends of runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _without(values: Floats) -> Floats:
    """The readings without those at the end of the sensor's range."""
    return np.where(_stuck(values), np.nan, values)


def _stuck(values: Floats) -> NDArray[np.bool_]:
    """Samples within runs at the very highest or lowest reading, ``(n, T)``."""
    out = np.zeros(values.shape, bool)
    if not np.isfinite(values).any():
        return out
    for end in (np.nanmax(values), np.nanmin(values)):
        for row, at_end in enumerate(values == end):
            for start, stop in _runs(at_end):
                out[row, start:stop] = stop - start >= _STUCK
    return out
