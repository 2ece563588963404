"""Intervals of scores over rigs: draws, rigs and members of the ensemble are resampled.

A cell's error depends on its draw, on the rig that was drawn and on the member of the ensemble that
stands for it. Each of the three is resampled with replacement: the draws of each lung, its rigs,
and the members, which all lungs share. A resampled score is

    mean over lungs of mean over draws of [value + (n_draw - 1 + a (n_rig - 1) + b (n_member - 1))
                                           (value - mean of the lung)]

with how often the draw, its rig and its member were taken; ``a = sqrt(G / (G - 1))`` for G rigs
and ``b`` for the members make the variance unbiased however few there are. What the draws alone
scatter is counted in each of the three, so the intervals are rather too wide than too narrow.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench.metrics.bootstrap import RESAMPLES, SEED

Floats = NDArray[np.float64]


def resampled_scores(
    values: ArrayLike,
    rig: ArrayLike,
    member: ArrayLike,
    *,
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> Floats:
    """Scores of resampled draws, rigs and members.

    What is taken depends on the seed, the rigs and the members alone, so that two entries over the
    same draws are resampled alike: the difference of their results is the paired bootstrap.

    Args:
        values: of each lung and draw, any unit, shape ``(L, n)``.
        rig: which rig it was, shape ``(L, n)``.
        member: which member, shape ``(L, n)``.
        resamples: number of resamples.
        seed: of the bit generator PCG64.

    Returns:
        Shape ``(resamples,)``.

    Raises:
        ValueError: if the shapes differ.
    """
    values, rig, member = np.asarray(values, float), np.asarray(rig), np.asarray(member)
    if values.ndim != 2 or values.shape != rig.shape or values.shape != member.shape:
        raise ValueError(
            f"values {values.shape}, rigs {rig.shape} and members {member.shape} differ in shape"
        )
    bits = np.random.PCG64(seed)
    off = (values - values.mean(axis=1, keepdims=True)) / values.size
    n = values.shape[1]
    changes = np.zeros(resamples)
    # All by whole numbers from the raw stream, which no numpy version changes.
    for own in off:
        changes += (_counts(bits, resamples, n) - 1.0) @ own
    for own, of_lung in zip(off, rig, strict=True):
        changes += _level(bits, resamples, own, of_lung)
    changes += _level(bits, resamples, off.ravel(), member.ravel())
    changes += values.mean()
    return changes


def _level(bits: np.random.PCG64, resamples: int, off: Floats, level: NDArray) -> Floats:
    """Changes of the score by resampling the levels of a factor, shape ``(resamples,)``."""
    names, index = np.unique(level, return_inverse=True)
    count = len(names)
    if count < 2:
        return np.zeros(resamples)
    sums = np.bincount(index, weights=off, minlength=count)
    widening = math.sqrt(count / (count - 1))
    return (widening * ((_counts(bits, resamples, count) - 1.0) @ sums)).astype(np.float64)


def _counts(bits: np.random.PCG64, resamples: int, count: int) -> Floats:
    """How often each of some things is taken by as many draws, shape ``(resamples, count)``."""
    raw = bits.random_raw((resamples, count)) >> np.uint64(32)
    index = ((raw * np.uint64(count)) >> np.uint64(32)).astype(np.int64)
    flat = np.arange(resamples)[:, None] * count + index
    return (
        np.bincount(flat.ravel(), minlength=resamples * count)
        .reshape(resamples, count)
        .astype(np.float64)
    )
