"""Errors of each breath in each range of an axis: the numbers that the tests are about."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis.axes import Axis

Floats = NDArray[np.float64]


def means(axis: Axis, values: Floats, usable: NDArray[np.bool_]) -> Floats:
    """Mean over the samples of each breath and range, NaN where there is none, ``(n, k)``."""
    total, count = _sums(axis, values, usable)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _sums(axis: Axis, values: Floats, usable: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    n, k = len(values), len(axis)
    inside = usable & (axis.bins >= 0)
    cell = (np.arange(n)[:, None] * k + axis.bins)[inside]
    total = np.asarray(np.bincount(cell, values[inside], n * k), float)
    count = np.asarray(np.bincount(cell, minlength=n * k), float)
    return total.reshape(n, k), count.reshape(n, k)


def columns(axis: Axis, error: Floats, usable: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """By breath and range: mean error, and excess of the mean square over that outside; weights.

    Outside is the rest of the same breath, or, if the range is the whole breath, other breaths:
    their mean is as uncertain as theirs is, for which the statistic is made smaller.
    """
    square = np.where(usable, error**2, 0.0)
    total, count = _sums(axis, square, usable)
    inside = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    all_count = usable.sum(axis=1, keepdims=True)
    rest = all_count - count
    beside = np.divide(
        square.sum(axis=1, keepdims=True) - total,
        rest,
        out=np.full(total.shape, np.nan),
        where=rest > 0,
    )
    weight = np.ones((1, len(axis)))
    for k in range(len(axis)):
        have = count[:, k] > 0
        if have.any() and not (rest[have, k] > 0).any():
            others = ~have & (all_count[:, 0] > 0)
            level = square[others].sum() / max(usable[others].sum(), 1)
            beside[:, k] = level if others.any() else np.nan
            weight[0, k] = np.sqrt(others.sum() / max(others.sum() + have.sum(), 1))
    return means(axis, error, usable), inside - beside, weight


def nanmean(values: Floats) -> Floats:
    """Mean over the first axis without NaN, and without warnings where there is nothing else."""
    there = np.isfinite(values)
    total, count = np.where(there, values, 0.0).sum(axis=0), there.sum(axis=0)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
