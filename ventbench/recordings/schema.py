"""The schema of a recording: columns with units, ranges and types; and its problems.

One row is one sample. The rows of a breath follow one another, in time order. The header is
`id,breath_id,R,C,time_step,u_in,u_out,pressure`, and `flow` or `volume` may be added. Parquet files
have columns of the same names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.base.files import data_beside

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


Place = tuple[int, Mapping[str, str]]
"""Position of a row in the file: its line and, if they are known, its cells as written."""


#: Formats of files, and a table in memory.
Kind = Literal["csv", "csv.gz", "parquet", "table"]


@dataclass(frozen=True)
class Column:
    """One column of a recording; ``columns.toml`` has them."""

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

    def outside(self, values: Floats) -> Bools:
        """Whether values are none that the column accepts, ``(m,)``; a blank is not outside."""
        if self.name == "u_out":
            return (values != 0.0) & (values != 1.0) & ~np.isnan(values)
        low = values <= self.low if self.positive else values < self.low
        return low | (values > self.high)


COLUMNS: dict[str, Column] = {
    name: Column(name, **column) for name, column in data_beside(__file__, "columns.toml").items()
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
        return f"Perhaps {', '.join(hints)}; `ventbench data import` reads other tables."
    return f"The header is {HEADER}; `ventbench data import` reads other tables."
