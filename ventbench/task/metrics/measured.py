"""Figures of measured inspirations, where the ventilator leaves some readings unanswered.

A pressure has shape ``(..., T)``, cmH2O, NaN where there is no reading. An error takes the line
between the neighbours of a gap; safety takes the higher of them, so that a gap at a peak is counted
as the peak. A peak within a gap, of two readings at most, is not seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Bools, Floats
from ventbench.task import protocol
from ventbench.task.metrics.score import longest_run, passes_safety_gate

#: Most of a run's readings that may be missing, as a share and in a row. A serial line under load
#: leaves 3 % of them unanswered; after two in a row the bench vents.
MISSING_SHARE, MISSING_IN_A_ROW = 0.1, 2


def _neighbours(pressure: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """The readings before and after each step, itself if it has one, and the share between them."""
    measured = np.asarray(pressure, float)
    steps = np.arange(measured.shape[-1])
    finite = np.isfinite(measured)
    before = np.maximum.accumulate(np.where(finite, steps, -1), axis=-1)
    after = np.minimum.accumulate(np.where(finite, steps, len(steps))[..., ::-1], axis=-1)[
        ..., ::-1
    ]
    first, last = np.where(before < 0, after, before), np.where(after == len(steps), before, after)
    low, high = (
        np.take_along_axis(measured, np.clip(at, 0, len(steps) - 1), axis=-1)
        for at in (first, last)
    )
    return low, high, np.where(last > first, (steps - first) / np.maximum(last - first, 1), 0.0)


def filled(pressure: ArrayLike) -> Floats:
    """Pressures with the line between neighbours in each gap, the nearest beyond the ends."""
    low, high, share = _neighbours(pressure)
    return low + share * (high - low)


def worst(pressure: ArrayLike) -> Floats:
    """Pressures with the higher neighbour in each gap."""
    low, high, _ = _neighbours(pressure)
    return np.maximum(low, high)


def mean_error(pressure: ArrayLike, target: ArrayLike) -> float:
    """Mean ``|p - p*|`` of a run's scored inspirations, cmH2O; NaN without any reading of one."""
    return float(np.mean(np.abs(filled(pressure) - np.asarray(target, float))))


def is_safe(pressure: ArrayLike, pip: float, dt: float) -> Bools:
    """Whether breaths pass the safety gate, a gap as its higher neighbour; see there, ``(...)``."""
    return passes_safety_gate(worst(pressure), pip, dt)


def highest(pressure: ArrayLike) -> float:
    """Highest reading, cmH2O; minus infinity without any."""
    return float(np.max(np.nan_to_num(np.asarray(pressure, float), nan=-np.inf), initial=-np.inf))


def too_few(pressure: ArrayLike) -> str:
    """Why a run's inspirations ``(breaths, T)`` have too few readings to be scored; or nothing."""
    missing = ~np.isfinite(np.asarray(pressure, float))
    longest = int(np.max(longest_run(missing), initial=0))
    if missing.mean() > MISSING_SHARE or longest > MISSING_IN_A_ROW:
        return (
            f"{missing.sum()} of {missing.size} scored steps have no pressure, {longest} in a row; "
            f"{100.0 * MISSING_SHARE:g} % and {MISSING_IN_A_ROW} may"
        )
    return "a scored breath begins without a pressure" if missing[..., 0].any() else ""


def scored(breaths: Sequence[Sequence[float | None]]) -> Floats:
    """Values of a run's scored inspirations, ``(scored breaths, T)``; NaN where none is.

    A breath that ended before its inspiration did has none at all.
    """
    steps = protocol.INSPIRATION_STEPS
    rows = [breaths[place][:steps] for place in protocol.SCORED_BREATHS if place < len(breaths)]
    complete = [row if len(row) == steps else [None] * steps for row in rows]
    missing = [[None] * steps] * (len(protocol.SCORED_BREATHS) - len(rows))
    return np.array([*complete, *missing], float)
