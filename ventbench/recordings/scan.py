"""A file as checked breaths, which `load` and `check` share.

Blank times: a few in a breath are interpolated, those of a whole breath are inferred. Inspiration
lasts 1.0 s, so a breath whose first n samples have u_out = 0 has an interval near 1.0 s / n. The
ventilators behind a file have few different intervals (PVP: 31.9 and 34.0 ms), so a better estimate
is the median interval of the file's breaths with the same n, if there are at least `ENOUGH` of
them. On the 135 PVP breaths whose times are known, leaving each out, the median estimate is off by
0.12 ms in the median, 0.34 ms at 90 % and 2.9 ms at worst; 1.0 s / n is off by 0.41, 0.71 and 3.5
ms. If u_out never switches, n says nothing and the median of all breaths is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ventbench.recordings.rows import (
    Rows,
    check_ids,
    check_lung,
    check_row_ids,
    check_single,
    check_times,
    check_values,
    rows_of,
)
from ventbench.recordings.schema import ProblemLog, fail
from ventbench.recordings.sources import Source

if TYPE_CHECKING:
    import pyarrow as pa

#: What is told how much of a file has been read, and of how much: bytes, or rows of Parquet.
Progress = Callable[[int, int], object]

ENOUGH = 3
"""Least number of breaths with the same n whose median is used."""
INSPIRATION = 1.0
"""Duration of inspiration, s."""


@dataclass(frozen=True)
class IntervalTable:
    """Sampling intervals of a file's breaths with known times."""

    by_count: dict[int, float]  #: median interval, s, by number of inspiratory samples.
    overall: float | None  #: median interval of all breaths, s, or None if no breath has times.

    def estimate(self, n_inspiratory: int, length: int) -> float | None:
        """Interval of a breath without times, s, of n inspiratory samples of so many in all.

        None if no breath of the file has times and u_out does not switch.
        """
        if not 0 < n_inspiratory < length:
            return self.overall
        return self.by_count.get(n_inspiratory, INSPIRATION / n_inspiratory)


def interval_table(n_inspiratory: np.ndarray, interval: np.ndarray) -> IntervalTable:
    """Tabulate the intervals of a file.

    Args:
        n_inspiratory: leading samples with u_out = 0, (k,).
        interval: mean sampling interval, s, NaN where times are blank, (k,).
    """
    known = np.isfinite(interval)
    counts, intervals = n_inspiratory[known], interval[known]
    by_count = {
        int(n): float(np.median(intervals[counts == n]))
        for n, many in zip(*np.unique(counts, return_counts=True), strict=True)
        if many >= ENOUGH
    }
    return IntervalTable(by_count, float(np.median(intervals)) if len(intervals) else None)


