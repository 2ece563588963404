"""Files of recordings, and tables in memory, as Arrow batches of the columns of the schema.

CSV is fast while the text is sound, and read line by line to explain why it is not.
"""

from __future__ import annotations

import csv
import gzip
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.errors import InputTypeError
from ventbench.base.files import data_beside, sha256
from ventbench.recordings.schema import (
    COLUMNS,
    SHOWN,
    Kind,
    Place,
    RecordingError,
    RecordingProblem,
    check_header,
    fail,
)

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

BLOCK = 2 << 20
"""Bytes of text read at a time (the parser holds a few of them)."""

BATCH = 1 << 17
"""Rows of Parquet read at a time."""

BLANKS = ["", "NaN", "nan", "NA", "N/A", "null"]

#: What files are that hold no table, and the way out, by their first bytes.
_REFUSED = data_beside(__file__, "kinds.toml")["refused"]

#: What messages call a table in memory.
_TABLE = "the table"


@dataclass
class Source:
    """A file, or a table in memory, that is read once, in order."""

    file: str  #: the path as the caller wrote it.
    kind: Kind  #: format.
    names: tuple[str, ...] = field(default=(), init=False)  #: column names.
    #: about columns that are ignored.
    warnings: tuple[RecordingProblem, ...] = field(default=(), init=False)
    #: SHA-256 of the file on disk; None until all is read.
    sha256: str | None = field(default=None, init=False)
    place: str = field(default="line", init=False)  #: what messages count in: ``line`` or ``row``.
    size: int = field(default=0, init=False)  #: bytes, or rows of Parquet.
    done: int = field(default=0, init=False)  #: how much of that has been read.

    def batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the rows in order, with the columns of the schema.

        Raises:
            RecordingError: the file is damaged, or not of numbers.
        """
        raise NotImplementedError

    def locate(self, rows: Collection[int]) -> Mapping[int, Place]:
        """Find data rows, 0 for the first: their lines, or rows from 1, and cells as written."""
        return {row: (row + 1, {}) for row in rows}


@dataclass
class CsvSource(Source):
    """A CSV file, plain or gzipped."""

    def __post_init__(self) -> None:
        """Read and check the header.

        Raises:
            RecordingError: the header is not one of a recording.
        """
        self.names = _header(self.file, self.kind)
        self.warnings = check_header(self.file, self.names, 1)
        self.size = os.path.getsize(self.file)

    def batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the rows in order; see :class:`Source`."""
        import pyarrow as pa

        try:
            with open(self.file, "rb") as stream:
                for batch in self._parsed(stream):
                    # The parser closes its input at the end of the text.
                    self.done = self.size if stream.closed else stream.tell()
                    yield batch
        except pa.ArrowInvalid as error:
            if next(data_lines(self.file, self.kind), None) is not None:  # not a header alone
                problems, total = text_problems(self.file, self.kind, self.names)
                if not problems:
                    raise fail(self.file, str(error).strip().rstrip("."), "Fix the file.") from None
                raise RecordingError(problems, total) from None
        except (OSError, EOFError) as error:
            raise _damaged(self.file, error) from None
        self.sha256 = sha256(Path(self.file))

    def locate(self, rows: Collection[int]) -> Mapping[int, Place]:
        """Find lines and cells; see :class:`Source`."""
        places, last = {}, max(rows, default=-1)
        for row, (number, text) in enumerate(data_lines(self.file, self.kind)):
            if row in rows:
                places[row] = (number, dict(zip(self.names, _cells(text) or (), strict=False)))
            if row >= last:
                break
        return places

    def _parsed(self, file: IO[bytes]) -> Iterator[pa.RecordBatch]:
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        stream = pa.PythonFile(file, "r")
        if self.kind == "csv.gz":
            stream = pa.CompressedInputStream(stream, "gzip")
        integers = {name: column.integer for name, column in COLUMNS.items() if name in self.names}
        convert = arrow_csv.ConvertOptions(
            column_types={
                name: pa.int64() if is_integer else pa.float64()
                for name, is_integer in integers.items()
            },
            include_columns=list(integers),
            null_values=BLANKS,
        )
        options = arrow_csv.ReadOptions(
            block_size=BLOCK, skip_rows=1, column_names=list(self.names)
        )
        yield from arrow_csv.open_csv(stream, read_options=options, convert_options=convert)


