"""Problems of a recording: where they are, what they are, what to do about them.

Checks collect problems by row while a file is read; only the few that are shown are looked up in
the file afterwards, for their line and the cell as it is written.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from ventbench.base.errors import InputError

SHOWN = 20
"""Number of problems that are kept and shown; further ones are only counted."""


@dataclass(frozen=True)
class RecordingProblem:
    """An error in a recording, or something that its user should know.

    Attributes:
        file: the path as the caller wrote it.
        what: the problem, a phrase without a full stop.
        advice: what to do about it, a sentence.
        line: line of a CSV file, 1 for the header; in Parquet the row, 1 for the first. None for
            the whole file.
        column: name of the column, or None.
        value: the cell as it is written in the file (CSV) or printed (Parquet), or None.
        place: `line` or `row`, the unit of `line`.
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


def fail(file: str, what: str, advice: str, line: int | None = None) -> RecordingError:
    """Make a RecordingError about a whole file or a line."""
    return RecordingError(RecordingProblem(file, what, advice, line))


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
    other: int | None


@dataclass
class ProblemLog:
    """Problems and warnings of one file by row; keeps the first `SHOWN` of each, and counts all.

    Attributes:
        file: the path as the caller wrote it.
        counts: number of problems and of warnings.
    """

    file: str
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
        others: np.ndarray | None = None,
        level: Level = "problem",
    ) -> None:
        """Add a problem for each row.

        Args:
            rows: data rows in the file, 0 for the first, shape (k,); k may be 0.
            column: name of the column, or None.
            what: a phrase; `{value}` stands for the cell and `{other}` for the other row's line.
            advice: a sentence.
            values: the values, shape (k,), or None.
            others: another row that each problem refers to, shape (k,), or None.
            level: `problem` or `warning`.
        """
        if len(rows) == 0:
            return
        self.counts[level] += len(rows)
        kept = self._kept[level]
        for i, row in enumerate(rows[:SHOWN]):
            value = None if values is None else _text(values[i])
            other = None if others is None else int(others[i])
            kept.append(_Entry(int(row), column, value, what, advice, other))
        kept.sort(key=lambda entry: entry.row)
        del kept[SHOWN:]

    def add_once(self, row: int, column: str, what: str, advice: str, value: np.generic) -> None:
        """Add a problem of many rows, unless the same value of the column is listed already."""
        known = {(entry.column, entry.value, entry.what) for entry in self._kept["problem"]}
        if (column, _text(value), what) not in known:
            self.add(np.array([row]), column, what, advice, values=np.array([value]))

    def listed(self, level: Level, locate: Locate, place: str) -> tuple[RecordingProblem, ...]:
        """Return the kept problems of a level with their lines.

        Args:
            level: `problem` or `warning`.
            locate: finds rows in the file.
            place: `line` or `row`, the unit of the positions.

        Returns:
            Up to `SHOWN` problems in file order.
        """
        kept = self._kept[level]
        wanted = {entry.row for entry in kept}
        wanted |= {entry.other for entry in kept if entry.other is not None}
        places = locate(wanted) if wanted else {}
        return tuple(self._problem(entry, places, place) for entry in kept)

    def raise_problems(self, locate: Locate, place: str) -> None:
        """Raise the problems, if there are any.

        Raises:
            RecordingError: there is at least one problem.
        """
        if self.counts["problem"]:
            raise RecordingError(self.listed("problem", locate, place), self.counts["problem"])

    def _problem(self, entry: _Entry, places: Mapping[int, Place], place: str) -> RecordingProblem:
        line, cells = places.get(entry.row, (None, {}))
        value = cells.get(entry.column or "", entry.value)
        what = entry.what.replace("{value}", value or "blank")
        if entry.other is not None:
            other = places.get(entry.other, (None, {}))[0]
            what = what.replace("{other}", f"{place} {other}")
        return RecordingProblem(self.file, what, entry.advice, line, entry.column, value, place)


def _text(value: np.generic) -> str:
    number = value.item()
    if isinstance(number, float):
        return "" if np.isnan(number) else f"{number!r}".removesuffix(".0")
    return str(number)