def leading_zeros(u_out: np.ndarray, starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Count the leading samples with u_out = 0, ``(m,)``, of each breath, (k,).

    ``starts`` is the first row of each breath, and ``lengths`` the number of its rows, (k,).
    """
    within = np.arange(len(u_out)) - np.repeat(starts, lengths)
    switched = np.where(u_out != 0, within, len(u_out))
    return np.minimum(np.minimum.reduceat(switched, starts), lengths)


@dataclass(frozen=True)
class KnownTimes:
    """Times of breaths, with what follows from each breath alone."""

    #: s from the breath's first sample, NaN in all of a breath without times, (m,).
    time: np.ndarray
    blank: np.ndarray  #: breaths with fewer than two times, which have none then, (k,) bool.
    interpolated: np.ndarray  #: number of single times that are interpolated, (k,).
    shifted: np.ndarray  #: breaths that do not start at 0 in the file, (k,) bool.


def known_times(time: np.ndarray, starts: np.ndarray, lengths: np.ndarray) -> KnownTimes:
    """Interpolate single blank times and shift each breath to start at 0.

    Blank times between two known ones are linear in the sample number; those before the first or
    after the last known one are extrapolated at the breath's mean interval. Times are as in the
    file, s, NaN where blank, (m,); starts and lengths as of :func:`leading_zeros`.
    """
    missing = np.isnan(time)
    n_missing = np.add.reduceat(missing.astype(np.int64), starts)
    blank = lengths - n_missing < 2
    partial = (n_missing > 0) & ~blank
    if partial.any():
        time = time.copy()
        for breath in np.flatnonzero(partial):
            span = slice(starts[breath], starts[breath] + lengths[breath])
            time[span] = _interpolate(time[span])
    first = time[starts]
    shifted = np.isfinite(first) & (first != 0.0) & ~blank
    time = time - np.repeat(np.where(blank, np.nan, first), lengths)
    return KnownTimes(time, blank, np.where(partial, n_missing, 0), shifted)


def _interpolate(time: np.ndarray) -> np.ndarray:
    at = np.arange(len(time))
    known = np.flatnonzero(np.isfinite(time))
    first, last = known[0], known[-1]
    slope = (time[last] - time[first]) / (last - first)
    filled = np.interp(at, known, time[known])
    filled = np.where(at < first, time[first] + slope * (at - first), filled)
    return np.where(at > last, time[last] + slope * (at - last), filled)


@dataclass(frozen=True)
class Scanned:
    """k whole breaths with m samples in all."""

    breath_id: np.ndarray  #: (k,) int64.
    R: np.ndarray  #: cmH2O/(L/s), (k,).
    C: np.ndarray  #: mL/cmH2O, (k,).
    starts: np.ndarray  #: each breath's first sample, which is its data row in the file, (k,).
    lengths: np.ndarray  #: samples, (k,).
    n_inspiratory: np.ndarray  #: leading samples with u_out = 0, (k,).
    interval: np.ndarray  #: mean sampling interval, s, NaN if times are blank, (k,).
    times: KnownTimes  #: times of the samples, and what was interpolated or shifted.
    #: u_in %, u_out 0/1 (int8), pressure cmH2O, and flow mL/s and volume mL if the file has them,
    #: each (m,).
    samples: dict[str, np.ndarray]

    @cached_property
    def intervals(self) -> IntervalTable:
        """Sampling intervals of the breaths whose times are known."""
        return interval_table(self.n_inspiratory, self.interval)

    @cached_property
    def inferred(self) -> dict[int, float | None]:
        """Interval, s, estimated for each breath without times, by its place; None without one."""
        return {
            i: self.intervals.estimate(int(self.n_inspiratory[i]), int(self.lengths[i]))
            for i in np.flatnonzero(self.times.blank).tolist()
        }


def scan(
    source: Source, log: ProblemLog, *, clip: bool = False, progress: Progress | None = None
) -> Scanned:
    """Read and check a file.

    The log receives all problems and warnings except those of the whole file (unequal lengths).
    After a problem the values must not be used. ``clip`` brings u_in into 0..100 %.

    Raises:
        RecordingError: the file cannot be parsed, or has no rows.
    """

    def batches() -> Iterator[pa.RecordBatch]:
        for batch in source.batches():
            yield batch
            if progress is not None:
                progress(source.done, source.size)

    rows = rows_of(batches())
    if not len(rows.blank_id):
        what = "the file has a header but no rows"
        raise fail(source.file, what, "Write at least one breath.")
    for check in (check_ids, check_single, check_lung, check_times, check_row_ids):
        check(rows, log)
    columns = check_values(rows, log, clip=clip)
    with np.errstate(all="ignore"):  # infinite values are problems already
        return _scanned(rows, columns)


def _scanned(rows: Rows, columns: dict[str, np.ndarray]) -> Scanned:
    starts, lengths = rows.starts, rows.lengths
    times = known_times(columns["time_step"], starts, lengths)
    keep = ("u_in", "pressure", "flow", "volume")
    samples = {name: columns[name] for name in keep if name in columns}
    samples["u_out"] = (columns["u_out"] == 1.0).astype(np.int8)
    return Scanned(
        breath_id=columns["breath_id"][starts], R=columns["R"][starts], C=columns["C"][starts],
        starts=starts, lengths=lengths,
        n_inspiratory=leading_zeros(samples["u_out"], starts, lengths),
        interval=times.time[starts + lengths - 1] / np.maximum(lengths - 1, 1), times=times,
        samples=samples,
    )  # fmt: skip
