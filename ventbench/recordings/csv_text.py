"""The second, slower look at a CSV file: which line, and which cell is no number."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator, Sequence

from ventbench.recordings.errors import SHOWN, Problem
from ventbench.recordings.files import Kind, open_bytes
from ventbench.recordings.findings import Place
from ventbench.recordings.schema import COLUMNS

_BLANK = "NaN|nan|NA|N/A|null|"
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
    """Find data rows in the text.

    Args:
        file: path.
        kind: `csv` or `csv.gz`.
        names: column names of the header.
        rows: data row numbers, 0 for the first.

    Returns:
        For each row its line and its cells as written, by column.
    """
    found = {}
    last = max(rows, default=-1)
    for row, (number, text) in enumerate(data_lines(file, kind)):
        if row in rows:
            found[row] = (number, dict(zip(names, _cells(text) or (), strict=False)))
        if row >= last:
            break
    return found


def text_problems(file: str, kind: Kind, names: Sequence[str]) -> tuple[list[Problem], int]:
    """List the cells that are not numbers and the rows that have too few or too many cells.

    Args:
        file: path.
        kind: `csv` or `csv.gz`.
        names: column names of the header.

    Returns:
        The first `SHOWN` problems, and the count of all.
    """
    patterns = [_pattern(name) for name in names]
    sound = re.compile(",".join(patterns).encode())
    cell_patterns = {name: re.compile(_pattern(name)) for name in names if name in COLUMNS}
    problems: list[Problem] = []
    total = 0
    for number, text in data_lines(file, kind):
        if sound.fullmatch(text):
            continue
        found = _in_line(file, number, text, names, cell_patterns)
        total += len(found)
        problems += found[: SHOWN - len(problems)]
    return problems, total


def _pattern(name: str) -> str:
    if name not in COLUMNS:
        return '[^,"]*'
    return f"(?:{_WHOLE if COLUMNS[name].whole else _FLOAT})"


def _in_line(
    file: str,
    number: int,
    text: bytes,
    names: Sequence[str],
    patterns: dict[str, re.Pattern[str]],
) -> list[Problem]:
    cells = _cells(text)
    if cells is None:
        return [Problem(file, "the line is not CSV", "Fix the row.", number)]
    if len(cells) != len(names):
        what = f"the row has {len(cells)} cells, but the header has {len(names)} columns"
        return [Problem(file, what, "Fix the row.", number)]
    found = []
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
            found.append(Problem(file, what, advice, number, name, value))
    return found


def _cells(text: bytes) -> list[str] | None:
    try:
        return next(csv.reader([text.decode("utf-8", "backslashreplace")]))
    except csv.Error:
        return None


def _fits(cell: str, name: str) -> bool:
    """Whether a long whole number fits 64 bits."""
    plain = cell.strip(" \t")
    digits = plain.removeprefix("-")
    if not (COLUMNS[name].whole and digits.isascii() and digits.isdigit() and len(digits) == 19):
        return False
    return -_LARGEST - 1 <= int(plain) <= _LARGEST
