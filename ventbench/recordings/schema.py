"""The schema of a recording: columns with units, ranges and types; and its problems.

One row is one sample. The rows of a breath follow one another, in time order. The header is
`id,breath_id,R,C,time_step,u_in,u_out,pressure`, and `flow` or `volume` may be added. Parquet files
have columns of the same names.

Checks collect problems by row; only the few that are shown are looked up in the file afterwards,
for their line and the cell as it is written.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from difflib import get_close_matches
from typing import Any, Literal

import numpy as np

from ventbench.base.errors import InputError

SHOWN = 20
"""Number of problems that are kept and shown; further ones are only counted."""


@dataclass(frozen=True)
class RecordingProblem:
    """An error in a recording, or something that its user should know."""

    file: str  #: the path as the caller wrote it.
    what: str  #: the problem, a phrase without a full stop.
    advice: str  #: what to do about it, a sentence.
    #: line of a CSV file, 1 for the header; in Parquet the row, 1 for the first. None for the whole
    #: file.
    line: int | None = None
    column: str | None = None  #: name of the column, or None.
    #: the cell as it is written in the file (CSV) or printed (Parquet), or None.
    value: str | None = None
    place: str = "line"  #: `line` or `row`, the unit of `line`.

    def __str__(self) -> str:
        """The problem in one line: where, what, advice."""
        where = self.file
        if self.line is not None:
            where += f" {self.place} {self.line}"
        if self.column is not None:
            where += f", column {self.column}"
        return f"{where}: {self.what}. {self.advice}"

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


class RecordingError(InputError):
    """A recording that cannot be used; carries up to `SHOWN` problems and the count of all.

    Attributes:
        problems: the first problems, in file order; never empty.
        total: number of all problems, at least `len(problems)`.
    """

    def __init__(
        self, problems: RecordingProblem | Sequence[RecordingProblem], total: int | None = None
    ) -> None:
        """Keep the problems.

        Args:
            problems: one problem or several, in file order; at least one.
            total: number of all problems, if there are more than are given.
        """
        listed = (problems,) if isinstance(problems, RecordingProblem) else tuple(problems)
        self.problems: tuple[RecordingProblem, ...] = listed
        self.total: int = max(len(listed), total or 0)
        super().__init__(listed, self.total)

    def __str__(self) -> str:
        """The kept problems, a line each, and the number of those left out."""
        lines = [str(problem) for problem in self.problems]
        if self.total > len(lines):
            lines.append(f"... and {self.total - len(lines)} more problems ({self.total} in all).")
        return "\n".join(lines)


def fail(file: str, message: str, advice: str, line: int | None = None) -> RecordingError:
    """Make a RecordingError about a whole file or a line."""
    return RecordingError(RecordingProblem(file, message, advice, line))


Level = Literal["problem", "warning"]
Place = tuple[int, Mapping[str, str]]
"""Position of a row in the file: its line and, if they are known, its cells as written."""
Locate = Callable[[Collection[int]], Mapping[int, Place]]


@dataclass(frozen=True)
class _Entry:
    row: int
    column: str | None
    value: str | None
    what: str
    advice: str
    reference: int | None


@dataclass
class ProblemLog:
    """Problems and warnings of one file by row; keeps the first `SHOWN` of each, and counts all."""

    file: str  #: the path as the caller wrote it.
    first: int = 0  #: row of the file that is row 0 of what is added.
    #: number of problems and of warnings.
    counts: dict[Level, int] = field(default_factory=lambda: {"problem": 0, "warning": 0})
    _kept: dict[Level, list[_Entry]] = field(default_factory=lambda: {"problem": [], "warning": []})

    def add(
        self,
        rows: np.ndarray,
        column: str | None,
        what: str,
        advice: str,
        *,
        values: np.ndarray | None = None,
        references: np.ndarray | None = None,
        level: Level = "problem",
    ) -> None:
        """Add a problem, or a warning, for each row.

        Args:
            rows: data rows, 0 for `first`, shape (k,); k may be 0.
            column: name of the column, or None.
            what: a phrase; `{value}` stands for the cell and `{other}` for the other row's line.
            advice: a sentence.
            values: the values, shape (k,), or None.
            references: another row that each problem refers to, shape (k,), or None.
            level: which of the two.
        """
        if len(rows) == 0:
            return
        self.counts[level] += len(rows)
        entries = self._kept[level]
        for i, row in enumerate(rows[:SHOWN]):
            value = None if values is None else _text(values[i])
            reference = None if references is None else int(references[i]) + self.first
            entries.append(_Entry(int(row) + self.first, column, value, what, advice, reference))
        entries.sort(key=lambda entry: entry.row)
        del entries[SHOWN:]

    def listed(self, level: Level, locate: Locate, place: str) -> tuple[RecordingProblem, ...]:
        """Return up to `SHOWN` problems of a level, in file order, each with its line or row."""
        entries = self._kept[level]
        rows = {entry.row for entry in entries}
        rows |= {entry.reference for entry in entries if entry.reference is not None}
        places = locate(rows) if rows else {}
        return tuple(self._problem(entry, places, place) for entry in entries)

    def raise_problems(self, locate: Locate, place: str) -> None:
        """Raise the problems as a RecordingError, if there are any."""
        if self.counts["problem"]:
            raise RecordingError(self.listed("problem", locate, place), self.counts["problem"])

    def _problem(self, entry: _Entry, places: Mapping[int, Place], place: str) -> RecordingProblem:
        line, cells = places.get(entry.row, (None, {}))
        value = cells.get(entry.column or "", entry.value)
        message = entry.what.replace("{value}", value or "blank")
        if entry.reference is not None:
            referenced = places.get(entry.reference, (None, {}))[0]
            message = message.replace("{other}", f"{place} {referenced}")
        return RecordingProblem(self.file, message, entry.advice, line, entry.column, value, place)


def _text(value: np.generic) -> str:
    number = value.item()
    if isinstance(number, float):
        return "" if np.isnan(number) else f"{number!r}".removesuffix(".0")
    return str(number)


#: Formats of files, and a table in memory.
Kind = Literal["csv", "csv.gz", "parquet", "table"]


@dataclass(frozen=True)
class Column:
    """One column of a recording."""

    name: str  #: name in the header.
    unit: str  #: unit of every value, as it is printed.
    low: float = float("-inf")  #: smallest value that is accepted, in `unit`.
    high: float = float("inf")  #: largest value that is accepted, in `unit`.
    blank: bool = False  #: whether a cell may be blank (read as NaN).
    integer: bool = False  #: whether the column holds integers of 64 bits.
    positive: bool = False  #: whether `low` itself is outside the range.
    advice: str = "Fix the row."  #: what to do about a value outside the range.

    @property
    def span(self) -> str:
        """The accepted range in words, such as `0..100 %`."""
        if self.positive:
            return f"the range above {self.low:g} and up to {self.high:g} {self.unit}"
        return f"{self.low:g}..{self.high:g} {self.unit}".rstrip()


def _label(name: str, unit: str, quantity: str) -> Column:
    advice = f"Write the {quantity} of the test lung in {unit}."
    return Column(name, unit, 0.0, 500.0, positive=True, advice=advice)


def _measured(name: str, unit: str, low: float, high: float) -> Column:
    advice = f"Write the {name} in {unit}, or leave the cell blank."
    return Column(name, unit, low, high, blank=True, advice=advice)


COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("id", "", blank=True, integer=True),
        Column("breath_id", "", integer=True),
        _label("R", "cmH2O/(L/s)", "resistance"),
        _label("C", "mL/cmH2O", "compliance"),
        Column("time_step", "s", blank=True),
        Column("u_in", "%", 0.0, 100.0, advice="Fix the row or pass --clip."),
        Column("u_out", "", 0.0, 1.0, advice="Write 1 while the expiratory valve is open, else 0."),
        _measured("pressure", "cmH2O", -20.0, 120.0),
        _measured("flow", "mL/s", -10_000.0, 10_000.0),
        _measured("volume", "mL", -20_000.0, 20_000.0),
    )
}

OPTIONAL: tuple[str, ...] = ("flow", "volume")
REQUIRED: tuple[str, ...] = tuple(name for name in COLUMNS if name not in OPTIONAL)
HEADER: str = ",".join(REQUIRED) + "[,flow][,volume]"

#: Columns by which a RespiraWorks file is recognised.
_RESPIRAWORKS = {"run", "test", "breath", "cmd_inh_valve", "cmd_exh_valve"}


def check_header(file: str, names: Sequence[str], line: int | None) -> tuple[RecordingProblem, ...]:
    """Check the names of the columns, in line ``line``; return a warning for each unknown one.

    Raises:
        RecordingError: a column is missing or occurs twice.
    """
    problems = []
    for name in dict.fromkeys(names):
        if name in COLUMNS and names.count(name) > 1:
            message = f"the header names {name} {names.count(name)} times"
            problems.append(RecordingProblem(file, message, "Keep one of them.", line, name, name))
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        column = missing[0] if len(missing) == 1 else None
        message = f"missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
        problems.append(RecordingProblem(file, message, _advice(names, missing), line, column))
    if problems:
        raise RecordingError(problems)
    advice = f"Rename it if it is one of {HEADER}."
    return tuple(
        RecordingProblem(file, f"column {name!r} is not known and is ignored", advice, line, name)
        for name in dict.fromkeys(names)
        if name not in COLUMNS
    )


def _advice(names: Sequence[str], missing: Sequence[str]) -> str:
    if set(names) >= _RESPIRAWORKS:
        return (
            "This is a RespiraWorks file: `ventbench mechanics` takes it, and `ventbench data "
            "import --select run=... --select test=...` brings a run into the schema."
        )
    if len(names) == 1 and any(mark in names[0] for mark in ";\t|"):
        return "The columns must be separated by commas; `ventbench data import` reads others."
    hints = []
    for name in missing:
        plain = {
            name_given.strip().lower(): name_given
            for name_given in names
            if name_given not in COLUMNS
        }
        hints.extend(
            f"rename {plain[match]!r} to {name}"
            for match in get_close_matches(name.lower(), plain, n=1, cutoff=0.75)
        )
    if hints:
        return f"Perhaps {', '.join(hints)}."
    return f"The header is {HEADER}; `ventbench data import` reads other tables."
