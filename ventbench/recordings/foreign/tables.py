"""Tables of numbers from text of any dialect and from spreadsheets.

Text is split once, by the separator and the decimal mark that make most cells numbers. The first
three lines of numbers in a row begin the data; names and units stand above them. What stands
between rows and is none, such as an alarm, is left out and named.
"""

from __future__ import annotations

import csv
import gzip
import re
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError, require
from ventbench.recordings.foreign.layouts import UNITS, is_unit, spelled, unit_of

#: Lines that decide on separator, decimal mark and header, and of those, the ones that are split.
_LOOKED_AT = 400

#: Separators, the likelier first.
_SEPARATORS = ("\t", ";", ",", "|", " ")

#: Cells that stand for nothing.
_BLANKS = ("", "nan", "na", "n/a", "null", "none", "-", "--", "#n/a", "inf", "-inf")

#: Numbers by decimal mark, also with thousands apart: "1,061.3" or "1.061,3".
_NUMBER = {
    mark: re.compile(
        rf"[+-]?(?:\d+{m}?\d*|{m}\d+|\d{{1,3}}(?:[{other} '’\u00a0\u202f]\d{{3}})+(?:{m}\d*)?)"
        r"(?:[eE][+-]?\d+)?"
    )
    for mark, m, other in ((".", r"\.", ","), (",", ",", r"\."))
}

#: A time of day or a stopwatch, with or without a date; before milliseconds also a colon.
_CLOCK = re.compile(
    r"(?:[^\s:]+[ T])?(\d{1,2}):(\d{2})(?::(\d{2}))?(?:([.,:])(\d{1,9}))?\s*([AaPp][Mm])?"
    r"(?:Z|[+-]\d{2}:?\d{2})?"
)

#: Names of a sampling rate, Hz, and of an interval, above a table or beside it.
RATES = ("fs", "rate", "samplingrate", "samplerate", "freq", "frequency", "samplingfrequency")

#: Share of the lines that may be no rows before a file is refused, and number of lines anyway.
_STRAY, _STRAY_LINES = 0.01, 20

#: First lines of what a Servo ventilator exports beside recordings.
_NO_WAVEFORMS = {"[TRE]": "trends", "[RECRUITMENT]": "a manoeuvre", "[LOG]": "events"}