def _header(file: str, kind: Kind) -> tuple[str, ...]:
    try:
        with open_bytes(file, kind) as stream:
            first = stream.readline(1 << 16)
    except (OSError, EOFError) as error:
        raise _damaged(file, error) from None
    try:
        text = first.decode("utf-8-sig").rstrip("\r\n")
    except UnicodeDecodeError as error:
        message = f"byte 0x{first[error.start]:02x} is not UTF-8"
        advice = "Save the file as UTF-8 text; `ventbench data import` reads others."
        raise fail(file, message, advice, 1) from None
    if "\r" in text:
        raise fail(file, "lines end in CR alone", "Save the file with LF or CRLF line ends.", 1)
    if not text.strip():
        raise fail(file, "the first line is blank", "Put the header there.", 1)
    return tuple(next(csv.reader([text])))


def data_lines(file: str, kind: Kind) -> Iterator[tuple[int, bytes]]:
    """Yield each data row's line number (the header is line 1) and its bytes; skip blank lines."""
    with open_bytes(file, kind) as stream:
        number = 0
        for line in stream:
            for text in line.splitlines():  # a lone CR ends a line too, as in the parser
                number += 1
                if text and number > 1:
                    yield number, text


def text_problems(
    file: str, kind: Kind, names: Sequence[str]
) -> tuple[list[RecordingProblem], int]:
    """Cells that are not numbers and rows of too few or too many cells: the first, and how many."""
    problems: list[RecordingProblem] = []
    total = 0
    for number, text in data_lines(file, kind):
        in_line = _in_line(file, number, text, names)
        total += len(in_line)
        problems += in_line[: SHOWN - len(problems)]
    return problems, total


def _in_line(file: str, number: int, text: bytes, names: Sequence[str]) -> list[RecordingProblem]:
    cells = _cells(text)
    if cells is None:
        return [RecordingProblem(file, "the line is not CSV", "Fix the row.", number)]
    if len(cells) != len(names):
        message = f"the row has {len(cells)} cells, but the header has {len(names)} columns"
        return [RecordingProblem(file, message, "Fix the row.", number)]
    problems = []
    for name, cell in zip(names, cells, strict=True):
        if name in COLUMNS and not _is_sound(cell, COLUMNS[name].integer):
            kind = "a whole number" if COLUMNS[name].integer else "a number"
            value = cell if len(cell) <= 40 else cell[:37] + "..."
            message, advice = f"{value!r} is not {kind}", "Fix the cell."
            try:
                text.decode()
            except UnicodeDecodeError as error:
                message += f" (byte 0x{text[error.start]:02x} is not UTF-8)"
                advice = "Save the file as UTF-8 text."
            problems.append(RecordingProblem(file, message, advice, number, name, value))
    return problems


def _is_sound(cell: str, integer: bool) -> bool:
    """Whether the parser takes a cell, as far as Python's numbers are its own."""
    try:
        number = int(cell) if integer else float(cell)
    except ValueError:
        return cell in BLANKS
    return "_" not in cell and (not integer or abs(number) < 1 << 63)


def _cells(text: bytes) -> list[str] | None:
    try:
        return next(csv.reader([text.decode("utf-8", "backslashreplace")]))
    except csv.Error:
        return None


def open_bytes(path: str | os.PathLike[str], kind: Kind) -> IO[bytes]:
    """Open the bytes of a CSV file, decompressed."""
    if kind == "csv.gz":
        return gzip.open(path, "rb")  # type: ignore[return-value]
    return open(path, "rb")


