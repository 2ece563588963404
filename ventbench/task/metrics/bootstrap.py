"""Bootstrap intervals, the same on every platform and numpy version.

:func:`summary` gives the interval of the mean of a sample.

:func:`resampled_scores` serves scores over rigs. A cell's error depends on its draw, on the rig
that was drawn and on the member of the ensemble that stands for it. Each of the three is resampled
with replacement: the draws of each lung, its rigs, and the members, which all lungs share. A
resampled score is

    mean over lungs of mean over draws of [value + (n_draw - 1 + a (n_rig - 1) + b (n_member - 1))
                                           (value - mean of the lung)]

with how often the draw, its rig and its member were taken; ``a = sqrt(G / (G - 1))`` for G rigs
and ``b`` for the members make the variance unbiased however few there are. What the draws alone
scatter is counted in each of the three, so the intervals are rather too wide than too narrow.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.base.arrays import Floats

#: Resamples and seed of every interval that ventbench reports.
RESAMPLES = 2000
SEED = 20210215

# At most this many resampled values are held at once.
_CHUNK = 4_000_000


@dataclass(frozen=True)
class Summary:
    """A sample in four numbers; NaN where they do not exist."""

    mean: float  #: mean of the values; NaN if there are none.
    median: float  #: median of the values; NaN if there are none.
    ci95: tuple[float, float]  #: 95 % interval of the mean; ``(NaN, NaN)`` below two values.
    count: int  #: number of values; missing ones (NaN) are not counted.


def resampled_means(values: ArrayLike, *, resamples: int = RESAMPLES, seed: int = SEED) -> Floats:
    """Means of samples drawn with replacement.

    Resampled indices depend on the seed and the length alone, so that two entries over the same
    draws are resampled alike: the difference of their results is the paired bootstrap.

    Args:
        values: any unit, shape ``(n,)``; ValueError unless n >= 1.
        resamples: number of resamples.
        seed: seed of the bit generator; the raw stream of PCG64 never changes between numpy
            versions, while the integers that a ``Generator`` makes of it may.
    """
    values = np.asarray(values, float)
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"cannot resample values of shape {values.shape}")
    bits = np.random.PCG64(seed)
    rows = max(1, _CHUNK // values.size)
    means = []
    for start in range(0, resamples, rows):
        size = (min(rows, resamples - start), values.size)
        # The upper 32 bits scaled to 0..n-1; the bias is below n / 2^32.
        index = ((bits.random_raw(size) >> np.uint64(32)) * np.uint64(values.size)) >> np.uint64(32)
        means.append(values[index.astype(np.intp)].mean(axis=1))
    return np.concatenate(means)


def summary(values: ArrayLike, *, resamples: int = RESAMPLES) -> Summary:
    """Summarise values over breaths or draws, of any unit and shape.

    The interval is that of :func:`resampled_means`. NaN is a missing value, infinity is one like
    others.
    """
    values = np.ravel(np.asarray(values, float))
    values = values[~np.isnan(values)]
    if (count := values.size) == 0:
        return Summary(np.nan, np.nan, (np.nan, np.nan), 0)
    mean, median = float(np.mean(values)), float(np.median(values))
    if count == 1 or not np.all(np.isfinite(values)):
        return Summary(mean, median, (np.nan, np.nan), count)
    means = resampled_means(values, resamples=resamples)
    return Summary(mean, median, limits(means), count)


def limits(means: Floats) -> tuple[float, float]:
    """95 % interval of resampled means: their 2.5 % and 97.5 % quantiles."""
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def resampled_scores(
    values: ArrayLike, rig: ArrayLike, member: ArrayLike, *, resamples: int = RESAMPLES
) -> Floats:
    """Scores of resampled draws, rigs and members.

    What is taken depends on the rigs and the members alone, so that two entries over the
    same draws are resampled alike: the difference of their results is the paired bootstrap.

    Args:
        values: of each lung and draw, any unit, shape ``(L, n)``.
        rig: which rig it was, shape ``(L, n)``; ValueError if it is of another shape.
        member: which member, shape ``(L, n)``.
        resamples: number of resamples.
    """
    values, rig, member = np.asarray(values, float), np.asarray(rig), np.asarray(member)
    if values.ndim != 2 or values.shape != rig.shape or values.shape != member.shape:
        raise ValueError(
            f"values {values.shape}, rigs {rig.shape} and members {member.shape} differ in shape"
        )
    off = (values - values.mean(axis=1, keepdims=True)) / values.size
    parts = [(deviation, 1.0) for deviation in off]
    for deviation, of_lung in zip(off, rig, strict=True):
        parts += _level(deviation, of_lung)
    parts += _level(off.ravel(), member.ravel())
    changes = np.zeros(resamples)
    sizes = tuple(len(sums) for sums, _ in parts)
    for (sums, widening), more in zip(parts, _excess(resamples, sizes), strict=True):
        changes += widening * (more @ sums)
    changes += values.mean()
    return changes


def _level(off: Floats, level: NDArray) -> list[tuple[Floats, float]]:
    """Sums of a factor's levels and how they are widened; none where it has only one level."""
    names, index = np.unique(level, return_inverse=True)
    count = len(names)
    if count < 2:
        return []
    sums = np.bincount(index, weights=off, minlength=count).astype(np.float64)
    return [(sums, math.sqrt(count / (count - 1)))]


@functools.lru_cache(maxsize=4)
def _excess(resamples: int, sizes: tuple[int, ...]) -> tuple[Floats, ...]:
    """How much more often than once each thing is taken, ``(resamples, size)`` for each size.

    All tables over the same draws are resampled alike, and a board does so thousands of times. All
    is made by whole numbers from the raw stream, which no numpy version changes.
    """
    bits = np.random.PCG64(SEED)
    return tuple(_counts(bits, resamples, size) - 1.0 for size in sizes)


def _counts(bits: np.random.PCG64, resamples: int, count: int) -> Floats:
    """How often each of some things is taken by as many draws, shape ``(resamples, count)``."""
    raw = bits.random_raw((resamples, count)) >> np.uint64(32)
    index = ((raw * np.uint64(count)) >> np.uint64(32)).astype(np.int64)
    flat = np.arange(resamples)[:, None] * count + index
    frequencies = np.bincount(flat.ravel(), minlength=resamples * count)
    return frequencies.reshape(resamples, count).astype(np.float64)
