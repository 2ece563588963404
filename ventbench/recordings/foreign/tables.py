"""Tables of numbers from text with any separator, Parquet and MATLAB files, and their units."""

from __future__ import annotations

import gzip
import re
from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError

#: Lines that decide on separator, decimal mark and header.
_LOOKED_AT = 60

#: Separators, the likelier first.
_SEPARATORS = ("\t", ";", ",", "|")

#: Cells that stand for nothing.
_BLANKS = ("", "nan", "na", "n/a", "null", "none", "-", "--", "#n/a", "inf", "-inf")

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_COMMA_NUMBER = re.compile(r"[+-]?(\d+,?\d*|,\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length.

    Attributes:
        file: path as the caller wrote it.
        columns: values by name, float64 with NaN for blank, ``(m,)``; text only where no cell is a
            number.
        units: units that headers state, by name.
        first_line: line of the first row in a text file, else None.
        scalars: single numbers beside the columns, such as a sampling rate in a MATLAB file.
        notes: what was understood, a sentence each.
    """

    file: str
    columns: dict[str, NDArray[Any]]
    units: dict[str, str] = field(default_factory=dict)
    first_line: int | None = None
    scalars: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))


def read_table(
    path: str | Path, *, separator: str | None = None, decimal: str | None = None
) -> Table:
    """Read a table.

    Args:
        path: text (also gzipped), Parquet or MATLAB (up to version 7).
        separator: separator of the cells; found out if None.
        decimal: ``"."`` or ``","``; found out if None.

    Raises:
        InputError: if the file cannot be read, or holds no table of numbers.
    """
    file, path = str(path), Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"{file} {what}; name a CSV, Parquet or .mat file")
    with open(path, "rb") as stream:
        first = stream.read(128)
    if not first:
        raise InputError(f"{file} is empty")
    if first.startswith(b"PAR1"):
        return _parquet(file)
    if first.startswith(b"MATLAB 5.0"):
        return _matlab(file)
    if first.startswith(b"\x89HDF") or first.startswith(b"MATLAB 7.3"):
        raise InputError(
            f"{file} is HDF5 (MATLAB 7.3 or a log of PyTables); save it with `save(..., '-v7')` in "
            "MATLAB, or export the table as CSV"
        )
    if first.startswith(b"PK\x03\x04"):
        raise InputError(f"{file} is a zip archive or a spreadsheet; unpack it, or save it as CSV")
    return _text(file, separator, decimal)


def _text(file: str, separator: str | None, decimal: str | None) -> Table:
    import pandas as pd

    text, encoding = _decoded(file)
    lines = [line for line in text.splitlines()[:_LOOKED_AT]]
    if not any(line.strip() for line in lines):
        raise InputError(f"{file} holds no text")
    separator = separator or _separator(lines)
    cells = [_cells(line, separator) for line in lines]
    decimal = decimal or _decimal(cells, separator)
    number = _COMMA_NUMBER if decimal == "," else _NUMBER
    width = Counter(len(row) for row in cells if len(row) > 1).most_common(1)
    if not width:
        raise InputError(
            f"{file}: no line has two cells separated by {separator!r}; give --separator"
        )
    start = next(
        k for k, row in enumerate(cells)
        if len(row) == width[0][0] and _numeric(row, number) >= max(0.5 * len(row), 1)
    ) if any(
        len(row) == width[0][0] and _numeric(row, number) >= max(0.5 * len(row), 1)
        for row in cells
    ) else None  # fmt: skip
    if start is None:
        raise InputError(f"{file}: no line of the first {len(lines)} is one of numbers")
    names, units, notes = _header(cells[:start], width[0][0])
    frame = pd.read_csv(
        _Lines(text, start), sep=separator if separator != " " else r"\s+", header=None,
        names=list(range(width[0][0])), decimal=decimal, dtype=str, skip_blank_lines=True,
        keep_default_na=False, quotechar='"', on_bad_lines="error", engine="c",
        index_col=False,
    )  # fmt: skip
    columns: dict[str, NDArray[Any]] = {}
    unreadable = []
    for name, (_, cell_values) in zip(names, frame.items(), strict=True):
        values, odd = _column(cell_values.to_numpy(str), decimal)
        columns[name] = values
        if odd:
            unreadable.append(f"{name}: {odd[0]} cells, such as {odd[1]!r}")
    if unreadable:
        notes.append(f"Cells that are no numbers are blank ({'; '.join(unreadable)}).")
    shown = {"\t": "tab", " ": "blanks"}.get(separator, repr(separator))
    notes.insert(
        0, f"Text ({encoding}), cells separated by {shown}, decimal {decimal!r}, first row in "
        f"line {start + 1}."
    )  # fmt: skip
    return Table(file, columns, units, start + 1, {}, tuple(notes))


def _Lines(text: str, start: int) -> Any:
    import io

    stream = io.StringIO(text)
    for _ in range(start):
        stream.readline()
    return stream


def _decoded(file: str) -> tuple[str, str]:
    with open(file, "rb") as stream:
        data = stream.read()
    if data.startswith(b"\x1f\x8b"):
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError) as error:
            raise InputError(f"{file} cannot be unpacked ({error})") from None
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            return data.decode("utf-16"), "UTF-16"
        except UnicodeDecodeError:
            raise InputError(
                f"{file} begins like UTF-16 text and is none; export it as CSV"
            ) from None
    try:
        return data.decode("utf-8-sig"), "UTF-8"
    except UnicodeDecodeError:
        if b"\x00" in data[:4096]:
            raise InputError(
                f"{file} is no text, Parquet or MATLAB file; export it as CSV"
            ) from None
        return data.decode("latin-1"), "Latin-1"


def _cells(line: str, separator: str) -> list[str]:
    import csv

    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]


def _separator(lines: list[str]) -> str:
    """The separator that divides most lines into equally many cells, and into most of them."""
    best, most = " ", 0.0
    for separator in (*_SEPARATORS, " "):
        counts = Counter(len(_cells(line, separator)) for line in lines if line.strip())
        counts.pop(1, None)
        if counts:
            width, hits = counts.most_common(1)[0]
            # A decimal comma divides lines evenly too, but into cells of which none has a point.
            score = hits + 0.01 * width
            if separator == "," and most >= 0.8 * hits:
                continue
            if separator == " ":
                score *= 0.5
            if score > most:
                best, most = separator, score
    return best


def _decimal(cells: list[list[str]], separator: str) -> str:
    flat = [cell for row in cells for cell in row]
    commas = sum(bool(re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", cell)) for cell in flat)
    points = sum(bool(re.fullmatch(r"[+-]?\d*\.\d+([eE][+-]?\d+)?", cell)) for cell in flat)
    return "," if commas > points else "."


def _numeric(row: list[str], number: re.Pattern[str]) -> int:
    return sum(bool(number.fullmatch(cell)) for cell in row)


def _header(before: list[list[str]], width: int) -> tuple[list[str], dict[str, str], list[str]]:
    """Names and units from the lines above the numbers."""
    rows = [row for row in before if len(row) == width]
    if not rows:
        return [str(k + 1) for k in range(width)], {}, ["There is no header; columns are 1, 2, ..."]
    names_row, units_row = rows[-1], None
    if len(rows) > 1 and all(re.fullmatch(r"[\[(]?[\w%/.µ° -]{0,10}[\])]?", c) for c in rows[-1]):
        known = sum(unit_of(f"x [{cell}]")[1] in _all_units() for cell in rows[-1] if cell)
        if known >= 1:  # a line of units below the line of names
            names_row, units_row = rows[-2], rows[-1]
    names, units = [], {}
    for k, cell in enumerate(names_row):
        name, unit = unit_of(cell.strip().strip("'\"").lstrip("#").strip())
        name = name or str(k + 1)
        while name in names:
            name += "_"
        names.append(name)
        if units_row is not None and units_row[k]:
            unit = unit_of(f"x [{units_row[k].strip('[]()')}]")[1]
        if unit:
            units[name] = unit
    skipped = len(before) - len(rows) + (len(rows) - 1 - (units_row is not None))
    notes = [f"{skipped} lines above the header were skipped."] if skipped > 0 else []
    return names, units, notes


def _all_units() -> set[str]:

    return {unit for units in UNITS.values() for unit in units} - {"1"}


def _column(cells: NDArray[Any], decimal: str) -> tuple[NDArray[Any], tuple[int, str] | None]:
    """Numbers of a column, and how many cells are none; text where none is a number."""
    import pandas as pd

    plain = np.char.strip(cells.astype(str))
    numbers = np.char.replace(plain, ",", ".") if decimal == "," else plain
    values = np.array(pd.to_numeric(pd.Series(numbers), errors="coerce"), float)
    values[~np.isfinite(values)] = np.nan
    blank = np.isin(np.char.lower(plain), _BLANKS)
    odd = np.isnan(values) & ~blank
    if odd.any() and not np.isfinite(values).any():
        return plain, None
    return values, (int(odd.sum()), str(plain[odd][0])) if odd.any() else None


def _parquet(file: str) -> Table:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        frame = parquet.read_table(file).to_pandas()
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{file} cannot be read ({str(error).splitlines()[0]})") from None
    columns, units = {}, {}
    for header in frame.columns:
        name, unit = unit_of(str(header))
        values = frame[header]
        kind = values.dtype.kind
        if kind == "M":
            columns[name] = values.to_numpy("datetime64[ns]").astype(np.int64) * 1e-9
        elif kind in "iufb":
            columns[name] = values.to_numpy(float)
        else:
            columns[name] = values.astype(str).to_numpy(str)
        if unit:
            units[name] = unit
    if not columns or len(frame) == 0:
        raise InputError(f"{file} holds no rows")
    return Table(file, columns, units, None, {}, ("Parquet.",))


def _matlab(file: str) -> Table:
    from scipy.io import loadmat

    try:
        content = loadmat(file, squeeze_me=True, struct_as_record=True)
    except (ValueError, NotImplementedError, OSError, TypeError) as error:
        raise InputError(f"{file} cannot be read as a MATLAB file ({error})") from None
    flat: dict[str, NDArray[Any]] = {}
    scalars: dict[str, float] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _flatten(name, value, flat, scalars)
    if not flat:
        raise InputError(
            f"{file} holds no column of numbers (variables: "
            f"{', '.join(n for n in content if not n.startswith('__')) or 'none'}); a MATLAB table "
            "object must be saved as a struct or as columns"
        )
    length = Counter(len(v) for v in flat.values()).most_common(1)[0][0]
    longest = max(len(v) for v in flat.values())
    same = [name for name, v in flat.items() if len(v) == longest]
    length = longest if len(same) > 1 else length
    columns = {name: v for name, v in flat.items() if len(v) == length}
    # Short names, where they are unique: `data.Paw` is `Paw`.
    last = Counter(name.rpartition(".")[2] for name in columns)
    columns = {
        name.rpartition(".")[2] if last[name.rpartition(".")[2]] == 1 else name: v
        for name, v in columns.items()
    }
    others = [name for name, v in flat.items() if len(v) != length]
    notes = [f"MATLAB file with {len(columns)} columns of {length} rows."]
    if others:
        notes.append(f"Columns of other lengths were left out ({', '.join(others[:5])}).")
    return Table(file, columns, {}, None, scalars, tuple(notes))


def _flatten(
    name: str, value: Any, flat: dict[str, NDArray[Any]], scalars: dict[str, float]
) -> None:
    """Collect the columns and single numbers of a MATLAB variable."""
    array = np.asarray(value)
    if array.dtype.names:  # a struct, or an array of records
        for key in array.dtype.names:
            inner = array[key]
            if inner.dtype == object and inner.ndim == 0:
                _flatten(f"{name}.{key}", inner.item(), flat, scalars)
            elif inner.dtype == object:
                try:
                    _flatten(f"{name}.{key}", np.array([float(x) for x in inner]), flat, scalars)
                except (TypeError, ValueError):
                    continue
            else:
                _flatten(f"{name}.{key}", inner, flat, scalars)
    elif array.dtype.kind in "iufb":
        if array.ndim == 0:
            scalars[name] = float(array)
        elif array.ndim == 1 and len(array) > 1:
            flat[name] = array.astype(float)
        elif array.ndim == 2:
            rows = array if array.shape[0] >= array.shape[1] else array.T
            for k in range(rows.shape[1]):
                flat[f"{name}.{k + 1}"] = rows[:, k].astype(float)


#: Pascal in a centimetre of water (conventional, at 4 degrees Celsius) and of other units.
_PASCAL = {
    "cmH2O": Fraction("98.0665"),
    "mbar": Fraction(100),
    "hPa": Fraction(100),
    "kPa": Fraction(1000),
    "Pa": Fraction(1),
    "mmHg": Fraction("133.322387415"),
    "psi": Fraction("6894.757293168"),
}

#: Factors to the schema's unit, which is the first of each role.
UNITS: dict[str, dict[str, Fraction]] = {
    "pressure": {name: value / _PASCAL["cmH2O"] for name, value in _PASCAL.items()},
    "flow": {
        "mL/s": Fraction(1),
        "L/s": Fraction(1000),
        "L/min": Fraction(50, 3),
        "mL/min": Fraction(1, 60),
        "L/h": Fraction(5, 18),
    },
    "volume": {"mL": Fraction(1), "L": Fraction(1000)},
    "time": {
        "s": Fraction(1),
        "ms": Fraction(1, 1000),
        "us": Fraction(1, 1_000_000),
        "min": Fraction(60),
    },
    "u_in": {"%": Fraction(1), "1": Fraction(100)},
}

_SPELLINGS = {
    "lpm": "L/min", "slpm": "L/min", "l/min": "L/min", "lps": "L/s", "l/s": "L/s", "ml/s": "mL/s",
    "ml/min": "mL/min", "cmh2o": "cmH2O", "cm h2o": "cmH2O", "cmh20": "cmH2O", "ml": "mL",
    "l": "L", "sec": "s", "seconds": "s", "msec": "ms", "µs": "us", "percent": "%", "0..1": "1",
    "0-1": "1", "hpa": "hPa", "kpa": "kPa", "pa": "Pa", "mmhg": "mmHg", "l/h": "L/h",
}  # fmt: skip


@dataclass(frozen=True)
class Conversion:
    """An exact change of units.

    Attributes:
        unit: unit in the file.
        to: unit of the schema.
        factor: one ``unit`` in ``to``; its reciprocal is the exact way back.
    """

    unit: str
    to: str
    factor: Fraction

    def apply(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert; one rounding to the nearest number at most for each of two integers."""
        return _times(values, self.factor)

    def invert(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert back to the unit of the file."""
        return _times(values, 1 / self.factor)

    def __str__(self) -> str:
        """The change in words, with the way back."""
        if self.factor == 1:
            return self.to
        return f"{self.unit} -> {self.to}, x {_in_words(self.factor)} (back: x {_in_words(1 / self.factor)})"  # noqa: E501


def conversion(role: str, unit: str | None) -> Conversion:
    """Return the change from a unit to the schema's.

    Args:
        role: ``pressure``, ``flow``, ``volume``, ``time`` or ``u_in``.
        unit: unit in the file; that of the schema if None.

    Raises:
        InputError: if the role has no such unit.
    """
    known = UNITS[role]
    to = next(iter(known))
    name = to if unit is None else spelled(unit)
    if name not in known:
        raise InputError(
            f"{unit!r} is no unit of {role} that is known; choose one of {', '.join(known)}"
        )
    return Conversion(name, to, known[name])


def spelled(unit: str) -> str:
    """Return the usual spelling of a unit."""
    plain = re.sub(r"\s+", " ", unit.strip().strip("[]()")).strip()
    return _SPELLINGS.get(plain.lower(), plain)


def unit_of(header: str) -> tuple[str, str | None]:
    """Split a header such as ``Flow [L/min]`` into its name and its unit, if it has one."""
    match = re.fullmatch(r"\s*(.*?)\s*[\[(]([^\])]*)[\])]\s*", header)
    if match is None or not match[1]:
        return header.strip(), None
    return match[1], spelled(match[2])


def _times(values: NDArray[np.float64], factor: Fraction) -> NDArray[np.float64]:
    return np.asarray(values, float) * factor.numerator / factor.denominator


def _in_words(factor: Fraction) -> str:
    if factor.denominator == 1 or factor.numerator == 1 or factor.denominator < 1000:
        return str(factor)
    return f"{float(factor):.10g}"
