"""Reading CSV in blocks: fast while the text is sound, line by line to explain why it is not."""

from __future__ import annotations

import csv
import gzip
import os
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

from ventbench.base.files import sha256
from ventbench.recordings.rows import Chunk, Source, chunks_of
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
    import pyarrow as pa

BLOCK = 8 << 20
"""Bytes of text read at a time (the parser holds a few of them)."""

BLANKS = ["", "NaN", "nan", "NA", "N/A", "null"]


@dataclass
class CsvSource(Source):
    """A CSV file, plain or gzipped."""

    block: int = BLOCK  #: bytes of text that are read at a time.

    def __post_init__(self) -> None:
        """Read and check the header.

        Raises:
            RecordingError: the header is not one of a recording.
        """
        self.names = _header(self.file, self.kind)
        self.warnings = check_header(self.file, self.names, 1)
        self.size = os.path.getsize(self.file)

    def chunks(self) -> Iterator[Chunk]:
        """Yield the rows in order; see :class:`Source`."""
        import pyarrow as pa

        try:
            with open(self.file, "rb") as stream:
                for chunk in chunks_of(self._batches(stream)):
                    # The parser closes its input at the end of the text.
                    self.done = self.size if stream.closed else stream.tell()
                    yield chunk
        except pa.ArrowInvalid as error:
            if next(data_lines(self.file, self.kind), None) is not None:  # not a header alone
                problems, total = text_problems(self.file, self.kind, self.names)
                if not problems:
                    raise fail(self.file, str(error).strip().rstrip("."), "Fix the file.") from None
                raise RecordingError(problems, total) from None
        except (OSError, EOFError) as error:
            advice = "Copy or download the file again."
            raise fail(self.file, f"the file cannot be read ({error})", advice) from None
        self.sha256 = sha256(Path(self.file))

    def _batches(self, file: IO[bytes]) -> Iterator[pa.RecordBatch]:
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        stream = pa.PythonFile(file, "r")
        if self.kind == "csv.gz":
            stream = pa.CompressedInputStream(stream, "gzip")
        whole = {name: column.whole for name, column in COLUMNS.items() if name in self.names}
        convert = arrow_csv.ConvertOptions(
            column_types={name: pa.int64() if is_whole else pa.float64()
                          for name, is_whole in whole.items()},
            include_columns=list(whole),
            null_values=BLANKS,
        )  # fmt: skip
        options = arrow_csv.ReadOptions(
            block_size=self.block, skip_rows=1, column_names=list(self.names)
        )
        yield from arrow_csv.open_csv(stream, read_options=options, convert_options=convert)


def _header(file: str, kind: Kind) -> tuple[str, ...]:
    try:
        with open_bytes(file, kind) as stream:
            first = stream.readline(1 << 16)
    except (OSError, EOFError) as error:
        advice = "Copy or download the file again."
        raise fail(file, f"the file cannot be read ({error})", advice) from None
    try:
        text = first.decode("utf-8-sig").rstrip("\r\n")
    except UnicodeDecodeError as error:
        what = f"byte 0x{first[error.start]:02x} is not UTF-8"
        raise fail(file, what, "Save the file as UTF-8 text.", 1) from None
    if "\r" in text:
        raise fail(file, "lines end in CR alone", "Save the file with LF or CRLF line ends.", 1)
    if not text.strip():
        raise fail(file, "the first line is blank", "Put the header there.", 1)
    return tuple(next(csv.reader([text])))


#: A cell that is sound, as regular expressions; the parser accepts the same ones.
_BLANK = "|".join([text for text in BLANKS if text]) + "|"
_DECIMAL = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_FLOAT = rf"[ \t]*[+-]?(?:{_DECIMAL}|(?i:nan|inf|infinity))[ \t]*|{_BLANK}"
_WHOLE = rf"[ \t]*-?[0-9]{{1,18}}[ \t]*|{_BLANK}"
_LARGEST = (1 << 63) - 1


def data_lines(file: str, kind: Kind) -> Iterator[tuple[int, bytes]]:
    """Yield each data row's line number (the header is line 1) and its bytes; skip blank lines."""
    with open_bytes(file, kind) as stream:
        number = 0
        for line in stream:
            for text in line.splitlines():  # a lone CR ends a line too, as in the parser
                number += 1
                if text and number > 1:
                    yield number, text


def locate_rows(
    file: str, kind: Kind, names: Sequence[str], rows: Collection[int]
) -> dict[int, Place]:
    """Find data rows, 0 for the first, in a file: line, and cells as written by column."""
    places = {}
    last = max(rows, default=-1)
    for row, (number, text) in enumerate(data_lines(file, kind)):
        if row in rows:
            places[row] = (number, dict(zip(names, _cells(text) or (), strict=False)))
        if row >= last:
            break
    return places


def text_problems(
    file: str, kind: Kind, names: Sequence[str]
) -> tuple[list[RecordingProblem], int]:
    """Cells that are not numbers and rows of too few or too many cells: the first, and how many."""
    sound = re.compile(",".join(map(_pattern, names)).encode())
    cell_patterns = {name: re.compile(_pattern(name)) for name in names if name in COLUMNS}
    problems: list[RecordingProblem] = []
    total = 0
    for number, text in data_lines(file, kind):
        if sound.fullmatch(text):
            continue
        in_line = _in_line(file, number, text, names, cell_patterns)
        total += len(in_line)
        problems += in_line[: SHOWN - len(problems)]
    return problems, total


def _pattern(name: str) -> str:
    if name not in COLUMNS:
        return '[^,"]*'
    return f"(?:{_WHOLE if COLUMNS[name].whole else _FLOAT})"


def _in_line(
    file: str, number: int, text: bytes, names: Sequence[str],
    patterns: dict[str, re.Pattern[str]],
) -> list[RecordingProblem]:  # fmt: skip
    cells = _cells(text)
    if cells is None:
        return [RecordingProblem(file, "the line is not CSV", "Fix the row.", number)]
    if len(cells) != len(names):
        what = f"the row has {len(cells)} cells, but the header has {len(names)} columns"
        return [RecordingProblem(file, what, "Fix the row.", number)]
    problems = []
    for name, cell in zip(names, cells, strict=True):
        if name in patterns and not (patterns[name].fullmatch(cell) or _fits(cell, name)):
            kind = "a whole number" if COLUMNS[name].whole else "a number"
            value = cell if len(cell) <= 40 else cell[:37] + "..."
            what, advice = f"{value!r} is not {kind}", "Fix the cell."
            try:
                text.decode()
            except UnicodeDecodeError as error:
                what += f" (byte 0x{text[error.start]:02x} is not UTF-8)"
                advice = "Save the file as UTF-8 text."
            problems.append(RecordingProblem(file, what, advice, number, name, value))
    return problems


def _cells(text: bytes) -> list[str] | None:
    try:
        return next(csv.reader([text.decode("utf-8", "backslashreplace")]))
    except csv.Error:
        return None


def _fits(cell: str, name: str) -> bool:
    """Whether an integer of 19 digits fits 64 bits."""
    plain = cell.strip(" \t")
    digits = plain.removeprefix("-")
    if not (COLUMNS[name].whole and digits.isascii() and digits.isdigit() and len(digits) == 19):
        return False
    return -_LARGEST - 1 <= int(plain) <= _LARGEST


def open_bytes(path: str | os.PathLike[str], kind: Kind) -> IO[bytes]:
    """Open the bytes of a CSV file, decompressed."""
    if kind == "csv.gz":
        return gzip.open(path, "rb")  # type: ignore[return-value]
    return open(path, "rb")