_Row: TypeAlias = tuple[int, list[str]]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length."""

    file: str  #: path as the caller wrote it.
    #: values by name, float64 with NaN for blank, ``(m,)``; text only where no cell is a number.
    #: Times of day are seconds.
    columns: dict[str, NDArray[Any]]
    units: dict[str, str] = field(default_factory=dict)  #: units that headers state, by name.
    lines: Ints | None = None  #: line of each row in a text file, ``(m,)``, else None.
    rate: float | None = None  #: sampling rate that stands beside the columns, Hz, or None.
    notes: tuple[str, ...] = ()  #: what was understood, a sentence each.

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))

    def place(self, row: int) -> str:
        """Where a row stands in the file, in words."""
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"


def read_text(file: str, separator: str | None, decimal: str | None) -> Table:
    """Read text of any dialect, also gzipped; see :func:`~.formats.read_table`."""
    if decimal not in (None, ".", ",") or separator == "":
        raise InputError(
            f"separator {separator!r}, decimal {decimal!r}: give marks such as ; and ,"
        )
    text, encoding = _decoded(file)
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\N{MINUS SIGN}", "-")
    lines = text.split("\n")
    if not any(line.strip() for line in lines):
        raise InputError(f"{file} holds no text")
    if re.match(r"\s*BS\b", next((x for x in lines if re.match(r"\s*B[SE]\b", x)), "")):
        return _delimited_breaths(file, lines, encoding)
    named = re.fullmatch(r"\ufeff?\"?sep=(.)\"?", lines[0].strip("\n"))
    if named is not None:  # a spreadsheet's own line
        separator, lines[0] = separator or named[1], ""
    of_servo = _above_servo_data(file, lines)
    if of_servo:
        separator, lines[:of_servo] = separator or "\t", [""] * of_servo
    looked_at = [line for line in lines[:_LOOKED_AT] if line.strip()]
    separator, decimal = _dialect(file, looked_at, separator, decimal)
    rows = [(k + 1, _cells(line, separator)) for k, line in enumerate(lines) if line.strip()]
    shown = {"\t": "tab", " ": "blanks"}.get(separator, repr(separator))
    note = f"Text ({encoding}), cells separated by {shown}, decimal {decimal!r}"
    table = _table(file, rows, decimal, note, packed=separator == " ")
    return _by_units(table) if of_servo else table


def _decoded(file: str) -> tuple[str, str]:
    data = Path(file).read_bytes()
    if data.startswith(b"\x1f\x8b"):
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError) as error:
            raise InputError(f"{file} cannot be unpacked ({error})") from None
    zeros = data[:4096].count(0)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or zeros > 0.3 * len(data[:4096]):
        wide = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-16-le"
        try:
            return data.decode(wide), "UTF-16"
        except UnicodeDecodeError:
            raise InputError(
                f"{file} begins like UTF-16 text and is none; export it as CSV"
            ) from None
    if zeros:
        raise InputError(f"{file} is no text, Parquet or MATLAB file; export it as CSV")
    try:
        return data.decode("utf-8-sig"), "UTF-8"
    except UnicodeDecodeError:
        return data.decode("latin-1"), "Latin-1"


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    return [cell.strip() for cell in next(csv.reader([line.strip()], delimiter=separator), [])]


def _dialect(
    file: str, lines: list[str], separator: str | None, decimal: str | None
) -> tuple[str, str]:
    """The separator and decimal mark with which most cells of most lines are numbers."""
    best, most = None, 0.0
    quoted = any('"' in line for line in lines)
    for own in (separator,) if separator else _SEPARATORS:
        split = [cells for cells in (_cells(line, own) for line in lines) if len(cells) > 1]
        split = [cells for cells in map(_filled, split) if cells]
        for mark in (decimal,) if decimal else (".", ","):
            if mark == own and not quoted:
                continue
            score = sum(sum(_is_value(cell, mark) for cell in c) / len(c) for c in split)
            if own == " ":  # words of lines above are apart by blanks too
                score *= 0.85
            # Between equals: "7,736" alone is a decimal comma, and integers have no mark.
            if mark == ",":
                score += 1e-6 if any("," in cell for cells in split for cell in cells) else -1e-6
            if score > most + 1e-9:
                best, most = (own, mark), score
    if best is None:
        asked = f" separated by {separator!r}" if separator else ""
        raise InputError(
            f"{file}: no line has two cells{asked} of which one is a number; give --separator"
        )
    return best


def _filled(cells: list[str]) -> list[str]:
    return [cell for cell in cells if cell.lower() not in _BLANKS]


def _is_value(cell: str, mark: str) -> bool:
    return bool(_NUMBER[mark].fullmatch(cell) or (":" in cell and _CLOCK.fullmatch(cell)))


def _table(file: str, rows: list[_Row], mark: str, note: str, packed: bool = False) -> Table:
    """Rows of cells as columns: header, units, values, and lines that are none."""
    looked_at = rows[:_LOOKED_AT]
    good = []
    for _, cells in looked_at:
        filled = _filled(cells)
        values = sum(_is_value(cell, mark) for cell in filled)
        good.append(values > len(filled) - values or (values and 2 * values >= len(cells) > 2))
    runs = [k for k in range(len(good)) if all(good[k : k + 3])]
    if not runs:
        raise InputError(f"{file}: no line of the first {len(looked_at)} is one of numbers")
    start = runs[0]
    widths = Counter(_width(cells) for _, cells in looked_at[start:])
    width = max(w for w, count in widths.items() if count >= 0.05 * sum(widths.values()))
    names, units, notes = _header(file, looked_at[:start], width, packed)
    width = len(names)
    kept = [row for row in rows[start:] if _width(row[1]) <= width]
    stray = [row for row in rows[start:] if _width(row[1]) > width]
    columns, odd_cells, odd, filled = _columns(names, units, kept, mark, notes)
    # A line with a word and hardly a number, between lines of numbers, is no row.
    message = odd & (filled <= 1)
    if message.any():
        stray = sorted([*stray, *(kept[k] for k in np.flatnonzero(message))])
        columns = {name: values[~message] for name, values in columns.items()}
        odd_cells = {
            name: cells for name, cells in odd_cells.items() if not message[cells[0]].all()
        }
    if len(stray) > max(_STRAY_LINES, _STRAY * len(kept)):
        raise InputError(
            f"{file}, line {stray[0][0]}: {len(stray)} of {len(rows) - start} lines are no rows of "
            f"at most {width} numbers, such as {' '.join(stray[0][1])[:60]!r}; remove them, or "
            "give --separator"
        )
    if odd_cells:
        said = [
            f"{name}: {len(at)} cells, such as {cell!r}" for name, (at, cell) in odd_cells.items()
        ]
        notes.append(f"Cells that are no numbers are blank ({'; '.join(said)}).")
    for number, cells in stray[:3]:
        notes.append(f"Line {number} is no row and was left out: {' '.join(cells)[:60]!r}.")
    if len(stray) > 3:
        notes.append(f"So were {len(stray) - 3} more lines, the last of them {stray[-1][0]}.")
    numbers = np.array([number for number, _ in kept], np.int64)[~message]
    notes.insert(0, f"{note}, first row in line {numbers[0]}.")
    return Table(file, columns, units, numbers, _rate(looked_at[:start], mark), tuple(notes))


def _width(cells: list[str]) -> int:
    """Number of cells up to the last one that is not blank."""
    return max((k + 1 for k, cell in enumerate(cells) if cell), default=0)


def _header(
    file: str, above: list[_Row], width: int, packed: bool
) -> tuple[list[str], dict[str, str], list[str]]:
    """Names and units from the lines above the numbers."""
    texts = [
        [cell.strip("'\"").lstrip("#%").strip() for cell in cells[: _width(cells)]]
        for _, cells in above
    ]
    while texts and (sum(map(bool, texts[-1])) < min(2, width) or _mostly_numbers(texts[-1])):
        texts.pop()
    if not texts:
        return [str(k + 1) for k in range(width)], {}, ["There is no header; columns are 1, 2, ..."]
    units_row: list[str] = []
    known = sum(is_unit(cell) for cell in texts[-1])
    if len(texts) > 1 and known and 2 * known >= sum(map(bool, texts[-1])):
        units_row = texts.pop()
    # The names are the last line of as many cells as columns; an alarm may stand below them.
    cells = next((text for text in reversed(texts) if sum(map(bool, text)) == width), texts[-1])
    if packed and len(cells) != width:
        raise InputError(
            f"{file}: {len(cells)} names stand above {width} columns that blanks separate; put "
            "names of one word there, or map numbers after removing the line"
        )
    if width == len(cells) + 1 and not units_row:  # names of R's write.table have no row's own
        cells = ["row", *cells]
    cells = cells + [""] * (width - len(cells))
    names: list[str] = []
    units: dict[str, str] = {}
    for k, cell in enumerate(cells):
        name, unit = unit_of(cell)
        name = name or str(k + 1)
        while name in names:
            name += "_"
        names.append(name)
        if k < len(units_row) and units_row[k]:
            unit = spelled(units_row[k])
        if unit:
            units[name] = unit
    skipped = len(texts) - 1
    return names, units, [f"{skipped} lines above the header were skipped."] if skipped else []


def _mostly_numbers(cells: list[str]) -> bool:
    values = sum(_is_value(cell, ".") or _is_value(cell, ",") for cell in cells if cell)
    return 2 * values >= sum(map(bool, cells))


def _rate(above: list[_Row], mark: str) -> float | None:
    """Sampling rate, Hz, that a line above the table states."""
    for _, cells in above:
        line = re.split(r"[\s,;:=|]+", " ".join(cells).replace(mark, ".").strip(" #%\"'"))
        for k in range(1, len(line)):
            name = re.sub(r"[^a-z]|hz", "", "".join(line[:k]).lower())
            if name in RATES and re.fullmatch(r"\d+\.?\d*", line[k]) and float(line[k]) > 0:
                return float(line[k]) * (1000.0 if line[k + 1 : k + 2] == ["kHz"] else 1.0)
    return None


def _columns(
    names: list[str], units: dict[str, str], rows: list[_Row], mark: str, notes: list[str]
) -> tuple[
    dict[str, NDArray[Any]], dict[str, tuple[NDArray[Any], str]], NDArray[Any], NDArray[Any]
]:
    """Values by name; rows with odd cells and one of them by name; rows with any; and values."""
    import pandas as pd

    columns: dict[str, NDArray[Any]] = {}
    odd_cells: dict[str, tuple[NDArray[Any], str]] = {}
    any_odd, filled = np.zeros(len(rows), bool), np.zeros(len(rows), int)
    for k, name in enumerate(names):
        cells = pd.Series([row[k] if k < len(row) else "" for _, row in rows], dtype=str)
        values, grouped = _values(cells, mark)
        odd = np.isnan(values) & ~cells.str.lower().isin(_BLANKS).to_numpy()
        if odd.any() and not np.isfinite(values).any():
            clock = _clock(cells)
            if clock is None:
                columns[name] = cells.to_numpy(str)
                continue
            values, units[name] = clock, "s"
            odd = np.isnan(values) & (cells != "").to_numpy()
            notes.append(f"{name}: times such as {cells[0]!r} were counted in seconds.")
        if grouped:
            notes.append(f"{name}: {grouped} cells have thousands apart.")
        if odd.any():
            odd_cells[name] = np.flatnonzero(odd), str(cells[int(np.argmax(odd))])
        any_odd |= odd
        filled += np.isfinite(values)
        columns[name] = values
    return columns, odd_cells, any_odd, filled


def _values(cells: Any, mark: str) -> tuple[Floats, int]:
    """Numbers of a column, NaN for other cells; and how many have thousands apart."""
    import pandas as pd

    other = "," if mark == "." else "."
    apart = cells.str.contains(rf"[{re.escape(other)} '’\u00a0\u202f]") & cells.str.fullmatch(
        _NUMBER[mark].pattern
    )
    if mark == "," and not cells.str.contains(",", regex=False).any():
        apart &= False  # a column of a file with decimal commas that has points itself
    if apart.any():
        cells = cells.mask(
            apart, cells.str.replace(rf"[{re.escape(other)} '’\u00a0\u202f]", "", regex=True)
        )
    plain = cells.str.replace(",", ".", regex=False) if mark == "," else cells
    values = np.array(pd.to_numeric(plain, errors="coerce"), float)
    values[~np.isfinite(values)] = np.nan
    return values, int(apart.sum())


def _clock(cells: Any) -> Floats | None:
    """Seconds of times of day, on over midnight; None if hardly any cell is one."""
    parts = cells.str.extract(rf"^{_CLOCK.pattern}$")
    hours, minutes = (parts[k].astype(float).to_numpy(float, na_value=np.nan) for k in (0, 1))
    if np.isfinite(hours).mean() < 0.9:
        return None
    seconds = parts[2].astype(float).to_numpy(float, na_value=np.nan)
    stopwatch = np.isnan(seconds)  # 05:23.450 is minutes and seconds
    hours, minutes, seconds = (
        np.where(stopwatch, 0.0, hours),
        np.where(stopwatch, hours, minutes),
        np.where(stopwatch, minutes, seconds),
    )
    digits = parts[4].fillna("0")
    # After a colon stand milliseconds, after a mark decimals.
    scale = np.where(parts[3] == ":", 1000.0, 10.0 ** digits.str.len().to_numpy(float))
    seconds = seconds + digits.astype(float).to_numpy(float) / scale
    half = parts[5].str.lower()
    hours = np.where(half.notna(), hours % 12 + 12 * (half == "pm"), hours)
    out = 3600.0 * hours + 60.0 * minutes + seconds
    known = np.flatnonzero(np.isfinite(out))
    back = np.diff(out[known], prepend=out[known[0]]) < -43200.0
    out[known] += 86400.0 * np.cumsum(back)
    return np.round(out, 9)


def _delimited_breaths(file: str, lines: list[str], encoding: str) -> Table:
    """Breaths between lines BS and BE, flow and pressure a line, 50 times a second."""
    rows: list[tuple[int, float, float, float]] = []
    breath, begun, cut = 0, 0, 0
    inside = False
    for number, line in enumerate(lines, 1):
        if re.match(r"\s*BS\b", line):
            if inside:  # the breath before has no end
                cut += 1
                del rows[begun:]
            breath, begun, inside = breath + 1, len(rows), True
        elif re.match(r"\s*BE\b", line):
            inside = False
        elif inside:
            try:
                flow, pressure = (float(cell) for cell in line.strip(" ,").split(",")[:2])
            except ValueError:
                raise InputError(
                    f"{file}, line {number}: flow and pressure are wanted between BS and BE, not "
                    f"{line.strip()[:40]!r}"
                ) from None
            rows.append((number, flow, pressure, breath))
    if inside:
        cut += 1
        del rows[begun:]
    if not rows:
        raise InputError(f"{file}: no breath stands between a line BS and a line BE")
    numbers, flows, pressures, breaths = np.array(rows).T
    notes = [
        f"Text ({encoding}) with breaths between BS and BE (Puritan Bennett 840 and 980): flow in "
        "L/min, pressure in cmH2O, 50 Hz."
    ]
    if cut:
        notes.append(f"{cut} breaths without an end were left out.")
    columns = {"flow": flows, "pressure": pressures, "breath": breaths}
    units = {"flow": "L/min", "pressure": "cmH2O"}
    return Table(file, columns, units, numbers.astype(np.int64), 50.0, tuple(notes))


def _above_servo_data(file: str, lines: list[str]) -> int:
    """Number of lines up to ``[DATA]`` in a recording of a Servo ventilator; 0 for other text."""
    stripped = [line.strip() for line in lines]
    if stripped[0] not in ("[REC]", *_NO_WAVEFORMS):
        return 0
    if "[DATA]" not in stripped or stripped[0] != "[REC]":
        what = _NO_WAVEFORMS.get(stripped[0], "no line [DATA]")
        raise InputError(f"{file} of a Servo ventilator holds {what}; export a recording ([REC])")
    return stripped.index("[DATA]") + 1


def _by_units(table: Table) -> Table:
    """Name the columns of a Servo recording, which are in its language, by their units.

    The first is the time. Two letters tell a phase, since pauses have longer names; in an
    inspiration more flows in than out.
    """
    roles, units = {next(iter(table.columns)): "time"}, {"time": "s"}
    for name, unit in table.units.items():
        role = next((r for r in ("pressure", "flow", "volume") if unit in UNITS[r]), "time")
        if role not in units:
            roles[name], units[role] = role, unit
    columns = {roles.get(name, name): values for name, values in table.columns.items()}
    told = [x for x in columns.values() if x.dtype.kind == "U" and np.mean(x != "") > 0.5]
    if told and "flow" in columns:
        phase = np.array([text[:2].casefold() for text in told[0]])
        inward = [each for each in set(phase) if np.nansum(columns["flow"][phase == each]) > 0]
        columns["expiration"] = 1.0 - np.isin(phase, inward)
    return replace(table, columns=columns, units=units)


def read_spreadsheet(file: str) -> Table:
    """Read the first sheet of a spreadsheet."""
    import zipfile

    import pandas as pd

    require("openpyxl", extra="excel", what="spreadsheets")
    try:
        with zipfile.ZipFile(file) as archive:
            if "xl/workbook.xml" not in archive.namelist():
                raise InputError(f"{file} is a zip archive; unpack it and name the file in it")
        frame = pd.read_excel(file, header=None, dtype=object)
    except zipfile.BadZipFile as error:
        raise InputError(f"{file} cannot be unpacked ({error}); copy it again") from None
    cells = frame.astype(str).mask(frame.isna(), "").to_numpy(str)
    rows = [(k + 1, list(row)) for k, row in enumerate(cells.tolist()) if any(row)]
    return _table(file, rows, ".", "First sheet of a spreadsheet")
