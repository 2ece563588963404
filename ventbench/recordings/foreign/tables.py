"""Tables of numbers from text of any dialect and from spreadsheets.

The first lines tell the separator and the decimal mark that make most cells numbers; the first
three lines of numbers in a row begin the data, and names and units stand above them. pyarrow reads
the rest. Only lines of another length, and columns in which a cell is no number, are looked at one
by one. What stands between rows and is none, such as an alarm, is left out and named. What devices
write around their tables is data: ``texts.toml``.
"""

from __future__ import annotations

import csv
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Columns, Floats, Ints, Texts
from ventbench.base.errors import InputError, require
from ventbench.base.files import data_beside
from ventbench.base.text import few
from ventbench.recordings.foreign import sizes
from ventbench.recordings.headers import UNITS, Header, is_unit, known_words, read_header
from ventbench.recordings.sources import to_numpy

_TEXTS = data_beside(__file__, "texts.toml")

#: Lines that decide on separator, decimal mark and header.
_LOOKED_AT = 400

#: Lines of a file below which longer ones are the rows of a table whose columns they should be.
_ROWS = 30

#: Separators, the likelier first.
_SEPARATORS = ("\t", ";", ",", "|", " ")

#: Cells that stand for nothing, as they are written and in lower case.
_BLANKS = _TEXTS["cells"]["blank"]

#: Numbers by decimal mark, also with thousands apart: "1,061.3" or "1.061,3".
_NUMBER = {
    mark: re.compile(
        rf"[+-]?(?:\d+{m}?\d*|{m}\d+"
        rf"|\d{{1,3}}(?:[{other} '’\u00a0\u202f]\d{{3}}){{1,4}}(?:{m}\d*)?)"
        r"(?:[eE][+-]?\d+)?"
    )
    for mark, m, other in ((".", r"\.", ","), (",", ",", r"\."))
}

#: A reading with its unit behind it.
_READING = re.compile(r"([-+.,\d]*\d(?:[eE][-+]?\d+)?)\s*((?:[^\W\d]|%).*)")

#: A quoted cell of several lines.
_BROKEN = re.compile(rb'(?<![^\t,;|\n])"[^"\n]*(?:\n[^"\n]*){1,4}"(?![^\t,;|\n])')

#: A list of samples in one cell, also as JSON writes it, and least number of them.
_LIST = {
    mark: re.compile(rf"[\[({{]?\s*{number}(?:{separators}{number}){{7,}}\s*[\])}}]?")
    for mark, number, separators in (
        (".", r"(?:[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan|null)", r"(?:\s*[,;|]\s*|\s+)"),
        (",", r"(?:[+-]?(?:\d+,?\d*|,\d+)(?:[eE][+-]?\d+)?|nan|null)", r"(?:\s*[;|]\s*|\s+)"),
    )
}

#: A time of day or a stopwatch, with or without a date; before milliseconds also a colon.
_CLOCK = re.compile(
    r"(?:[^\s:]+[ T])?(\d{1,2}):(\d{2})(?::(\d{2}))?(?:([.,:])(\d{1,9}))?\s*([AaPp][Mm])?"
    r"(?:Z|[+-]\d{2}:?\d{2})?"
)

#: Names of a sampling rate, Hz, and of an interval, s, above a table or beside it.
_FREQUENCIES, _OTHERS, _INTERVALS = _TEXTS["rates"].values()

#: A number above a table, and the unit behind it.
_STATED = re.compile(r"(?<![^\s,;:=|])(\d+\.?\d*)(?![^\s,;:=|a-z])[\s,;:=|]*([a-z]*)(/sample)?")

#: First cells of lines that hold names, and units, of the columns right of them.
_TITLES, _UNIT_TITLES = _TEXTS["titles"].values()

#: A reading behind its name, as serial ports and logs print it: ``P:12.3``, ``flow = 24 L/min``.
_LABELLED = re.compile(
    r"(?<![^\s,;|])([^\W\d]\w*(?:[\[(][^\s\])]+[\])])?) ?[:=] ?"
    r"((?:[-+.\d]|nan|null)(?:[^\s,;|)\]}\"']|,(?=\d))*"
    rf"(?: (?:{'|'.join(u for sizes in UNITS.values() for u in sizes if u != '1')})"
    r"(?![^\s,;|)]))?)",
    re.IGNORECASE,
)

#: A time beside such readings: a time of day before them, one since 1970 behind them, or a number
#: at the very beginning of the line.
_STAMP = re.compile(
    rf"(?:.*?(?P<clock>{re.sub(r'[(](?![?])', '(?:', _CLOCK.pattern)})"
    r"|.*\s(?P<timestamp>\d{10,19})\s*$|\W*(?P<row>\d+\.?\d*)\b)?"
)

