"""Ranks, intervals and differences of the entries of one track.

The ranked score of an entry is the mean over the published draws of its mean error over all lungs
and PIPs. The draws are common to all entries and resampled alike, so that every interval of a
difference is a paired one, and ranks can be counted within each resample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.board.record import Record
from ventbench.board.standing import Entry
from ventbench.metrics import bootstrap

Floats = NDArray[np.float64]

#: The PID that each track's entries are compared with.
BASELINES = {"performance": "pid_best", "robustness": "pid_robust"}

#: Decimals, of cmH2O, that decide: replays agree to so many, so that no machine decides a tie.
DECIMALS = 9


@dataclass(frozen=True)
class Interval:
    """A figure with its 95 % interval, cmH2O."""

    value: float
    low: float
    high: float

    @property
    def clear(self) -> bool:
        """Whether zero is outside, by more than rounding."""
        least = 10.0**-DECIMALS
        return self.low > least or self.high < -least


@dataclass(frozen=True)
class Row:
    """One ranked entry, or one shown beside them.

    Attributes:
        entry: whose row it is.
        rank: from 1, equal for equal scores; None if it is not ranked.
        ranks: 95 % interval of the rank; None likewise.
        score: mean over draws, cmH2O; None if a cell failed.
        to_baseline: difference to the track's PID; None for itself, or where there is none.
        to_above: difference to the entry above; None for the first.
        nominal: nominal score, cmH2O; NaN if a cell failed.
        worst: highest mean over draws of one cell, cmH2O, its lung and PIP; NaN likewise.
    """

    entry: Entry
    rank: int | None
    ranks: tuple[int, int] | None
    score: Interval | None
    to_baseline: Interval | None
    to_above: Interval | None
    nominal: float
    worst: tuple[float, str, float]

    @property
    def record(self) -> Record:
        """The record that counts."""
        return self.entry.record


def rank(entries: Sequence[Entry], track: str) -> list[Row]:
    """Rank complete entries.

    Args:
        entries: to be ranked, in any order; all over the same draws.
        track: that they are on.

    Returns:
        Best first; entries of equal score by name.
    """
    ordered = sorted(entries, key=lambda e: (_key(e.record), e.record.name))
    if not ordered:
        return []
    keys = np.array([_key(entry.record) for entry in ordered])
    means = _resampled([entry.record for entry in ordered])
    low, high = _rank_intervals(means)
    base = baseline([entry.record for entry in ordered], track)
    rows = []
    for i, entry in enumerate(ordered):
        own = entry.record.by_draw
        to_baseline = None
        if base is not None and base != i:
            to_baseline = _interval(own - ordered[base].record.by_draw, means[i] - means[base])
        to_above = None
        if i:
            to_above = _interval(own - ordered[i - 1].record.by_draw, means[i] - means[i - 1])
        rows.append(
            Row(
                entry=entry,
                rank=1 + int(np.sum(keys < keys[i])),
                ranks=(int(low[i]), int(high[i])),
                score=_interval(own, means[i]),
                to_baseline=to_baseline,
                to_above=to_above,
                nominal=float(entry.record.nominal.mean()),
                worst=worst(entry.record),
            )
        )
    return rows


def beside(entries: Sequence[Entry]) -> list[Row]:
    """Rows of entries that are not ranked, by name; scores where they exist."""
    rows = []
    for entry in sorted(entries, key=lambda e: e.record.name):
        score = None
        if np.isfinite(entry.record.by_draw).all():
            score = _interval(entry.record.by_draw, _resampled([entry.record])[0])
        nominal = float(entry.record.nominal.mean())
        rows.append(Row(entry, None, None, score, None, None, nominal, worst(entry.record)))
    return rows


def baseline(records: Sequence[Record], track: str) -> int | None:
    """Index of the track's PID among records."""
    names = [record.name for record in records]
    return names.index(BASELINES[track]) if BASELINES[track] in names else None


def worst(record: Record) -> tuple[float, str, float]:
    """Highest mean over draws of one cell, cmH2O, with its lung and PIP; NaN if any failed."""
    cells = record.drawn.mean(axis=0)
    if not np.isfinite(cells).all():
        return np.nan, "", np.nan
    i, j = np.unravel_index(np.argmax(cells), cells.shape)
    return float(cells[i, j]), record.lungs[i], record.pips[j]


def _key(record: Record) -> float:
    return round(float(np.mean(record.by_draw)), DECIMALS)


def _resampled(records: Sequence[Record]) -> Floats:
    """Resampled means of each, cmH2O, shape ``(N, RESAMPLES)``: the same draws in each column."""
    return np.stack([bootstrap.resampled_means(record.by_draw) for record in records])


def _interval(by_draw: Floats, means: Floats) -> Interval:
    low, high = np.quantile(means, (0.025, 0.975))
    return Interval(float(np.mean(by_draw)), float(low), float(high))


def _rank_intervals(means: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """95 % intervals of ranks that are counted within each resample."""
    rounded = np.round(means, DECIMALS)
    ranks = np.empty(means.shape, np.int64)
    for column in range(means.shape[1]):
        values = rounded[:, column]
        ranks[:, column] = 1 + np.searchsorted(np.sort(values), values, side="left")
    low = np.quantile(ranks, 0.025, axis=1, method="lower")
    high = np.quantile(ranks, 0.975, axis=1, method="higher")
    return low.astype(np.int64), high.astype(np.int64)
