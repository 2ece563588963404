"""Collecting problems by row while a file is read, and giving them their lines afterwards."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ventbench.recordings.errors import SHOWN, Problem, RecordingError

Level = Literal["problem", "warning"]
Place = tuple[int, Mapping[str, str]]
"""Where a row stands in the file: its line and, if they are known, its cells as written."""
Locate = Callable[[Collection[int]], Mapping[int, Place]]


@dataclass(frozen=True)
class _Found:
    row: int
    column: str | None
    value: str | None
    what: str
    advice: str
    other: int | None


@dataclass
class Findings:
    """Problems and warnings of one file: the first `SHOWN` of each, and a count of all.

    Attributes:
        file: the path as the caller wrote it.
        counts: how many problems and warnings were added.
    """

    file: str
    counts: dict[Level, int] = field(default_factory=lambda: {"problem": 0, "warning": 0})
    _kept: dict[Level, list[_Found]] = field(default_factory=lambda: {"problem": [], "warning": []})

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
        """Add one problem for each of some rows.

        Args:
            rows: data rows in the file, 0 for the first, shape (k,); none is fine.
            column: the column meant, or None.
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
            kept.append(_Found(int(row), column, value, what, advice, other))
        kept.sort(key=lambda found: found.row)
        del kept[SHOWN:]

    def listed(self, level: Level, locate: Locate, place: str) -> tuple[Problem, ...]:
        """The kept problems of a level with their lines.

        Args:
            level: `problem` or `warning`.
            locate: finds rows in the file.
            place: `line` or `row`: what the numbers count.

        Returns:
            Up to `SHOWN` problems in file order.
        """
        kept = self._kept[level]
        wanted = {found.row for found in kept}
        wanted |= {found.other for found in kept if found.other is not None}
        places = locate(wanted) if wanted else {}
        return tuple(self._problem(found, places, place) for found in kept)

    def raise_problems(self, locate: Locate, place: str) -> None:
        """Raise what was found.

        Raises:
            RecordingError: there is at least one problem.
        """
        if self.counts["problem"]:
            raise RecordingError(self.listed("problem", locate, place), self.counts["problem"])

    def _problem(self, found: _Found, places: Mapping[int, Place], place: str) -> Problem:
        line, cells = places.get(found.row, (None, {}))
        value = cells.get(found.column or "", found.value)
        what = found.what.replace("{value}", value or "blank")
        if found.other is not None:
            other = places.get(found.other, (None, {}))[0]
            what = what.replace("{other}", f"{place} {other}")
        return Problem(self.file, what, found.advice, line, found.column, value, place)


def _text(value: np.generic) -> str:
    number = value.item()
    if isinstance(number, float):
        return "" if np.isnan(number) else f"{number!r}".removesuffix(".0")
    return str(number)