@dataclass
class ParquetSource(Source):
    """A Parquet file, or a table in memory."""

    kind: Kind = "parquet"
    table: pa.Table | None = None  #: the table in memory; None for Parquet.

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

    def batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the rows in order; see :class:`Source`."""
        import pyarrow as pa
        from pyarrow import parquet

        columns = [name for name in COLUMNS if name in self.names]
        try:
            if self.table is not None:
                self.done = self.size = self.table.num_rows
                yield from self.table.select(columns).to_batches()
            else:
                with parquet.ParquetFile(self.file) as stream:
                    self.size = stream.metadata.num_rows
                    for batch in stream.iter_batches(BATCH, columns=columns):
                        self.done += batch.num_rows
                        yield batch
            self.sha256 = None if self.kind == "table" else sha256(Path(self.file))
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.file, error) from None


def _check_type(file: str, name: str, kind: pa.DataType) -> Iterator[RecordingProblem]:
    from pyarrow import types

    if COLUMNS[name].integer:
        good, needed = types.is_integer(kind), "int64"
    else:
        good, needed = types.is_integer(kind) or types.is_floating(kind), "double"
        good = good or (name == "u_out" and types.is_boolean(kind))
    if not good:
        message = f"the column has type {kind}, but numbers are needed"
        yield RecordingProblem(
            file, message, f"Write it as {needed}.", None, name, str(kind), "row"
        )


def _damaged(file: str, error: Exception) -> RecordingError:
    text = str(error).strip().splitlines()[0].rstrip(".")
    return fail(file, f"the file cannot be read ({text})", "Write or copy it again.")


def to_numpy(array: pa.Array | pa.ChunkedArray, integer: bool = False) -> NDArray[Any]:
    """Numbers of Arrow as float64, NaN where blank, or int64, 0 there; its own way needs pandas."""
    import pyarrow as pa

    kind, blank = (pa.int64(), 0) if integer else (pa.float64(), float("nan"))
    array = array.combine_chunks() if isinstance(array, pa.ChunkedArray) else array
    array = array.cast(pa.int8()) if pa.types.is_boolean(array.type) else array
    array = array.cast(kind, safe=False)  # counters beyond 2^53 are rounded
    return np.from_dlpack(array.fill_null(blank) if array.null_count else array)


def open_source(path: str | os.PathLike[str] | pd.DataFrame) -> Source:
    """Open a file, or a table in memory, and check its header.

    Raises:
        InputTypeError: it is neither.
        RecordingError: the file cannot be read or is no recording.
    """
    if not isinstance(path, str | os.PathLike):
        return _table_source(path)
    kind = kind_of(path)
    return ParquetSource(str(path)) if kind == "parquet" else CsvSource(str(path), kind)


def _table_source(frame: object) -> ParquetSource:
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
        message = f"the table cannot be read ({str(error).splitlines()[0]})"
        raise fail(_TABLE, message, "Write numbers in every column.") from None
    return ParquetSource(_TABLE, "table", table)


def first_bytes(path: str | os.PathLike[str]) -> bytes:
    """The beginning of a file that may hold a table.

    Raises:
        RecordingError: no such file, a folder, no permission, empty, or one of ``kinds.toml``.
    """
    name = str(path)
    try:
        if Path(path).is_dir():
            raise fail(name, "this is a folder", "Name one file in it.")
        with open(path, "rb") as stream:
            first = stream.read(128)
    except FileNotFoundError:
        raise fail(name, "there is no such file", "Check the path.") from None
    except OSError as error:
        advice = "Check its permissions."
        raise fail(name, f"the file cannot be read ({error.strerror})", advice) from None
    if not first:
        raise fail(name, "the file is empty", "Write a header and at least one breath.")
    for begins, (what, advice) in _REFUSED.items():
        if first.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(begins.encode("latin-1")):
            raise fail(name, f"this is {what}", f"{advice}.")
    return first


def kind_of(path: str | os.PathLike[str]) -> Kind:
    """Return the format of a file by its first bytes; its name only improves the error message.

    Raises:
        RecordingError: as :func:`first_bytes` does, or it is of another format.
    """
    name, first = str(path), first_bytes(path)
    if first.startswith(b"PAR1"):
        return "parquet"
    if name.endswith((".parquet", ".pq")):
        advice = "Write it again, or name it .csv if it is text."
        raise fail(name, "this is not a Parquet file", advice)
    if first.startswith(b"\x1f\x8b"):
        return "csv.gz"
    format_name = {b"MATL": "MATLAB", b"\x93NUM": "NumPy"}.get(first[:4])
    if first.startswith(b"PK\x03\x04"):
        format_name = {".xlsx": "spreadsheet", ".npz": "NumPy"}.get(Path(name).suffix)
        if format_name is None:
            raise fail(name, "this is a zip archive", "Unpack it and name the CSV file in it.")
    if format_name:
        advice = "Bring it into the schema with `ventbench data import`."
        raise fail(name, f"this is a {format_name} file", advice)
    if first.startswith((b"\xff\xfe", b"\xfe\xff")):
        advice = "Save the file as UTF-8; `ventbench data import` reads it as it is."
        raise fail(name, "this is UTF-16 text", advice)
    return "csv"
