"""A file as checked breaths, which `load` and `check` share, some 100,000 rows at a time.

Samples that are no readings are left out first. Checks of values, breaths and times only add to a
`ProblemLog`.

Blank times: a few in a breath are interpolated, those of a whole breath are inferred. Inspiration
lasts 1.0 s, so a breath whose first n samples have u_out = 0 has an interval near 1.0 s / n. The
ventilators behind a file have few different intervals (PVP: 31.9 and 34.0 ms), so a better estimate
is the median interval of the file's breaths with the same n, if there are at least `ENOUGH` of
them. On the 135 PVP breaths whose times are known, leaving each out, the median estimate is off by
0.12 ms in the median, 0.34 ms at 90 % and 2.9 ms at worst; 1.0 s / n is off by 0.41, 0.71 and 3.5
ms. If u_out never switches, n says nothing and the median of all breaths is taken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Columns, Floats, Ints, Pieces
from ventbench.recordings.bad_samples import BadSamples, blanked, find_bad_samples
from ventbench.recordings.roles import breath_figures
from ventbench.recordings.schema import (
    COLUMNS,
    OPTIONAL,
    SHOWN,
    Place,
    RecordingError,
    RecordingProblem,
    fail,
)
from ventbench.recordings.sources import Source, to_numpy

if TYPE_CHECKING:
    import pyarrow as pa

#: What is told how much of a file has been read, and of how much: bytes, or rows of Parquet.
Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Rows:
    """The rows of a recording; row 0 is the first data row of the file."""

    #: arrays by column name, each (m,): int64 for id and breath_id, float64 with NaN for blank
    #: otherwise, in the units of the schema.
    columns: Columns
    #: rows with a blank breath_id, (m,) bool; breath_id then repeats the one before.
    blank_id: Bools
    first: int = 0  #: row of the file that is the first of these.

    def cell(self, name: str, row: int) -> str:
        """A cell as it is printed; empty where it is blank."""
        value = self.columns[name][row].item()
        if value != value or (name == "breath_id" and self.blank_id[row]):
            return ""
        return repr(value).removesuffix(".0")

    @cached_property
    def breaths(self) -> Pieces:
        """Rows of each breath; there is one at least."""
        ids = self.columns["breath_id"]
        return Pieces(np.append(0, np.flatnonzero(ids[1:] != ids[:-1]) + 1), len(ids))


#: Rows that are checked at a time, about: enough to tell a mark of missing from a reading.
ROWS = 1 << 16


def blocks_of(batches: Iterable[pa.RecordBatch]) -> Iterator[Rows]:
    """Rows of whole breaths, at least :data:`ROWS` at a time unless the file is shorter.

    A blank breath_id is that of the row before; at the start of the file, the first one known.
    """
    import pyarrow as pa

    pending, first = None, 0
    for batch in batches:
        table = pa.Table.from_batches([batch])
        pending = table if pending is None else pa.concat_tables([pending, table])
        if pending.num_rows < 2 * ROWS:
            continue
        starts = _rows(pending, first).breaths.starts
        if cut := int(starts[-1]) if starts[-1] >= ROWS else 0:
            yield _rows(pending.slice(0, cut), first)
            pending, first = pending.slice(cut), first + cut
    if pending is not None and pending.num_rows:
        yield _rows(pending, first)


def _rows(table: pa.Table, first: int) -> Rows:
    """Rows of Arrow, with blank breath_ids filled."""
    columns = {x: to_numpy(table.column(x), COLUMNS[x].integer) for x in table.column_names}
    blank = to_numpy(table.column("breath_id").is_null()) > 0
    if blank.any():
        start = 0 if first else int(np.argmin(blank))
        before = np.maximum.accumulate(np.where(blank, start, np.arange(len(blank))))
        columns["breath_id"] = columns["breath_id"][before]
    return Rows(columns, blank, first)


Level = Literal["problem", "warning"]


@dataclass
class ProblemLog:
    """Problems and warnings of one file by row; keeps the first `SHOWN` of each, and counts all.

    Only those that are shown are looked up in the file, for their line and the cell as written.
    """

    source: Source  #: the file.
    rows: Rows | None = None  #: what is checked; None once all rows have been.
    #: number of problems and of warnings.
    counts: Counter[Level] = field(default_factory=Counter)
    #: row of each, another row that it refers to, and the problem without its place.
    _kept: dict[Level, list[tuple[int, int | None, RecordingProblem]]] = field(
        default_factory=lambda: {"problem": [], "warning": []}
    )

    def add(
        self,
        where: Bools | Ints,
        column: str,
        what: str,
        advice: str,
        *,
        values: Ints | None = None,
        references: Ints | None = None,
        level: Level = "problem",
    ) -> None:
        """Add a problem, or a warning, for each row.

        Args:
            where: mask of `rows` or their numbers, those of the file if `rows` is None; k rows,
                which may be none.
            column: name of the column.
            what: a phrase; `{value}` stands for the cell and `{other}` for the other row's line.
            advice: a sentence.
            values: what stands for the cells, shape (k,), if `rows` is None.
            references: another row that each problem refers to, shape (k,), or None.
            level: which of the two.
        """
        at = np.flatnonzero(where) if where.dtype == bool else where
        self.counts[level] += len(at)
        kept, first = self._kept[level], 0 if self.rows is None else self.rows.first
        for i, row in enumerate(at[:SHOWN].tolist()):
            value = self.rows.cell(column, row) if self.rows is not None else ""
            value = value if values is None else str(values[i])
            problem = RecordingProblem(self.source.file, what, advice, column=column, value=value)
            reference = None if references is None else int(references[i]) + first
            kept.append((row + first, reference, problem))
        kept.sort(key=lambda each: each[0])
        del kept[SHOWN:]

    def listed(self, level: Level) -> tuple[RecordingProblem, ...]:
        """Return up to `SHOWN` problems of a level, in file order, each with its line or row."""
        kept = self._kept[level]
        rows = {row for each in kept for row in each[:2] if row is not None}
        places = self.source.locate(rows) if rows else {}
        return tuple(self._placed(places, *each) for each in kept)

    def raise_problems(self) -> None:
        """Raise the problems as a RecordingError, if there are any."""
        if self.counts["problem"]:
            raise RecordingError(self.listed("problem"), self.counts["problem"])

    def _placed(
        self,
        places: Mapping[int, Place],
        row: int,
        reference: int | None,
        problem: RecordingProblem,
    ) -> RecordingProblem:
        place, (line, cells) = self.source.place, places.get(row, (None, {}))
        value = cells.get(problem.column or "", problem.value)
        message = problem.what.replace("{value}", value or "blank")
        if reference is not None:
            referenced = places.get(reference, (None,))[0]
            message = message.replace("{other}", f"{place} {referenced}")
        return replace(problem, what=message, line=line, value=value, place=place)


#: Rows from which a value that is repeated is reported once.
_OFTEN = 10


def check_values(rows: Rows, log: ProblemLog, *, clip: bool = False) -> Columns:
    """Check each cell: blank, infinite, out of range. Return the columns.

    With ``clip``, u_in is clipped to 0..100 % with a warning; otherwise it is a problem.
    """
    columns = dict(rows.columns)
    for name, values in rows.columns.items():
        column = COLUMNS[name]
        if not column.blank:
            blank = rows.blank_id if column.integer else np.isnan(values)
            message = f"the cell is blank, but {name} is needed in every row"
            log.add(blank, name, message, "Fill it in or remove the breath.")
        infinite = np.isinf(values)
        log.add(infinite, name, "{value} is infinite", "Fix the row.")
        outside = column.outside(values) & ~infinite
        if not outside.any():
            continue
        message = f"{{value}} is outside {column.span}"
        if name == "u_out":
            message = "{value} is neither 0 nor 1"
        elif column.positive:
            message = f"{{value}} is not in {column.span}"
        if name == "u_in" and clip:
            log.add(outside, name, message, "It was clipped.", level="warning")
            columns[name] = np.where(infinite, values, np.clip(values, column.low, column.high))
            continue
        if name in ("R", "C"):  # the label of a whole recording: one mistake, not one a row
            kinds, first, counts = np.unique(values, return_index=True, return_counts=True)
            often = (counts >= _OFTEN) & outside[first]
            outside &= ~np.isin(values, kinds[often])
            log.add(first[often], name, f"{message}, here and in more rows", column.advice)
        log.add(outside, name, message, column.advice)
    return columns


def check_ids(rows: Rows, log: ProblemLog, first_rows: dict[int, int]) -> None:
    """Check that the rows of each breath follow one another; first rows are by id."""
    starts = rows.breaths.starts
    ids = rows.columns["breath_id"][starts].tolist()
    at = (starts + rows.first).tolist()
    earlier = np.array(list(map(first_rows.setdefault, ids, at))) - rows.first
    again = earlier != starts
    message = "breath {value} comes again, it is already at {other}"
    advice = "Keep the rows of a breath together, and give each breath an id of its own."
    log.add(starts[again], "breath_id", message, advice, references=earlier[again])


def check_lung(rows: Rows, log: ProblemLog) -> None:
    """Check that R and C stay the same within each breath."""
    breaths = rows.breaths
    for name in ("R", "C"):
        values = rows.columns[name]
        first = values[breaths.starts][breaths.owner]
        at = np.flatnonzero((values != first) & ~np.isnan(values) & ~np.isnan(first))
        at = at[np.unique(breaths.owner[at], return_index=True)[1]]
        message = f"{name} changes to {{value}} within the breath, which starts at {{other}}"
        advice = "A breath has one lung: give the second part its own breath_id, or fix the row."
        log.add(at, name, message, advice, references=breaths.starts[breaths.owner[at]])


def check_single(rows: Rows, log: ProblemLog) -> None:
    """Check that each breath has at least two samples."""
    message = "breath {value} has one sample, at least two are needed"
    advice = "Remove it, or keep the rows of a breath together."
    log.add(rows.breaths.starts[rows.breaths.lengths == 1], "breath_id", message, advice)


_REPEAT = ("the row repeats {other}", "Remove one of the two.")
_TWICE = "two rows of the breath have the time {value} s, the other is {other}"
_SORT = "Sort the rows of the breath by time_step, and remove rows that are there twice."


def check_times(rows: Rows, log: ProblemLog) -> None:
    """Check that the known times increase within each breath.

    Repeated rows are reported as such. In breaths without times, a row is a repeat if it equals the
    row before in every column, including `id`.
    """
    time, breath = rows.columns["time_step"], rows.breaths.owner
    finite = np.flatnonzero(np.isfinite(time))
    before, at = finite[:-1], finite[1:]
    late = (time[at] <= time[before]) & (breath[at] == breath[before])
    before, at = before[late], at[late]
    equal = time[before] == time[at]
    repeat = equal & _same(rows, before, at, rows.columns.keys() - {"id"})
    for chosen, message, advice in (
        (repeat, *_REPEAT),
        (equal & ~repeat, _TWICE, _SORT),
        (~equal, "time goes back to {value} s from {other}", _SORT),
    ):
        log.add(at[chosen], "time_step", message, advice, references=before[chosen])
    blank = np.isnan(time)
    at = np.flatnonzero(blank[1:] & blank[:-1] & (breath[1:] == breath[:-1])) + 1
    at = at[_same(rows, at - 1, at, rows.columns)]
    log.add(at, "id", *_REPEAT, references=at - 1)


def _same(rows: Rows, first: Ints, second: Ints, names: Iterable[str]) -> Bools:
    same = np.ones(len(first), dtype=bool)
    for name in names:
        a, b = rows.columns[name][first], rows.columns[name][second]
        same &= (a == b) | ((a != a) & (b != b))
    return same


ENOUGH = 3
"""Least number of breaths with the same n whose median is used."""
INSPIRATION = 1.0
"""Duration of inspiration, s."""


def estimated_intervals(n_inspiratory: Ints, interval: Floats, lengths: Ints) -> Floats:
    """Sampling interval of each breath by the known ones of the file, s, (k,); see the module.

    NaN if no breath has times and u_out does not switch.

    Args:
        n_inspiratory: leading samples with u_out = 0, (k,).
        interval: mean sampling interval, s, NaN where times are blank, (k,).
        lengths: samples, (k,).
    """
    import pandas as pd

    alike = pd.Series(interval).groupby(n_inspiratory)
    few = alike.transform("count").to_numpy() < ENOUGH
    median = alike.transform("median").to_numpy()
    switches = (n_inspiratory > 0) & (n_inspiratory < lengths)
    by_count = np.where(few, INSPIRATION / np.maximum(n_inspiratory, 1), median)
    return np.where(switches, by_count, pd.Series(interval).median())


def leading_zeros(u_out: NDArray[np.int8], breaths: Pieces) -> Ints:
    """Count the leading samples with u_out = 0, ``(m,)``, of each breath, (k,)."""
    switched = np.where(u_out != 0, breaths.within, len(u_out))
    return np.minimum(np.minimum.reduceat(switched, breaths.starts), breaths.lengths)


def complete_times(time: Floats, breaths: Pieces) -> Floats:
    """Interpolate single blank times and shift each breath to start at 0.

    Blank times between two known ones are linear in the sample number; those before the first or
    after the last known one are extrapolated at the breath's mean interval. Times are as in the
    file, s, NaN where blank, (m,); they stay NaN in a breath with fewer than two.
    """
    missing = breaths.sums(np.isnan(time))
    blank = breaths.lengths - missing < 2
    time = time.copy()
    for breath in np.flatnonzero((missing > 0) & ~blank):
        span = slice(breaths.starts[breath], breaths.starts[breath] + breaths.lengths[breath])
        known, k = time[span], np.arange(breaths.lengths[breath])
        at = np.flatnonzero(np.isfinite(known))
        slope = (known[at[-1]] - known[at[0]]) / (at[-1] - at[0])
        inside = np.clip(k, at[0], at[-1])
        time[span] = np.interp(inside, at, known[at]) + slope * (k - inside)
    return time - np.where(blank, np.nan, time[breaths.starts])[breaths.owner]


@dataclass(frozen=True)
class Scanned:
    """k whole breaths with m samples in all."""

    breath_id: Ints  #: (k,) int64.
    R: Floats  #: cmH2O/(L/s), (k,).
    C: Floats  #: mL/cmH2O, (k,).
    starts: Ints  #: each breath's first sample, which is its data row in the file, (k,).
    lengths: Ints  #: samples, (k,).
    n_inspiratory: Ints  #: leading samples with u_out = 0, (k,).
    interval: Floats  #: mean sampling interval, s, NaN if times are blank, (k,).
    time_blank: Bools  #: breaths without times, (k,) bool.
    time_interpolated: Ints  #: number of single times that are interpolated, (k,).
    time_shifted: Bools  #: breaths that do not start at 0 in the file, (k,) bool.
    #: shortest and longest interval between two samples of each breath, s, (k, 2).
    steps: Floats
    figures: Columns  #: of :func:`~.roles.breath_figures`, (k, ...) each.
    bad: tuple[BadSamples, ...]  #: samples that were left out, by rows of the file.
    #: time, s from each breath's first sample, NaN in all of a breath without times; u_in %, u_out
    #: 0/1 (int8), pressure cmH2O, and flow mL/s and volume mL if the file has them, each (m,).
    #: Nothing if only checked.
    samples: Columns

    @cached_property
    def inferred(self) -> dict[int, float]:
        """Interval, s, estimated for each breath without times, by its place; NaN without one."""
        estimated = estimated_intervals(self.n_inspiratory, self.interval, self.lengths)
        return {i: float(estimated[i]) for i in np.flatnonzero(self.time_blank).tolist()}


def scan(
    log: ProblemLog,
    *,
    clip: bool = False,
    missing: Collection[float] = (),
    keep: bool = True,
    progress: Progress | None = None,
) -> Scanned:
    """Read and check a file.

    The log receives all problems and warnings except those of the whole file (unequal lengths).
    After a problem the values must not be used. ``clip`` brings u_in into 0..100 %; ``missing`` are
    values that stand for a missing one; samples are only kept with ``keep``.

    Raises:
        RecordingError: the file cannot be parsed, or has no rows.
    """
    source = log.source

    def batches() -> Iterator[pa.RecordBatch]:
        for batch in source.batches():
            yield batch
            if progress is not None:
                progress(source.done, source.size)

    parts, first_rows = [], dict[int, int]()
    marks = set(missing)
    for rows in blocks_of(batches()):
        log.rows = rows
        bad = find_bad_samples(rows.columns, marks)
        marks |= {float(samples.values[0]) for samples in bad if samples.kind == "mark"}
        rows.columns.update(blanked(rows.columns, bad))
        check_ids(rows, log, first_rows)
        for check in (check_single, check_lung, check_times):
            check(rows, log)
        columns = check_values(rows, log, clip=clip)
        with np.errstate(all="ignore"):  # infinite values are problems already
            parts.append(_scanned(rows, columns, bad, keep))
    log.rows = None
    if not parts:
        message = "the file has a header but no rows"
        raise fail(source.file, message, "Write at least one breath.")
    return parts[0] if len(parts) == 1 else _together(parts)


def _scanned(rows: Rows, columns: Columns, bad: Sequence[BadSamples], keep: bool) -> Scanned:
    starts, lengths = rows.breaths.starts, rows.breaths.lengths
    given = columns["time_step"]
    time = complete_times(given, rows.breaths)
    blank = np.isnan(time[starts])
    names = ("u_in", "pressure", *OPTIONAL)
    samples = {name: columns[name] for name in names if name in columns}
    samples["u_out"] = (columns["u_out"] == 1.0).astype(np.int8)
    inside = np.diff(time, append=np.nan)
    inside[starts[1:] - 1] = np.nan
    inside[~np.isfinite(inside)] = np.nan
    return Scanned(
        breath_id=columns["breath_id"][starts],
        R=columns["R"][starts],
        C=columns["C"][starts],
        starts=starts + rows.first,
        lengths=lengths,
        n_inspiratory=leading_zeros(samples["u_out"], rows.breaths),
        interval=time[starts + lengths - 1] / np.maximum(lengths - 1, 1),
        time_blank=blank,
        time_interpolated=np.where(blank, 0, rows.breaths.sums(np.isnan(given))),
        time_shifted=~blank & np.isfinite(given[starts]) & (given[starts] != 0.0),
        steps=np.stack([x.reduceat(inside, starts) for x in (np.fmin, np.fmax)], axis=1),
        figures=breath_figures(time, samples, rows.breaths),
        bad=tuple(replace(bad_samples, rows=bad_samples.rows + rows.first) for bad_samples in bad),
        samples={"time": time, **samples} if keep else {},
    )


def _together(parts: Sequence[Scanned]) -> Scanned:
    """Parts of a file as one."""

    def joined(values: Sequence[Any]) -> Any:
        if isinstance(values[0], dict):
            return {name: joined([x.pop(name) for x in values]) for name in list(values[0])}
        return np.concatenate(values)

    alike: dict[tuple[str, str, float], list[BadSamples]] = {}
    for samples in (samples for part in parts for samples in part.bad):
        value = float(samples.values[0]) if samples.kind == "mark" else 0.0
        alike.setdefault((samples.column, samples.kind, value), []).append(samples)
    total = int(sum(part.lengths.sum() for part in parts))
    bad = tuple(
        replace(
            same[0],
            rows=np.concatenate([x.rows for x in same]),
            values=np.concatenate([x.values for x in same]),
            of=total,
        )
        for same in alike.values()
    )
    names = {each.name for each in fields(Scanned)} - {"bad"}
    return Scanned(bad=bad, **{x: joined([getattr(part, x) for part in parts]) for x in names})
