"""Mean, median and a bootstrap interval, the same on every platform and numpy version."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Resamples and seed of every interval that ventbench reports.
RESAMPLES = 2000
SEED = 20210215

# At most this many resampled values are held at once.
_CHUNK = 4_000_000


@dataclass(frozen=True)
class Summary:
    """A sample in four numbers; NaN where they do not exist.

    Attributes:
        mean: mean of the values; NaN if there are none.
        median: median of the values; NaN if there are none.
        ci95: 95 % interval of the mean; ``(NaN, NaN)`` below two values.
        count: number of values; missing ones (NaN) are not counted.
    """

    mean: float
    median: float
    ci95: tuple[float, float]
    count: int


def resampled_means(
    values: ArrayLike, *, resamples: int = RESAMPLES, seed: int = SEED
) -> NDArray[np.float64]:
    """Means of samples drawn with replacement.

    Resampled indices depend on the seed and the length alone, so that two entries over the same
    draws are resampled alike: the difference of their results is the paired bootstrap.

    Args:
        values: any unit, shape ``(n,)``, n >= 1.
        resamples: number of resamples.
        seed: seed of the bit generator; the raw stream of PCG64 never changes between numpy
            versions, while the integers that a ``Generator`` makes of it may.

    Returns:
        Shape ``(resamples,)``.

    Raises:
        ValueError: if there are no values.
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


def summary(values: ArrayLike, *, resamples: int = RESAMPLES, seed: int = SEED) -> Summary:
    """Summarise values over breaths or draws.

    The interval is the percentile bootstrap: 2.5 % and 97.5 % quantiles of
    :func:`resampled_means`.

    Args:
        values: any unit, any shape; NaN is a missing value, infinity is one like others.
        resamples: see :func:`resampled_means`.
        seed: see :func:`resampled_means`.
    """
    values = np.ravel(np.asarray(values, float))
    values = values[~np.isnan(values)]
    count = values.size
    if count == 0:
        return Summary(np.nan, np.nan, (np.nan, np.nan), 0)
    mean, median = float(np.mean(values)), float(np.median(values))
    if count == 1 or not np.all(np.isfinite(values)):
        return Summary(mean, median, (np.nan, np.nan), count)
    means = resampled_means(values, resamples=resamples, seed=seed)
    low, high = np.quantile(means, (0.025, 0.975))
    return Summary(mean, median, (float(low), float(high)), count)