#: Names and units of channels, a line each, above the header of BIOPAC AcqKnowledge.
_CHANNELS = re.compile(
    r"(?im)^\W*\d+ channels?\W*\n((?:.*\n)*?)"
    r"(?:(?!CH\d)(\w+)\W)?CH\d+(\W)?.*\n(?:[\d,;\t ]+\n)?"
)

#: Lines of marks in a table that is drawn, as in Markdown, and rows between marks.
_RULE = re.compile(r"[ \t|+:=-]*(?:--|==)[ \t|+:=-]*")
_DRAWN = re.compile(rf"(?m)^{_RULE.pattern}$|^ *\|(.*)\| *$")

#: What readers raise at files that are damaged.
_FAILURES = (ValueError, TypeError, LookupError, OSError, EOFError, NotImplementedError)
_FAILURES += (zipfile.BadZipFile, zlib.error)

#: Share of the lines that may be no rows before a file is refused, and number of lines anyway.
_STRAY, _STRAY_LINES = 0.01, 20


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length."""

    file: str  #: path as the caller wrote it.
    #: values by name, float64 with NaN for blank, ``(m,)``; text only where no cell is a number,
    #: objects where cells are lists of samples. Times of day are seconds.
    columns: Columns
    units: Texts = field(default_factory=dict)  #: units beside the names, by name.
    lines: Ints | None = None  #: line of each row in a text file, ``(m,)``, else None.
    rate: float | None = None  #: sampling rate that stands beside the columns, Hz, or None.
    notes: tuple[str, ...] = ()  #: what was understood, a sentence each.
    headers: Texts = field(default_factory=dict)  #: headers as written, by name.

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))

    def noted(self, *sentences: str) -> Table:
        """The table with more of what was understood."""
        return replace(self, notes=(*self.notes, *sentences))

    def rows(self, which: Bools | Ints) -> Table:
        """Some of its rows."""
        columns = {name: values[which] for name, values in self.columns.items()}
        return replace(
            self, columns=columns, lines=None if self.lines is None else self.lines[which]
        )

    @property
    def names(self) -> str:
        """Its first columns, in words."""
        return few(list(self.columns), 20)

    def is_numeric(self, name: str) -> bool:
        """Whether a column holds numbers."""
        return self.columns[name].dtype.kind in "fiub"

    def header(self, name: str) -> Header:
        """What the header of a column says, with the unit beside it."""
        text, unit = self.headers.get(name, name), self.units.get(name)
        return read_header(f"{text} [{unit}]" if unit and is_unit(unit) else text)

    def place(self, row: int) -> str:
        """Where a row stands in the file, in words."""
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"


def named(headers: Sequence[str]) -> Texts:
    """Headers by the names of their columns: without units, and each once."""
    names: Texts = {}
    for k, text in enumerate(headers):
        name = read_header(text).name or str(k + 1)
        while name in names:
            name += "_"
        names[name] = text
    return names


def read_text(file: str, separator: str | None, decimal: str | None) -> Table:
    """Read text of any dialect, also gzipped; see :func:`~.formats.read_table`."""
    if decimal not in (None, ".", ",") or separator == "":
        raise InputError(
            f"separator {separator!r}, decimal {decimal!r}: give marks such as ; and ,"
        )
    data, encoding = decoded(file)
    if not data:
        raise InputError(f"{file} holds no text")
    form, kind = _form(file, _beginning(data)), ""
    if "begin" in form:
        data, kind = _between(data, form)
    elif not form:
        data, kind = _plain_lines(data, _beginning(data))
    data = _unbroken(data)
    above = _beginning(data)
    stated = re.fullmatch(r"\"?sep=(.)\"?", above[0])
    if stated is not None:  # a spreadsheet's own line
        separator, above[0] = separator or stated[1], ""
    stated_units = []
    if "line" in form:
        begins = len(above) - [line.strip() for line in above[::-1]].index(form["line"])
        mark = form.get("units", "\t")
        stated_units = [x.split("\t") for x in above[:begins] if x.startswith(mark)]
        above[:begins] = [""] * begins
    above = _titled(above)
    separator, decimal = _dialect(file, [x for x in above if x.strip()], separator, decimal)
    note = f"Text ({encoding}), {kind}cells "
    if len(above) < _ROWS:  # rows in the place of columns
        cells = [x for line in above if len(x := _cells(line, separator)) > _ROWS]
        if len(cells) > 1 and _mostly_numbers(cells[0]):
            above = ["\t".join(x) for x in zip(*cells, strict=False)]
            data, note, separator = "\n".join(above).encode(), f"{note}of rows, ", "\t"
    table = _table(file, data, above[:_LOOKED_AT], separator, decimal, note)
    for units in stated_units:
        table = replace(table, units=dict(zip(list(table.columns)[1:], units[1:], strict=False)))
    if "rate" in form:
        table = replace(table, rate=form["rate"])
    return _by_units(table) if "by_units" in form else table


def _unbroken(data: bytes) -> bytes:
    """A text with each of its headers in one line, below as many blank lines as it had more."""
    whole, count = _BROKEN.subn(lambda cell: cell[0].replace(b"\n", b" "), data[: 1 << 16])
    if not count:
        return data
    whole += data[1 << 16 :]
    return b"\n" * (data.count(b"\n") - whole.count(b"\n")) + whole


def decoded(file: str) -> tuple[bytes, str]:
    """The text in UTF-8 with LF at the ends of lines, and the encoding of the file."""
    data = Path(file).read_bytes()
    if data.startswith(b"\x1f\x8b"):
        data = sizes.gunzipped(file)
    zeros, encoding = data[:4096].count(0), "UTF-8"
    wide = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-16-le"
    if wide == "utf-16" or zeros > 0.3 * len(data[:4096]):
        try:
            data, encoding = data.decode(wide).encode(), "UTF-16"
        except UnicodeError:
            raise InputError(
                f"{file} begins like UTF-16 text and is none; export it as CSV"
            ) from None
    elif zeros:
        raise InputError(f"{file} is no text, Parquet or MATLAB file; export it as CSV")
    if not data.isascii():
        try:
            data = data.decode("utf-8-sig").replace("\N{MINUS SIGN}", "-").encode()
        except UnicodeDecodeError:
            encoding = max(
                _TEXTS["encodings"]["tried"],
                key=lambda x: known_words(data[: 1 << 16].decode(x, "ignore")),
            )
            data = data.decode(encoding, "replace").encode()
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data.rstrip(b" \n\0"), encoding


@contextmanager
def readable(
    file: str, kind: str, advice: str = "", also: type[Exception] = OSError
) -> Iterator[None]:
    """Say that a file cannot be read as what it seems to be, where that fails."""
    try:
        yield
    except InputError:
        raise
    except (*_FAILURES, also) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"{file} cannot be read as {kind} ({reason}){advice}") from None


def _beginning(data: bytes) -> list[str]:
    """The first lines of a text."""
    return data[: 1 << 20].decode(errors="replace").split("\n", _LOOKED_AT)[:_LOOKED_AT]


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    csv.field_size_limit(max(csv.field_size_limit(), len(line)))  # a cell may list many samples
    return [cell.strip() for cell in next(csv.reader([line.strip()], delimiter=separator), [])]


def _dialect(
    file: str, lines: list[str], separator: str | None, decimal: str | None
) -> tuple[str, str]:
    """The separator and decimal mark with which most cells of most lines are numbers."""
    best, most = None, 0.0
    quoted = any('"' in line for line in lines)
    for candidate in (separator,) if separator else _SEPARATORS:
        split = [cells for line in lines if len(cells := _cells(line, candidate)) > 1]
        split = list(filter(None, map(_filled, split)))
        for mark in (decimal,) if decimal else (".", ","):
            if mark == candidate and not quoted:
                continue
            score = sum(sum(_is_value(cell, mark) for cell in c) / len(c) for c in split)
            if candidate == " ":  # words of lines above are apart by blanks too
                score *= 0.85
            # Between equals: "7,736" alone is a decimal comma, and integers have no mark.
            if mark == ",":
                score += 1e-6 if any("," in cell for cells in split for cell in cells) else -1e-6
            if score > most + 1e-9:
                best, most = (candidate, mark), score
    if best is None:
        requested = f" separated by {separator!r}" if separator else ""
        raise InputError(
            f"{file}: no line has two cells{requested} of which one is a number; give --separator"
        )
    return best


def _filled(cells: list[str]) -> list[str]:
    return [cell for cell in cells if cell.lower() not in _BLANKS]


def _is_value(cell: str, mark: str) -> bool:
    return bool(
        _NUMBER[mark].fullmatch(cell)
        or (":" in cell and _CLOCK.fullmatch(cell))
        or _LIST[mark].fullmatch(cell)
        or ((reading := _READING.fullmatch(cell)) and is_unit(reading[2]))
    )


def _table(
    file: str, data: bytes, above: Sequence[str], separator: str, mark: str, note: str
) -> Table:
    """Lines of cells as columns: header, units, values, and lines that are none."""
    rows = [(k, _cells(line, separator)) for k, line in enumerate(above) if line.strip()]
    begins = _first_numbers([cells for _, cells in rows], mark)
    if begins is None:
        raise InputError(f"{file}: no line of the first {len(rows)} is one of numbers")
    widths = Counter(_width(cells) for _, cells in rows[begins:])
    width = max(w for w, count in widths.items() if count >= 0.05 * sum(widths.values()))
    texts = [cells for _, cells in rows[:begins]]
    if separator == " ":  # names of several words are further apart
        wide = [re.split(r"\s{2,}|\t", above[k].strip(" #%\t")) for k, _ in rows[:begins]]
        texts = [x if len(x) == width else y for x, y in zip(wide, texts, strict=True)]
    headers, units, notes = _header(texts, width, separator == " ")
    if separator == "," and all(headers[: width // 2]) and not any(headers[width // 2 :]):
        raise InputError(
            f"{file}: {width} cells stand below {width // 2} names, as if commas were decimal "
            "marks too; export it with semicolons between the cells"
        )
    names = named(headers)
    first = rows[begins][0]
    offset = sum(len(line) + 1 for line in data.split(b"\n", first)[:first])
    last, named_by = rows[begins - 1] if begins else (0, [])
    words = _filled(named_by) and not any(_is_value(cell, mark) for cell in named_by)
    header = above[last].strip() if words else ""
    cells, numbers, stray = _arrow(data, offset, len(names), separator, mark, header)
    odd = [x for x in stray if not x[1].startswith("#") and x[1].strip() != header]
    if len(odd) > max(_STRAY_LINES, _STRAY * len(numbers)):
        raise InputError(
            f"{file}, line {first + 1 + odd[0][0]}: {len(odd)} of {len(numbers) + len(odd)} "
            f"lines are no rows of at most {len(names)} numbers, such as {odd[0][1][:60]!r}; "
            "remove them, or give --separator"
        )
    columns, units, odd_cells, message = _columns(file, names, units, cells, mark, notes)
    if message.any():
        lines = data[offset:].split(b"\n")
        stray += [(k, lines[k].decode()) for k in numbers[message].tolist()]
        columns = {name: values[~message] for name, values in columns.items()}
        numbers = numbers[~message]
    if odd_cells:
        notes.append(f"Cells that are no numbers are blank ({'; '.join(odd_cells)}).")
    for number, line in sorted(stray)[:3]:
        excerpt = " ".join(_cells(line, separator))[:60]
        notes.append(f"Line {first + 1 + number} is no row and was left out: {excerpt!r}.")
    if len(stray) > 3:
        last = first + 1 + max(number for number, _ in stray)
        notes.append(f"So were {len(stray) - 3} more lines, the last of them {last}.")
    label = {"\t": "tab", " ": "blanks"}.get(separator, repr(separator))
    numbers = numbers + first + 1
    notes.insert(
        0, f"{note}separated by {label}, decimal {mark!r}, first row in line {numbers[0]}."
    )
    return Table(file, columns, units, numbers, _rate(texts, mark), tuple(notes), names)


def _first_numbers(rows: list[list[str]], mark: str) -> int | None:
    """Index of the first of three rows of numbers; None if there is none."""
    good = []
    for cells in rows:
        filled = _filled(cells)
        values = sum(_is_value(cell, mark) for cell in filled)
        good.append(values > len(filled) - values or (values and 2 * values >= len(cells) > 2))
    return next((k for k in range(len(good)) if all(good[k : k + 3])), None)


def _arrow(
    data: bytes, offset: int, width: int, separator: str, mark: str, header: str
) -> tuple[Any, Ints, list[tuple[int, str]]]:
    """Rows as an Arrow table of numbers or text, their lines from 0, and lines that are no rows.

    Comments and repeats of the header are none.
    """
    from pyarrow import ArrowInvalid, BufferReader, py_buffer, string, system_memory_pool, types
    from pyarrow import csv as arrow

    if separator == " ":
        data = re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", data[offset:])
        data, offset, separator = re.sub(rb"[ \t]+", b"\t", data), 0, "\t"
    looked_at = data[offset : offset + (1 << 16)].decode(errors="replace").split("\n")[:_LOOKED_AT]
    count = Counter(len(_cells(line, separator)) for line in looked_at if line.strip())
    usual = max(width, count.most_common(1)[0][0])

    def read(text: bytes | memoryview, words: Sequence[str] = ()) -> tuple[Any, list[str]]:
        odd: list[str] = []
        table = arrow.read_csv(
            BufferReader(py_buffer(text)),
            arrow.ReadOptions(
                use_threads=False, column_names=list(map(str, range(usual))), block_size=1 << 22
            ),
            arrow.ParseOptions(
                delimiter=separator, invalid_row_handler=lambda row: odd.append(row.text) or "skip"
            ),
            arrow.ConvertOptions(
                column_types=dict.fromkeys(words, string()),
                decimal_point=mark,
                null_values=_BLANKS,
                strings_can_be_null=False,
            ),
            system_memory_pool(),  # which gives back what is freed
        )
        return table, odd

    body: bytes | memoryview = memoryview(data)[offset:]
    again = header.encode()
    try:
        if data.find(b"\n#", offset) >= 0 or (again and data.find(b"\n" + again, offset) >= 0):
            raise ArrowInvalid
        table, odd = read(body)
    except ArrowInvalid:
        table, odd = None, []
    stray: list[tuple[int, str]] = []
    if table is None or odd or data.count(b"\n", offset) + 1 != table.num_rows:
        regular, numbers = [], []
        for k, line in enumerate(data[offset:].decode().split("\n")):
            if not line.strip():
                continue
            if line.startswith("#") or line.strip() == header:
                stray.append((k, line))
                continue
            if line.count(separator) == usual - 1 and '"' not in line:
                regular.append(line)
            elif _width(cells := _cells(line, separator)) > width:
                stray.append((k, line))
                continue
            else:
                quoted = ('"' + cell.replace('"', '""') + '"' for cell in cells[:usual])
                regular.append(separator.join([*quoted, *[""] * (usual - len(cells))]))
            numbers.append(k)
        body, lines = "\n".join(regular).encode(), np.array(numbers, np.int64)
        if not regular:
            return None, lines, stray
        table = read(body)[0]
    else:
        lines = np.arange(table.num_rows)
    numeric = (types.is_integer, types.is_floating, types.is_null)
    words = [x.name for x in table.schema if not any(is_kind(x.type) for is_kind in numeric)]
    if words:
        table = read(body, words)[0]
    return table.select(list(map(str, range(width)))), lines, stray


def _width(cells: list[str]) -> int:
    """Number of cells up to the last one that is not blank."""
    return max((k + 1 for k, cell in enumerate(cells) if cell), default=0)


def _header(
    above: list[list[str]], width: int, packed: bool
) -> tuple[list[str], list[str], list[str]]:
    """Headers, units that stand below them, and notes, from the lines above the numbers."""
    texts = [
        [
            re.sub(r"^(['\"])(.*)\1$", r"\2", cell).lstrip("#%").strip()
            # The mark of a comment may stand by itself, as NumPy writes a header.
            for cell in cells[cells[:1] in (["#"], ["%"]) : _width(cells)]
        ]
        for cells in above
    ]
    keyed = {re.sub(r"[^a-z]", "", cells[0].lower()): cells[1:] for cells in texts if cells}
    titles = next((keyed[key] for key in _TITLES if key in keyed), [])
    if titles and width - 1 <= len(titles) <= width:
        units = next((keyed[key] for key in _UNIT_TITLES if key in keyed), [])
        first = ["time"] * (width - len(titles))
        return [*first, *titles], [""] * len(first) + units, ["Names stand in a line of titles."]
    while texts and (sum(map(bool, texts[-1])) < min(2, width) or _mostly_numbers(texts[-1])):
        texts.pop()
    numbered = [str(k + 1) for k in range(width)]
    comments = [bool(cells) and cells[0].startswith("#") for cells in above[: len(texts)]]
    if texts and not comments[-1]:
        texts = [x for x, is_comment in zip(texts, comments, strict=True) if not is_comment]
    if not texts:
        return numbered, [], ["There is no header; columns are 1, 2, ..."]
    units_row: list[str] = []
    unit_cells = sum(map(is_unit, texts[-1]))
    if len(texts) > 1 and unit_cells and 2 * unit_cells >= sum(map(bool, texts[-1])):
        units_row = texts.pop()
    # The names are the last line of as many cells as columns; an alarm may stand below them.
    cells = next((text for text in reversed(texts) if sum(map(bool, text)) == width), texts[-1])
    # Names of R's write.table have no row's own; they are quoted where blanks are between them.
    if width == len(cells) + 1 and not units_row and (not packed or above[-1][0][:1] in "'\""):
        cells = ["row", *cells]
    if packed and len(cells) != width:
        note = f"{len(cells)} words stand above {width} columns; the columns are 1, 2, ..."
        return numbered, [], [note]
    cells = cells + [""] * (width - len(cells))
    skipped = len(texts) - 1
    return cells, units_row, [f"{skipped} lines above the header were skipped."] if skipped else []


def _mostly_numbers(cells: list[str]) -> bool:
    values = sum(_is_value(cell, ".") or _is_value(cell, ",") for cell in cells if cell)
    return 2 * values >= sum(map(bool, cells))


def _rate(above: list[list[str]], mark: str) -> float | None:
    """Sampling rate, Hz, that a line above the table states."""
    for cells in above:
        text = " ".join(cells).replace(mark, ".").lower()
        for number in _STATED.finditer(text):
            name = "interval" if number[3] else text[: number.start()]
            unit = number[2].replace("ec", "")
            if (rate := rate_of(name, float(number[1]), unit)) is not None:
                return rate
    return None


def rate_of(name: str, number: Any, unit: str = "", certain: bool = False) -> Any:
    """Sampling rate, Hz, that positive numbers state by their name; None if they state none.

    The name is that of a rate or, with a unit in it or beside it, of an interval. A rate that is
    ``certain`` cannot be that of breaths.
    """
    if not isinstance(number, int | float | np.ndarray) or not np.all(number > 0):
        return None
    key = re.sub(r"[^a-z]", "", name.lower())
    rate = key.removesuffix("hz")
    if rate in _FREQUENCIES or (rate in _OTHERS and (rate != key or not certain)):
        return number * (1000.0 if unit == "khz" else 1.0)
    for time, size in UNITS["time"].items():
        if {key, key + unit} & {interval + time for interval in _INTERVALS}:
            return 1.0 / (float(size) * number)
    return None


def _columns(
    file: str, names: Texts, units_row: list[str], cells: Any, mark: str, notes: list[str]
) -> tuple[Columns, Texts, list[str], Bools]:
    """Values and units by name; odd cells in words; rows of a word with hardly a number."""
    import pyarrow as pa

    columns: Columns = {}
    units = {name: unit for name, unit in zip(names, units_row, strict=False) if unit}
    odd_cells: list[tuple[str, Bools, Any]] = []
    any_odd, filled = np.zeros(len(cells), bool), np.zeros(len(cells), int)
    for k, name in enumerate(names):
        column = cells.column(k)
        if not pa.types.is_string(column.type):
            values = to_numpy(column)
            if not np.isfinite(values).all():
                values = np.where(np.isfinite(values), values, np.nan)
            columns[name], filled = values, filled + np.isfinite(values)
            continue
        texts = column.to_pandas().str.strip()
        filled_in = ~texts.str.lower().isin(_BLANKS).to_numpy()
        readings = texts.str.extract(f"^{_READING.pattern}$")
        stated = readings[1].dropna().unique()
        if readings[1].count() > 0.9 * filled_in.sum() and all(map(is_unit, stated)):
            headers = (names[name], *map("[{}]".format, stated))
            said = {read_header(header).unit or "" for header in headers} - {""}
            if len(said) > 1:
                raise InputError(f"{file}: {name} is in {few(sorted(said))}; save it in one unit")
            texts, units[name] = readings[0].fillna(texts), stated[0]
        values, grouped = _values(texts, mark)
        odd = np.isnan(values) & filled_in
        if odd.any() and not np.isfinite(values).any():
            lists = listed(texts, mark)
            if lists is not None:
                columns[name], filled = lists, filled + (texts != "").to_numpy()
                continue
            clock = clock_seconds(texts)
            if clock is None:
                longest = float(texts.str.len().max())  # each word takes as much
                sizes.refuse(file, 4.0 * len(texts) * longest, "the words of one column")
                columns[name] = texts.to_numpy(str)
                continue
            values, units[name] = clock, "s"
            odd = np.isnan(values) & (texts != "").to_numpy()
            notes.append(f"{name}: times such as {texts[0]!r} were counted in seconds.")
        if grouped:
            notes.append(f"{name}: {grouped} cells have thousands apart.")
        any_odd |= odd
        filled += np.isfinite(values)
        columns[name] = values
        if odd.any():
            odd_cells.append((name, odd, texts))
    # A line with a word and hardly a number, between lines of numbers, is no row.
    message = any_odd & (filled <= 1)
    sentences = [
        f"{name}: {odd.sum()} cells, such as {texts[int(np.argmax(odd))]!r}"
        for name, odd, texts in odd_cells
        if not message[odd].all()
    ]
    return columns, units, sentences, message


def _values(cells: Any, mark: str) -> tuple[Floats, int]:
    """Numbers of a column, NaN for other cells; and how many have thousands apart."""
    import pandas as pd

    between = rf"[{',' if mark == '.' else '.'} '’\u00a0\u202f]"
    apart = cells.str.contains(between) & cells.str.fullmatch(_NUMBER[mark].pattern)
    if mark == "," and not cells.str.contains(",", regex=False).any():
        # In a file with decimal commas: points of thousands, if some numbers are too small for one.
        thousands = cells.str.fullmatch(r"(?:0|[1-9]\d{0,2}(?:\.\d{3})*)?").all()
        apart &= thousands and cells.str.fullmatch(r"\d+").any()
    if apart.any():
        cells = cells.mask(apart, cells.str.replace(between, "", regex=True))
    plain = cells.str.replace(",", ".", regex=False) if mark == "," else cells
    values = np.array(pd.to_numeric(plain, errors="coerce"), float)
    values[~np.isfinite(values)] = np.nan
    return values, int(apart.sum())


def listed(cells: Sequence[Any], mark: str = ".") -> NDArray[Any] | None:
    """Lists of samples in cells, objects of float64 ``(n,)``; None if one is none."""
    lists = np.empty(len(cells), object)
    for k, cell in enumerate(cells):
        if isinstance(cell, str):
            if cell and not _LIST[mark].fullmatch(cell):
                return None
            cell = re.split(r"[\s;|]+" if mark == "," else r"[\s,;|]+", cell.strip("[](){} \t"))
            cell = [x.replace(",", ".").replace("null", "nan") for x in cell if x]
        try:
            blank = cell is None or (isinstance(cell, float) and np.isnan(cell))
            lists[k] = np.array(() if blank else cell, float)
        except (TypeError, ValueError):
            return None
        if lists[k].ndim != 1:
            return None
    return lists


def clock_seconds(cells: Any) -> Floats | None:
    """Seconds of times of day, on over midnight; None if hardly any cell is one."""
    parts = cells.str.extract(rf"^{_CLOCK.pattern}$")
    times, half = parts[[0, 1, 2]].astype(float), parts[5].str.lower()
    if times[0].notna().mean() < 0.9:
        return None
    stopwatch = times[2].isna()  # 05:23.450 is minutes and seconds
    times[stopwatch] = times[stopwatch].shift(axis=1, fill_value=0.0)
    times[0] = times[0].where(half.isna(), times[0] % 12.0 + 12.0 * (half == "pm"))
    # After a colon stand milliseconds, after a mark decimals.
    digits = parts[4].fillna("0")
    decimals = "0." + digits.where(parts[3] != ":", digits.str.zfill(3))
    out = (times @ np.array([3600.0, 60.0, 1.0]) + decimals.astype(float)).to_numpy(copy=True)
    finite = np.flatnonzero(np.isfinite(out))
    back = np.diff(out[finite], prepend=out[finite[0]]) < -43200.0
    out[finite] += 86400.0 * np.cumsum(back)
    return np.round(out, 9)


def _form(file: str, lines: list[str]) -> dict[str, Any]:
    """The form of a text whose rows stand between lines or below one; empty of others."""
    stripped = [line.strip() for line in lines]
    for form in _TEXTS["between"].values():
        if any(re.match(rf"{form['begin']}\b", line) for line in stripped):
            return form
    for form in _TEXTS["below"].values():
        others = form.get("others", {})
        if stripped[0] != form["first"] and stripped[0] not in others:
            continue
        if stripped[0] in others or form["line"] not in stripped:
            content = others.get(stripped[0], f"no line {form['line']}")
            raise InputError(
                f"{file} of {form['about']} holds {content}; export a recording ({form['first']})"
            )
        return form
    return {}


def _between(data: bytes, form: dict[str, Any]) -> tuple[bytes, str]:
    """Rows of whole breaths, numbered, of text that marks begins and ends; and the kind."""
    lines = data.decode().split("\n")
    rows, begins = [""] * len(lines), list[int]()
    whole = 0
    for number, line in enumerate(lines):
        if re.match(rf"\s*{form['begin']}\b", line):
            begins.append(number)
        elif begins and re.match(rf"\s*{form['end']}\b", line):
            first = begins[-1] + 1
            rows[first:number] = [f"{len(begins)},{x}" for x in lines[first:number]]
            whole += 1
    rows[begins[0]] = ",".join(["breath", *(f"{x} [{unit}]" for x, unit in form["units"].items())])
    kind = f"breaths between {form['begin']} and {form['end']} ({form['about']}), "
    if cut := len(begins) - whole:
        kind += f"{cut} breaths without an end were left out, "
    return "\n".join(rows).encode(), kind


def _plain_lines(data: bytes, above: list[str]) -> tuple[bytes, str]:
    """Text as lines of cells: of names before readings, arrows, drawn tables; and the kind."""
    names = [tuple(dict(_LABELLED.findall(line))) for line in above]
    usual, count = max(Counter(names).items(), key=lambda x: x[1] * (len(x[0]) > 1))
    text, kind = data.decode(), ""
    if len(usual) > 1 and count > max(2, len(above) // 4):
        first = names.index(usual)
        titles = [title for title, cell in _readings(above[first]).items() if cell]
        rows = [
            "\t".join(map(cells.__getitem__, titles)) if {*usual} <= {*cells} else ""
            for cells in map(_readings, text.split("\n"))
        ]
        rows[first] = "\t".join(titles)
        text, kind = "\n".join(rows), f"readings behind names ({rows.count('')} other lines), "
    elif sum(" -> " in line for line in above) > len(above) / 2:
        between = next((x for x in _SEPARATORS if x in above[-1].split(" -> ")[1].strip()), ",")
        text = text.replace(" -> ", between)
    elif any(map(_RULE.fullmatch, above)):
        text = _DRAWN.sub(r"\1", text)
    else:
        return data, kind
    return text.encode(), kind


def _readings(line: str) -> Texts:
    """Cells of a line by the names before them, and the time before all."""
    return dict(_LABELLED.findall(line)) | next(_STAMP.finditer(line)).groupdict("")


def _titled(lines: list[str]) -> list[str]:
    """The first lines, with one of names and units in place of those of BIOPAC AcqKnowledge.

    Below ``2 channels`` stand the name and the unit of each, a line each, then ``min,CH1,CH2`` and
    the number of samples of each.
    """
    text = "\n".join(lines)
    if (found := _CHANNELS.search(text)) is None:
        return lines
    titles, unit, separator = found.groups()
    texts = [re.sub(r"[,;\t\"]+", " ", x).strip() for x in titles.splitlines()]
    names = [f"time [{unit}]"] if unit else []
    names += [f"{x} [{of}]" for x, of in zip(texts[::2], texts[1::2], strict=False)]
    above = text[: found.start()] + "\n" * (found[0].count("\n") - 1)
    below = "\n" + text[found.end() :]
    return (above + (separator or "\t").join(names) + below).split("\n")


def _by_units(table: Table) -> Table:
    """Name the columns of a Servo recording, which are in its language, by their units.

    The first is the time. Two letters tell a phase, since pauses have longer names; in an
    inspiration more flows in than out.
    """
    roles, units = {next(iter(table.columns)): "time"}, {"time": "s"}
    for name in table.columns:
        unit = table.header(name).unit
        role = read_header(f"[{unit}]").role
        if unit and role and role not in units:
            roles[name], units[role] = role, unit
    columns = {roles.get(name, name): values for name, values in table.columns.items()}
    phases = [x for x in columns.values() if x.dtype.kind == "U" and np.mean(x != "") > 0.5]
    if phases and "flow" in columns:
        phase = np.array([text[:2].casefold() for text in phases[0]])
        inward = [
            letters for letters in set(phase) if np.nansum(columns["flow"][phase == letters]) > 0
        ]
        columns["expiration"] = 1.0 - np.isin(phase, inward)
    return replace(table, columns=columns, units=units, headers={})


def read_spreadsheet(file: str) -> Table:
    """Read the sheet of a spreadsheet that has most rows."""
    require("openpyxl", extra="excel", what="spreadsheets")
    from openpyxl import load_workbook

    with readable(file, "a spreadsheet", "; copy it again"):
        with zipfile.ZipFile(file) as archive:
            if "xl/workbook.xml" not in archive.namelist():
                raise InputError(f"{file} is a zip archive; unpack it and name the file in it")
        sizes.check_archive(file)
        book = load_workbook(file, read_only=True, data_only=True)
    rows, cells = [], 0
    with closing(book):
        sheet = max(book.worksheets, key=lambda x: x.max_row or 0)
        for row in sheet.iter_rows(values_only=True):  # padded to the last row and column
            cells += len(row)
            sizes.refuse(file, sizes.CELL * cells, f"{cells:.3g} cells")
            texts = ["" if cell is None else " ".join(str(cell).split()) for cell in row]
            rows.append("\t".join(texts))
    text = "\n".join(rows).rstrip()
    return _table(
        file,
        text.encode(),
        text.split("\n")[:_LOOKED_AT],
        "\t",
        ".",
        f"Sheet {sheet.title}, cells ",
    )
