"""A comparison with a paper as plain data: sections with tables, as Markdown or JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ventbench.base.files import json_values

#: How a claim of the paper came out; ``none`` where a section makes no claim.
Verdict = Literal["agrees", "in part", "differs", "none"]


def below(interval: tuple[float, float], bound: float = 0.0) -> Verdict:
    """Verdict on the claim that a quantity is below a bound, by its interval of 95 %."""
    low, high = interval
    return "agrees" if high <= bound else "differs" if low > bound else "in part"


def every(*parts: Verdict) -> Verdict:
    """Verdict on a claim of several parts: theirs if they are one, else in part."""
    return parts[0] if len(set(parts)) == 1 else "in part"


#: Value of a cell: a text, a number, or None where there is none.
Cell = str | float | None


@dataclass(frozen=True)
class Table:
    """A table."""

    caption: str  #: what is in it, with units.
    columns: tuple[str, ...]  #: headings; the first column holds texts.
    rows: tuple[tuple[Cell, ...], ...]  #: cells, a row as long as ``columns``.
    digits: int = 3  #: decimals of the numbers.

    def to_markdown(self) -> str:
        """The table as it is shown."""
        rows = [[self._text(cell) for cell in row] for row in self.rows]
        texts = [self.columns, ["---"] * len(self.columns), *rows]
        return "\n".join(f"| {' | '.join(row)} |" for row in texts)

    def _text(self, cell: Cell) -> str:
        if cell is None:
            return "-"
        return cell if isinstance(cell, str) else f"{cell:.{self.digits}f}"


@dataclass(frozen=True)
class Chart:
    """A figure of the paper as it comes out here."""

    caption: str  #: what it shows.
    x: str  #: label of the abscissa, with its unit; of bars, what has a group.
    y: str  #: label of the ordinate, with its unit.
    #: abscissae, or names of the groups of bars, and ordinates by name; None where there is none.
    series: Mapping[str, tuple[Sequence[float | str], Sequence[float | None]]]


def bars(table: Table, y: str, columns: Sequence[str]) -> Chart:
    """A chart of columns of a table, a group of bars a row."""
    groups = [str(row[0]) for row in table.rows]
    series = {}
    for name in columns:
        cells = [row[table.columns.index(name)] for row in table.rows]
        series[name] = (groups, [None if isinstance(cell, str) else cell for cell in cells])
    return Chart(table.caption, table.columns[0], y, series)


@dataclass(frozen=True)
class Section:
    """One table, figure or claim of the paper beside ours."""

    id: str  #: short name.
    title: str  #: what is compared.
    place: str  #: where it stands in the paper, such as ``"table 2"``.
    claim: str  #: what the paper says, in other words.
    verdict: Verdict  #: how the claim came out here.
    finding: str  #: what came out here, in a sentence or two.
    source: str  #: how the figures here were made.
    tables: tuple[Table, ...] = ()  #: tables.
    charts: tuple[Chart, ...] = ()  #: the paper's figures.


@dataclass(frozen=True)
class Reproduction:
    """The whole comparison."""

    about: Mapping[str, Any]  #: simulators, protocol and versions that the figures belong to.
    sections: tuple[Section, ...]  #: in the order of the paper's argument.

    def to_json(self) -> dict[str, Any]:
        """JSON values, null where a number is missing."""
        return json_values(dataclasses.asdict(self))

    def to_markdown(self, picture: Callable[[Chart], str] | None = None) -> str:
        """The comparison as a page of documentation, with a picture of each chart where given."""
        about = ", ".join(f"{name} {value}" for name, value in self.about.items())
        parts = ["# The paper, reproduced", f"Figures of: {about}.", "## Claims"]
        claims = tuple((s.place, s.claim, s.verdict, s.finding) for s in self.sections)
        parts.append(Table("", ("paper", "claim", "here", "figures here"), claims).to_markdown())
        for section in self.sections:
            parts += [f"## {section.title}", f"*{section.place}; {section.source}*"]
            parts += [f"Paper: {section.claim}", f"Here (**{section.verdict}**): {section.finding}"]
            parts += map(picture, section.charts) if picture else ()
            for table in section.tables:
                parts += [f"{table.caption}:", table.to_markdown()]
        return "\n\n".join(parts) + "\n"
