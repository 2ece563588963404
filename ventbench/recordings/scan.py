"""A file as checked blocks of whole breaths, which `load` and `check` share.

Parquet is read here in batches, CSV in :mod:`ventbench.recordings.csv_source`.

Blank times: a few in a breath are interpolated, those of a whole breath are inferred. Inspiration
lasts 1.0 s, so a breath whose first n samples have u_out = 0 has an interval near 1.0 s / n. The
ventilators behind a file have few different intervals (PVP: 31.9 and 34.0 ms), so a better estimate
is the median interval of the file's breaths with the same n, if there are at least `ENOUGH` of
them. On the 135 PVP breaths whose times are known, leaving each out, the median estimate is off by
0.12 ms in the median, 0.34 ms at 90 % and 2.9 ms at worst; 1.0 s / n is off by 0.41, 0.71 and 3.5
ms. If u_out never switches, n says nothing and the median of all breaths is taken.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench.base.errors import InputTypeError, require
from ventbench.base.files import sha256
from ventbench.recordings.csv_source import CsvSource, locate_rows
from ventbench.recordings.rows import (
    Chunk,
    Rows,
    Source,
    check_ids,
    check_lung,
    check_row_ids,
    check_single,
    check_times,
    check_values,
    chunks_of,
    whole_breaths,
)
from ventbench.recordings.schema import (
    COLUMNS,
    Kind,
    Place,
    ProblemLog,
    RecordingError,
    RecordingProblem,
    check_header,
    fail,
)

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


#: What messages call a table in memory.
_TABLE = "the table"

BATCH = 1 << 17
"""Rows read at a time."""


@dataclass
class ParquetSource(Source):
    """A Parquet file, a spreadsheet, or a table in memory."""

    kind: Kind = "parquet"
    table: pa.Table | None = None  #: the table in memory; None for Parquet.
    batch: int = BATCH  #: rows that are read at a time.

    def __post_init__(self) -> None:
        """Read and check names and types.

        Raises:
            RecordingError: the file is damaged, or its columns are not those of a recording.
        """
        import pyarrow as pa
        from pyarrow import parquet

        self.place = "row"
        try:
            schema = parquet.read_schema(self.file) if self.table is None else self.table.schema
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.file, error) from None
        self.names = tuple(schema.names)
        self.warnings = check_header(self.file, self.names, None)
        problems = [
            problem
            for name in self.names
            if name in COLUMNS
            for problem in _check_type(self.file, name, schema.field(name).type)
        ]
        if problems:
            raise RecordingError(problems)

    def chunks(self) -> Iterator[Chunk]:
        """Yield the rows in order; see :class:`Source`."""
        import pyarrow as pa

        known = [name for name in COLUMNS if name in self.names]
        try:
            for chunk in chunks_of(self._batches(known)):
                self.done = chunk.row0 + len(chunk)
                yield chunk
            self.sha256 = None if self.kind == "table" else sha256(Path(self.file))
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.file, error) from None

    def _batches(self, columns: list[str]) -> Iterator[pa.RecordBatch]:
        from pyarrow import parquet

        if self.table is not None:
            self.size = self.table.num_rows
            yield from self.table.select(columns).to_batches(self.batch)
            return
        with parquet.ParquetFile(self.file) as stream:
            self.size = stream.metadata.num_rows
            yield from stream.iter_batches(self.batch, columns=columns)


def _check_type(file: str, name: str, kind: pa.DataType) -> Iterator[RecordingProblem]:
    from pyarrow import types

    if COLUMNS[name].whole:
        good, needed = types.is_integer(kind), "int64"
    else:
        good, needed = types.is_integer(kind) or types.is_floating(kind), "double"
        good = good or (name == "u_out" and types.is_boolean(kind))
    if not good:
        what = f"the column has type {kind}, but numbers are needed"
        yield RecordingProblem(file, what, f"Write it as {needed}.", None, name, str(kind), "row")


def _damaged(file: str, error: Exception) -> RecordingError:
    text = str(error).strip().splitlines()[0].rstrip(".")
    return fail(file, f"the Parquet file cannot be read ({text})", "Write or copy it again.")


def open_source(path: str | os.PathLike[str] | pd.DataFrame) -> Source:
    """Open a file, or a table in memory, and check its header.

    Raises:
        InputTypeError: it is neither.
        RecordingError: the file cannot be read or is no recording.
    """
    if not isinstance(path, str | os.PathLike):
        return _table_source(path)
    kind = kind_of(path)
    if kind == "xlsx":
        return _spreadsheet_source(str(path))
    return ParquetSource(str(path)) if kind == "parquet" else CsvSource(str(path), kind)


def _table_source(frame: object, file: str = _TABLE, kind: Kind = "table") -> ParquetSource:
    import pandas as pd
    import pyarrow as pa

    if not isinstance(frame, pd.DataFrame):
        raise InputTypeError(
            "recording", frame, "a path, a pandas table in the public schema or Breaths"
        )
    named = frame.rename(columns=str)
    try:
        table = pa.Table.from_pandas(named, preserve_index=False)
    except (pa.ArrowException, ValueError) as error:
        what = f"the table cannot be read ({str(error).splitlines()[0]})"
        raise fail(file, what, "Write numbers in every column.") from None
    return ParquetSource(file, kind, table)


def _spreadsheet_source(file: str) -> ParquetSource:
    """First sheet of a workbook; its rows count from the header."""
    import zipfile

    import pandas as pd

    require("openpyxl", extra="excel", what="spreadsheets")
    try:
        frame = pd.read_excel(file)
    except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
        what = f"the spreadsheet cannot be read ({str(error).splitlines()[0]})"
        raise fail(file, what, "Save it again, or as CSV.") from None
    return _table_source(frame, file, "xlsx")


def locate(source: Source, rows: Collection[int]) -> Mapping[int, Place]:
    """Find data rows (0 for the first) in a file: CSV lines and cells, or Parquet rows from 1."""
    if isinstance(source, ParquetSource):
        return {row: (row + 1 + (source.kind == "xlsx"), {}) for row in rows}
    return locate_rows(source.file, source.kind, source.names, rows)


def kind_of(path: str | os.PathLike[str]) -> Kind:
    """Return the format of a file by its first bytes; its name only improves the error message.

    Raises:
        RecordingError: no such file, a folder, no permission, empty, or another format.
    """
    name = str(path)
    try:
        if Path(path).is_dir():
            raise fail(name, "this is a folder", "Name one file in it.")
        with open(path, "rb") as stream:
            first = stream.read(4)
    except FileNotFoundError:
        raise fail(name, "there is no such file", "Check the path.") from None
    except OSError as error:
        advice = "Check its permissions."
        raise fail(name, f"the file cannot be read ({error.strerror})", advice) from None
    if not first:
        raise fail(name, "the file is empty", "Write a header and at least one breath.")
    if first == b"PAR1":
        return "parquet"
    if name.endswith((".parquet", ".pq")):
        advice = "Write it again, or name it .csv if it is text."
        raise fail(name, "this is not a Parquet file", advice)
    if first.startswith(b"\x1f\x8b"):
        return "csv.gz"
    if first.startswith(b"PK\x03\x04") and name.endswith(".xlsx"):
        return "xlsx"
    if first.startswith(b"PK\x03\x04"):
        raise fail(name, "this is a zip archive", "Unpack it and name the CSV file in it.")
    if first.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise fail(name, "this is UTF-16 text", "Save the file as UTF-8.")
    if first in (b"MATL", b"\x89HDF"):
        what = "MATLAB" if first == b"MATL" else "HDF5 (MATLAB 7.3)"
        advice = "Bring it into the schema with `ventbench data import`."
        raise fail(name, f"this is a {what} file", advice)
    return "csv"


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
class Block:
    """k whole breaths with m samples in all."""

    breath_id: np.ndarray  #: (k,) int64.
    R: np.ndarray  #: cmH2O/(L/s), (k,).
    C: np.ndarray  #: mL/cmH2O, (k,).
    first_row: np.ndarray  #: each breath's first data row in the file, from 0, (k,).
    lengths: np.ndarray  #: samples, (k,).
    n_inspiratory: np.ndarray  #: leading samples with u_out = 0, (k,).
    interval: np.ndarray  #: mean sampling interval, s, NaN if times are blank, (k,).
    times: KnownTimes  #: times of the samples, and what was interpolated or shifted.
    #: u_in %, u_out 0/1 (int8), pressure cmH2O, and flow mL/s and volume mL if the file has them,
    #: each (m,).
    samples: dict[str, np.ndarray]


def scan(source: Source, log: ProblemLog, *, clip: bool = False) -> Iterator[Block]:
    """Read and check a file: blocks in its order, of any number of breaths.

    The log receives all problems and warnings except those of the whole file (unequal lengths).
    There are blocks after a problem too; their values must not be used. ``clip`` brings u_in into
    0..100 %.

    Raises:
        RecordingError: the file cannot be parsed.
    """
    seen: dict[int, int] = {}
    last: int | None = None
    for rows in whole_breaths(source.chunks()):
        check_ids(rows, log, seen)
        check_single(rows, log)
        check_lung(rows, log)
        check_times(rows, log)
        last = check_row_ids(rows, log, last)
        columns = check_values(rows, log, clip=clip)
        with np.errstate(all="ignore"):  # infinite values are problems already
            block = _block(rows, columns)
        yield block


def _block(rows: Rows, columns: dict[str, np.ndarray]) -> Block:
    starts, lengths = rows.starts, rows.lengths
    times = known_times(columns["time_step"], starts, lengths)
    keep = ("u_in", "pressure", "flow", "volume")
    samples = {name: columns[name] for name in keep if name in columns}
    samples["u_out"] = (columns["u_out"] == 1.0).astype(np.int8)
    return Block(
        breath_id=columns["breath_id"][starts], R=columns["R"][starts], C=columns["C"][starts],
        first_row=rows.row0 + starts, lengths=lengths,
        n_inspiratory=leading_zeros(samples["u_out"], starts, lengths),
        interval=times.time[starts + lengths - 1] / np.maximum(lengths - 1, 1), times=times,
        samples=samples,
    )  # fmt: skip


def join_blocks(blocks: Sequence[Block]) -> Block:
    """Join one block or more, in order."""
    if len(blocks) == 1:
        return blocks[0]

    def merged(parts: Sequence[Any]) -> Any:
        if isinstance(parts[0], np.ndarray):
            return np.concatenate(parts)
        if isinstance(parts[0], dict):
            return {name: merged([part[name] for part in parts]) for name in parts[0]}
        names = [field.name for field in fields(parts[0])]
        return type(parts[0])(*(merged([getattr(part, name) for part in parts]) for name in names))

    return merged(blocks)
