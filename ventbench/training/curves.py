"""Learning curves of several seeds: interquartile mean, its band, and what they say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from ventbench.metrics import bootstrap

Floats = NDArray[np.float64]

#: Share of the values that the interquartile mean cuts off at each end.
CUT = 0.25

#: How close to its final score counts as having reached it.
CLOSE = 0.02


def interquartile_mean(values: ArrayLike) -> Floats:
    """Mean of what is left after cutting a quarter at each end; over the first axis.

    Args:
        values: shape ``(n, ...)``; ``floor(n / 4)`` values are cut at each end.
    """
    values = np.sort(np.asarray(values, float), axis=0)
    cut = int(CUT * len(values))
    return np.mean(values[cut : len(values) - cut], axis=0)


def band(values: ArrayLike) -> tuple[Floats, Floats]:
    """95 % bootstrap interval of the interquartile mean, the seeds drawn with replacement.

    Args:
        values: shape ``(seeds, points)``.

    Returns:
        Lower and upper limits, shape ``(points,)``.
    """
    values = np.asarray(values, float)
    bits = np.random.PCG64(bootstrap.SEED)
    drawn = bits.random_raw((len(values), bootstrap.RESAMPLES)) >> np.uint64(32)
    index = ((drawn * np.uint64(len(values))) >> np.uint64(32)).astype(np.intp)
    means = np.stack([interquartile_mean(column[index]) for column in values.T], axis=-1)
    low, high = np.quantile(means, (0.025, 0.975), axis=0)
    return low, high


@dataclass(frozen=True)
class Curve:
    """One method: score against experience.

    Attributes:
        method: name.
        episodes: breaths seen by one training, ``(points,)``.
        seconds: for all seeds together, without compiling, ``(points,)``.
        compile_seconds: before that.
        scores: nominal, cmH2O, ``(seeds, points)``.
    """

    method: str
    episodes: NDArray[np.int64]
    seconds: Floats
    compile_seconds: float
    scores: Floats

    @property
    def middle(self) -> Floats:
        """Interquartile mean over the seeds, ``(points,)``."""
        return interquartile_mean(self.scores)

    def first_below(self, score: float) -> int | None:
        """Index of the first point whose interquartile mean is at or below a score."""
        found = np.flatnonzero(self.middle <= score)
        return int(found[0]) if found.size else None


@dataclass(frozen=True)
class Study:
    """All methods on one lung, and what PID does there.

    Attributes:
        lung: its id.
        curves: of the methods.
        start: nominal score of the PID that is corrected, cmH2O.
        best_pid: of the best PID of the paper's grid on this lung, cmH2O.
    """

    lung: str
    curves: tuple[Curve, ...]
    start: float
    best_pid: float

    def points(self) -> pd.DataFrame:
        """One row for each point of each curve."""
        parts = []
        for curve in self.curves:
            low, high = band(curve.scores)
            columns = {
                "method": curve.method,
                "episodes": curve.episodes,
                "seconds": np.round(curve.seconds, 3),
                "iqm": curve.middle,
                "low95": low,
                "high95": high,
            }
            columns |= {f"seed{i}": row for i, row in enumerate(curve.scores)}
            parts.append(pd.DataFrame(columns))
        return pd.concat(parts, ignore_index=True).round(5)

    def summary(self) -> pd.DataFrame:
        """One row for each method; ``episodes_...`` is blank where it is not reached."""
        return pd.DataFrame([self._row(curve) for curve in self.curves])

    def _row(self, curve: Curve) -> dict[str, object]:
        low, high = band(curve.scores[:, -1:])
        final = float(curve.middle[-1])
        close = curve.first_below((1.0 + CLOSE) * final)
        better = curve.first_below(self.best_pid)
        at_100 = int(np.flatnonzero(curve.episodes <= 100)[-1])

        def at(array: NDArray[np.generic], index: int | None) -> object:
            return None if index is None else array[index].item()

        return {
            "method": curve.method,
            "final": round(final, 3),
            "low95": round(float(low[0]), 3),
            "high95": round(float(high[0]), 3),
            "episodes": int(curve.episodes[-1]),
            "at_100_episodes": round(float(curve.middle[at_100]), 3),
            "episodes_to_best_pid": at(curve.episodes, better),
            "episodes_to_2_percent": at(curve.episodes, close),
            "seconds_to_2_percent": at(np.round(curve.seconds, 2), close),
            "seconds": round(float(curve.seconds[-1]), 1),
            "compile_seconds": round(curve.compile_seconds, 1),
        }
