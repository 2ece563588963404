"""A file as checked breaths, which `load` and `check` share.

Checks of values, breaths and times only add to a `ProblemLog`.

Blank times: a few in a breath are interpolated, those of a whole breath are inferred. Inspiration
lasts 1.0 s, so a breath whose first n samples have u_out = 0 has an interval near 1.0 s / n. The
ventilators behind a file have few different intervals (PVP: 31.9 and 34.0 ms), so a better estimate
is the median interval of the file's breaths with the same n, if there are at least `ENOUGH` of
them. On the 135 PVP breaths whose times are known, leaving each out, the median estimate is off by
0.12 ms in the median, 0.34 ms at 90 % and 2.9 ms at worst; 1.0 s / n is off by 0.41, 0.71 and 3.5
ms. If u_out never switches, n says nothing and the median of all breaths is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ventbench.recordings.schema import COLUMNS, Column, ProblemLog, fail
from ventbench.recordings.sources import Source

if TYPE_CHECKING:
    import pyarrow as pa

#: What is told how much of a file has been read, and of how much: bytes, or rows of Parquet.
Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Rows:
    """The rows of a recording; row 0 is the first data row of the file."""

    #: arrays by column name, each (m,): int64 for id and breath_id, float64 with NaN for blank
    #: otherwise, in the units of the schema.
    columns: dict[str, np.ndarray]
    #: rows with a blank breath_id, (m,) bool; breath_id then repeats the one before.
    blank_id: np.ndarray

    @cached_property
    def starts(self) -> np.ndarray:
        """Each breath's first row, (k,), k >= 1."""
        ids = self.columns["breath_id"]
        return np.append(0, np.flatnonzero(ids[1:] != ids[:-1]) + 1)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Rows in each breath, (k,)."""
        return np.diff(self.starts, append=len(self.blank_id))

    @cached_property
    def breath(self) -> np.ndarray:
        """Number of each row's breath, from 0, (m,)."""
        return np.repeat(np.arange(len(self.starts)), self.lengths)


def rows_of(batches: Iterable[pa.RecordBatch]) -> Rows:
    """Convert all Arrow batches of a file, of known columns in any numeric type.

    A blank breath_id is that of the row before; at the start of the file, the first one known.
    """
    parts: dict[str, list[np.ndarray]] = {}
    blanks = [np.zeros(0, bool)]
    for batch in batches:
        for name in batch.schema.names:
            parts.setdefault(name, []).append(_numpy(batch.column(name), COLUMNS[name].whole))
        blanks.append(batch.column("breath_id").is_null().to_numpy(zero_copy_only=False))
    # One column after the other is copied and let go.
    columns = {name: np.concatenate(parts.pop(name)) for name in list(parts)}
    blank = np.concatenate(blanks)
    if blank.any():
        before = np.maximum.accumulate(
            np.where(blank, int(np.argmin(blank)), np.arange(len(blank)))
        )
        columns["breath_id"] = columns["breath_id"][before]
    return Rows(columns, blank)


def _numpy(array: pa.Array, whole: bool) -> np.ndarray:
    import pyarrow as pa

    if whole:
        return array.fill_null(0).cast(pa.int64()).to_numpy(zero_copy_only=False)
    array = array.cast(pa.int8()) if pa.types.is_boolean(array.type) else array
    return array.cast(pa.float64()).to_numpy(zero_copy_only=False)


#: Rows from which a value that is repeated is reported once.
_OFTEN = 10


def check_values(rows: Rows, log: ProblemLog, *, clip: bool = False) -> dict[str, np.ndarray]:
    """Check each cell: blank, infinite, out of range. Return the columns.

    With ``clip``, u_in is clipped to 0..100 % with a warning; otherwise it is a problem.
    """
    columns = dict(rows.columns)
    _add_blank(rows, log, "breath_id", rows.blank_id)
    for name, values in rows.columns.items():
        column = COLUMNS[name]
        if column.whole:
            continue
        if not column.blank:
            _add_blank(rows, log, name, np.isnan(values))
        infinite = np.isinf(values)
        if infinite.any():
            at = np.flatnonzero(infinite)
            what = "{value} is infinite"
            log.add(at, name, what, "Fix the row.", values=values[at])
        outside = _outside(values, column) & ~infinite
        if not outside.any():
            continue
        at = np.flatnonzero(outside)
        level, advice = "problem", column.advice
        what = f"{{value}} is outside {column.span}"
        if name == "u_in" and clip:
            level, advice = "warning", "It was clipped."
            columns[name] = np.where(infinite, values, np.clip(values, column.low, column.high))
        elif name == "u_out":
            what = "{value} is neither 0 nor 1"
        elif column.positive:
            what = f"{{value}} is not in {column.span}"
        if name in ("R", "C"):  # the label of a whole recording: one mistake, not one a row
            _add_once(at, name, what, advice, values[at], log)
        else:
            log.add(at, name, what, advice, values=values[at], level=level)
    return columns


def _add_once(
    at: np.ndarray, name: str, what: str, advice: str, values: np.ndarray, log: ProblemLog
) -> None:
    """Report a value that many rows repeat once."""
    kinds, first, counts = np.unique(values, return_index=True, return_counts=True)
    often = counts >= _OFTEN
    single = ~np.isin(values, kinds[often])
    log.add(at[single], name, what, advice, values=values[single])
    what = f"{what}, here and in more rows"
    log.add(at[first[often]], name, what, advice, values=kinds[often])


