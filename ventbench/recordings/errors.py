"""A problem in a recording: where it is, what it is, what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ventbench.errors import InputError

SHOWN = 20
"""How many problems are kept and shown; the others are only counted."""


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong, or worth knowing, in a recording.

    Attributes:
        file: the path as the caller wrote it.
        what: what is wrong, a phrase without a full stop.
        advice: what to do about it, a sentence.
        line: where it is: in CSV the line, 1 for the header; in Parquet the row, 1 for the first.
            None if the whole file is meant.
        column: name of the column, or None.
        value: the cell as it is written in the file (CSV) or printed (Parquet), or None.
        place: `line` or `row`: what `line` counts.
    """

    file: str
    what: str
    advice: str
    line: int | None = None
    column: str | None = None
    value: str | None = None
    place: str = "line"

    def __str__(self) -> str:
        """The problem in one line: where, what, advice."""
        where = self.file
        if self.line is not None:
            where += f" {self.place} {self.line}"
        if self.column is not None:
            where += f", column {self.column}"
        return f"{where}: {self.what}. {self.advice}"

    def to_dict(self) -> dict[str, Any]:
        """The same as plain values for JSON."""
        return asdict(self)


class RecordingError(InputError):
    """A recording cannot be used. Carries up to `SHOWN` problems and the count of all.

    Attributes:
        problems: the first problems, in file order; never empty.
        total: how many there are in all, at least `len(problems)`.
    """

    def __init__(self, problems: Problem | Sequence[Problem], total: int | None = None) -> None:
        """Keep the problems.

        Args:
            problems: one problem or several, in file order; at least one.
            total: the count of all problems, if more were found than are given.
        """
        listed = (problems,) if isinstance(problems, Problem) else tuple(problems)
        self.problems: tuple[Problem, ...] = listed
        self.total: int = max(len(listed), total or 0)
        super().__init__(listed, self.total)

    def __str__(self) -> str:
        """All kept problems, a line each, and how many were left out."""
        lines = [str(problem) for problem in self.problems]
        if self.total > len(lines):
            lines.append(f"... and {self.total - len(lines)} more problems ({self.total} in all).")
        return "\n".join(lines)

    @property
    def file(self) -> str:
        """File of the first problem."""
        return self.problems[0].file

    @property
    def line(self) -> int | None:
        """Line (CSV) or row (Parquet) of the first problem."""
        return self.problems[0].line

    @property
    def column(self) -> str | None:
        """Column of the first problem."""
        return self.problems[0].column

    @property
    def value(self) -> str | None:
        """Value of the first problem."""
        return self.problems[0].value

    @property
    def advice(self) -> str:
        """Advice for the first problem."""
        return self.problems[0].advice
