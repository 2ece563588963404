"""Rows of a file as flat arrays: chunks as they are read, regrouped into whole breaths, checked.

Checks of values, breaths and times only add to a `ProblemLog`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ventbench.recordings.schema import COLUMNS, Column, Kind, ProblemLog, RecordingProblem

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Chunk:
    """Consecutive rows of a file, as read."""

    row0: int  #: the first row's number in the file, 0 for the first data row.
    #: arrays by column name, each (m,): int64 for id and breath_id, float64 with NaN for blank
    #: otherwise, in the units of the schema.
    columns: dict[str, np.ndarray]
    #: rows with a blank breath_id, (m,) bool; breath_id then repeats the one before.
    blank_id: np.ndarray

    def __len__(self) -> int:
        """Number of rows m."""
        return len(self.blank_id)

    def cut(self, start: int, stop: int) -> Chunk:
        """Rows start..stop-1, as views."""
        columns = {name: values[start:stop] for name, values in self.columns.items()}
        return Chunk(self.row0 + start, columns, self.blank_id[start:stop])


@dataclass(frozen=True)
class Rows(Chunk):
    """Rows of whole breaths."""

    starts: np.ndarray  #: index of each breath's first row, (k,), k >= 1.

    @property
    def lengths(self) -> np.ndarray:
        """Rows in each breath, (k,)."""
        return np.diff(self.starts, append=len(self))


def whole_breaths(chunks: Iterable[Chunk]) -> Iterator[Rows]:
    """Regroup chunks of a file, in order, so that none ends inside a breath."""
    held: list[Chunk] = []
    for chunk in chunks:
        held.append(chunk)
        if held[0].columns["breath_id"][0] != chunk.columns["breath_id"][-1]:
            rows = _join(held)
            # The last breath may continue in the next chunk.
            last = int(_starts(rows)[-1])
            yield _whole(rows.cut(0, last))
            held = [rows.cut(last, len(rows))]
    if held:
        yield _whole(_join(held))


def _starts(chunk: Chunk) -> np.ndarray:
    ids = chunk.columns["breath_id"]
    return np.append(0, np.flatnonzero(ids[1:] != ids[:-1]) + 1)


def _whole(rows: Chunk) -> Rows:
    return Rows(rows.row0, rows.columns, rows.blank_id, _starts(rows))


def _join(chunks: list[Chunk]) -> Chunk:
    if len(chunks) == 1:
        return chunks[0]
    columns = {
        name: np.concatenate([chunk.columns[name] for chunk in chunks])
        for name in chunks[0].columns
    }
    blank = np.concatenate([chunk.blank_id for chunk in chunks])
    return Chunk(chunks[0].row0, columns, blank)


@dataclass
class Source:
    """A file, or a table in memory, that is read once, in order."""

    file: str  #: the path as the caller wrote it.
    kind: Kind  #: format.
    names: tuple[str, ...] = field(default=(), init=False)  #: column names.
    #: about columns that are ignored.
    warnings: tuple[RecordingProblem, ...] = field(default=(), init=False)
    #: SHA-256 of the file on disk; None until all chunks are read.
    sha256: str | None = field(default=None, init=False)
    place: str = field(default="line", init=False)  #: what messages count in: ``line`` or ``row``.
    size: int = field(default=0, init=False)  #: bytes, or rows of Parquet.
    done: int = field(default=0, init=False)  #: how much of that has been read.

    def chunks(self) -> Iterator[Chunk]:
        """Yield the rows in order.

        Raises:
            RecordingError: the file is damaged, or not of numbers.
        """
        raise NotImplementedError


def chunks_of(batches: Iterable[pa.RecordBatch]) -> Iterator[Chunk]:
    """Convert the Arrow batches of a file, in order; empty ones are left out."""
    row0, last_id = 0, None
    for batch in batches:
        if batch.num_rows:
            chunk = _chunk_of_batch(batch, row0, last_id)
            yield chunk
            row0 += len(chunk)
            last_id = int(chunk.columns["breath_id"][-1])


def _chunk_of_batch(batch: pa.RecordBatch, row0: int, last_id: int | None) -> Chunk:
    """Convert a batch of known columns in any numeric type.

    A blank breath_id at its start is ``last_id``, that of the row before, or the first one known.
    """
    columns = {}
    blank_id = np.zeros(batch.num_rows, dtype=bool)
    for name in batch.schema.names:
        values, blank = _numpy(batch.column(name), COLUMNS[name].whole)
        if name == "breath_id" and blank is not None:
            blank_id = blank
            before = np.maximum.accumulate(np.where(blank, -1, np.arange(len(values))))
            first = values[int(np.argmin(blank))] if last_id is None else last_id
            values = np.where(before < 0, first, values[before])
        columns[name] = values
    return Chunk(row0, columns, blank_id)


def _numpy(array: pa.Array, whole: bool) -> tuple[np.ndarray, np.ndarray | None]:
    import pyarrow as pa

    if whole:
        blank = array.is_null().to_numpy(zero_copy_only=False) if array.null_count else None
        filled = array.fill_null(0) if array.null_count else array
        return filled.cast(pa.int64()).to_numpy(zero_copy_only=False), blank
    if array.type != pa.float64():
        array = array.cast(pa.int8()) if pa.types.is_boolean(array.type) else array
        array = array.cast(pa.float64())
    return array.to_numpy(zero_copy_only=False), None


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
            log.add(rows.row0 + at, name, what, "Fix the row.", values=values[at])
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
            _add_once(rows.row0 + at, name, what, advice, values[at], log)
        else:
            log.add(rows.row0 + at, name, what, advice, values=values[at], level=level)
    return columns


def _add_once(
    at: np.ndarray, name: str, what: str, advice: str, values: np.ndarray, log: ProblemLog
) -> None:
    """Report a value that many rows repeat once, whatever blocks the file is read in."""
    kinds, first, counts = np.unique(values, return_index=True, return_counts=True)
    often = counts >= _OFTEN
    single = ~np.isin(values, kinds[often])
    log.add(at[single], name, what, advice, values=values[single])
    for row, value in zip(first[often], kinds[often], strict=True):
        log.add_once(int(at[row]), name, f"{what}, here and in more rows", advice, value)


def _add_blank(rows: Rows, log: ProblemLog, name: str, blank: np.ndarray) -> None:
    if blank.any():
        what = f"the cell is blank, but {name} is needed in every row"
        at = rows.row0 + np.flatnonzero(blank)
        values = np.full(len(at), np.nan)
        log.add(at, name, what, "Fill it in or remove the breath.", values=values)


def _outside(values: np.ndarray, column: Column) -> np.ndarray:
    if column.name == "u_out":
        return (values != 0.0) & (values != 1.0) & ~np.isnan(values)
    low = values <= column.low if column.positive else values < column.low
    return low | (values > column.high)


def check_ids(rows: Rows, log: ProblemLog, seen: dict[int, int]) -> None:
    """Check that the rows of each breath follow one another.

    ``seen`` holds the first row of each breath so far, by breath_id; new breaths are added.
    """
    again, first = [], []
    starts = rows.row0 + rows.starts
    ids = rows.columns["breath_id"][rows.starts]
    for breath, row in zip(ids.tolist(), starts.tolist(), strict=True):
        earlier = seen.setdefault(breath, row)
        if earlier != row:
            again.append(row)
            first.append(earlier)
    what = "breath {value} comes again, it is already at {other}"
    advice = "Keep the rows of a breath together, and give each breath an id of its own."
    at = np.array(again, dtype=np.int64)
    values, others = rows.columns["breath_id"][at - rows.row0], np.array(first, dtype=np.int64)
    log.add(at, "breath_id", what, advice, values=values, others=others)


def check_lung(rows: Rows, log: ProblemLog) -> None:
    """Check that R and C stay the same within each breath."""
    breath = np.repeat(np.arange(len(rows.starts)), rows.lengths)
    for name in ("R", "C"):
        values = rows.columns[name]
        first = values[rows.starts][breath]
        with np.errstate(invalid="ignore"):
            at = np.flatnonzero((values != first) & ~np.isnan(values) & ~np.isnan(first))
        if len(at) == 0:
            continue
        at = at[np.unique(breath[at], return_index=True)[1]]
        what = f"{name} changes to {{value}} within the breath, which starts at {{other}}"
        advice = "A breath has one lung: give the second part its own breath_id, or fix the row."
        others = rows.row0 + rows.starts[breath[at]]
        log.add(rows.row0 + at, name, what, advice, values=values[at], others=others)


def check_single(rows: Rows, log: ProblemLog) -> None:
    """Check that each breath has at least two samples."""
    at = rows.starts[rows.lengths == 1]
    what = "breath {value} has one sample, at least two are needed"
    advice = "Remove it, or keep the rows of a breath together."
    log.add(rows.row0 + at, "breath_id", what, advice, values=rows.columns["breath_id"][at])


def check_row_ids(rows: Rows, log: ProblemLog, last: int | None) -> int:
    """Warn where the column id, which is not used otherwise, does not increase.

    Takes the id of the row before, None at the start, and returns the last id.
    """
    ids = rows.columns["id"]
    before = np.concatenate([ids[:1] - 1 if last is None else [last], ids[:-1]])
    at = np.flatnonzero(ids <= before)
    what = "id {value} is not greater than the one before"
    advice = "Number the rows 1, 2, 3, ...; the column is not used for anything else."
    log.add(rows.row0 + at, "id", what, advice, values=ids[at], level="warning")
    return int(ids[-1])


_SORT = "Sort the rows of the breath by time_step, and remove rows that are there twice."


def check_times(rows: Rows, log: ProblemLog) -> None:
    """Check that the known times increase within each breath.

    Repeated rows are reported as such. In breaths without times, a row is a repeat if it equals the
    row before in every column, including `id`.
    """
    time = rows.columns["time_step"]
    breath = np.repeat(np.arange(len(rows.starts)), rows.lengths)
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
        log.add(rows.row0 + at, "time_step", what, _SORT, values=time[at],
                     others=rows.row0 + before)  # fmt: skip


def _add_repeat(
    rows: Rows, log: ProblemLog, previous: np.ndarray, here: np.ndarray, column: str,
    values: np.ndarray,
) -> None:  # fmt: skip
    what, advice = "the row repeats {other}", "Remove one of the two."
    others = rows.row0 + previous
    log.add(rows.row0 + here, column, what, advice, values=values[here], others=others)


def _same(rows: Rows, first: np.ndarray, other: np.ndarray, names: object) -> np.ndarray:
    same = np.ones(len(first), dtype=bool)
    for name in names:  # type: ignore[attr-defined]
        a, b = rows.columns[name][first], rows.columns[name][other]
        same &= (a == b) | ((a != a) & (b != b))
    return same