def _add_blank(rows: Rows, log: ProblemLog, name: str, blank: np.ndarray) -> None:
    if blank.any():
        what = f"the cell is blank, but {name} is needed in every row"
        at = np.flatnonzero(blank)
        values = np.full(len(at), np.nan)
        log.add(at, name, what, "Fill it in or remove the breath.", values=values)


def _outside(values: np.ndarray, column: Column) -> np.ndarray:
    if column.name == "u_out":
        return (values != 0.0) & (values != 1.0) & ~np.isnan(values)
    low = values <= column.low if column.positive else values < column.low
    return low | (values > column.high)


def check_ids(rows: Rows, log: ProblemLog) -> None:
    """Check that the rows of each breath follow one another."""
    ids = rows.columns["breath_id"][rows.starts]
    _, first, which = np.unique(ids, return_index=True, return_inverse=True)
    again = np.flatnonzero(first[which] != np.arange(len(ids)))
    what = "breath {value} comes again, it is already at {other}"
    advice = "Keep the rows of a breath together, and give each breath an id of its own."
    others = rows.starts[first[which[again]]]
    log.add(rows.starts[again], "breath_id", what, advice, values=ids[again], others=others)


def check_lung(rows: Rows, log: ProblemLog) -> None:
    """Check that R and C stay the same within each breath."""
    for name in ("R", "C"):
        values = rows.columns[name]
        first = np.repeat(values[rows.starts], rows.lengths)
        with np.errstate(invalid="ignore"):
            at = np.flatnonzero((values != first) & ~np.isnan(values) & ~np.isnan(first))
        if len(at) == 0:
            continue
        at = at[np.unique(rows.breath[at], return_index=True)[1]]
        what = f"{name} changes to {{value}} within the breath, which starts at {{other}}"
        advice = "A breath has one lung: give the second part its own breath_id, or fix the row."
        others = rows.starts[rows.breath[at]]
        log.add(at, name, what, advice, values=values[at], others=others)


def check_single(rows: Rows, log: ProblemLog) -> None:
    """Check that each breath has at least two samples."""
    at = rows.starts[rows.lengths == 1]
    what = "breath {value} has one sample, at least two are needed"
    advice = "Remove it, or keep the rows of a breath together."
    log.add(at, "breath_id", what, advice, values=rows.columns["breath_id"][at])


def check_row_ids(rows: Rows, log: ProblemLog) -> None:
    """Warn where the column id, which is not used otherwise, does not increase."""
    ids = rows.columns["id"]
    at = np.flatnonzero(ids[1:] <= ids[:-1]) + 1
    what = "id {value} is not greater than the one before"
    advice = "Number the rows 1, 2, 3, ...; the column is not used for anything else."
    log.add(at, "id", what, advice, values=ids[at], level="warning")


_SORT = "Sort the rows of the breath by time_step, and remove rows that are there twice."


def check_times(rows: Rows, log: ProblemLog) -> None:
    """Check that the known times increase within each breath.

    Repeated rows are reported as such. In breaths without times, a row is a repeat if it equals the
    row before in every column, including `id`.
    """
    time, breath = rows.columns["time_step"], rows.breath
    known = np.flatnonzero(np.isfinite(time))
    previous, here = known[:-1], known[1:]
    late = (time[here] <= time[previous]) & (breath[here] == breath[previous])
    if late.any():
        _add_order(rows, log, previous[late], here[late])
    blank = np.isnan(time)
    at = np.flatnonzero(blank[1:] & blank[:-1] & (breath[1:] == breath[:-1])) + 1
    at = at[_same(rows, at - 1, at, rows.columns)] if len(at) else at
    _add_repeat(rows, log, at - 1, at, "id", rows.columns["id"])


def _add_order(rows: Rows, log: ProblemLog, previous: np.ndarray, here: np.ndarray) -> None:
    time = rows.columns["time_step"]
    equal = time[previous] == time[here]
    names = [name for name in rows.columns if name != "id"]
    repeat = equal & _same(rows, previous, here, names)
    _add_repeat(rows, log, previous[repeat], here[repeat], "time_step", time)
    for chosen, what in (
        (equal & ~repeat, "two rows of the breath have the time {value} s, the other is {other}"),
        (~equal, "time goes back to {value} s from {other}"),
    ):
        at, before = here[chosen], previous[chosen]
        log.add(at, "time_step", what, _SORT, values=time[at], others=before)


def _add_repeat(
    rows: Rows,
    log: ProblemLog,
    previous: np.ndarray,
    here: np.ndarray,
    column: str,
    values: np.ndarray,
) -> None:
    what, advice = "the row repeats {other}", "Remove one of the two."
    log.add(here, column, what, advice, values=values[here], others=previous)


def _same(rows: Rows, first: np.ndarray, other: np.ndarray, names: Iterable[str]) -> np.ndarray:
    same = np.ones(len(first), dtype=bool)
    for name in names:
        a, b = rows.columns[name][first], rows.columns[name][other]
        same &= (a == b) | ((a != a) & (b != b))
    return same


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
        breath_id=columns["breath_id"][starts],
        R=columns["R"][starts],
        C=columns["C"][starts],
        starts=starts,
        lengths=lengths,
        n_inspiratory=leading_zeros(samples["u_out"], starts, lengths),
        interval=times.time[starts + lengths - 1] / np.maximum(lengths - 1, 1),
        times=times,
        samples=samples,
    )
