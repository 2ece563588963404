"""The schema of a recording: columns with units, ranges and types, and the check of a header.

One row is one sample. The rows of a breath follow one another, in time order. The header is
`id,breath_id,R,C,time_step,u_in,u_out,pressure`, and `flow` or `volume` may be added. Parquet files
have columns of the same names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

from ventbench.recordings.problems import RecordingError, RecordingProblem

#: Formats of files, and a table in memory.
Kind = Literal["csv", "csv.gz", "parquet", "xlsx", "table"]


@dataclass(frozen=True)
class Column:
    """One column of a recording.

    Attributes:
        name: name in the header.
        unit: unit of every value, as it is printed.
        low: smallest value that is accepted, in `unit`.
        high: largest value that is accepted, in `unit`.
        blank: whether a cell may be blank (read as NaN).
        whole: whether the column holds integers of 64 bits.
        positive: whether `low` itself is outside the range.
        advice: what to do about a value outside the range.
    """

    name: str
    unit: str
    low: float = float("-inf")
    high: float = float("inf")
    blank: bool = False
    whole: bool = False
    positive: bool = False
    advice: str = "Fix the row."

    @property
    def span(self) -> str:
        """The accepted range in words, such as `0..100 %`."""
        if self.positive:
            return f"the range above {self.low:g} and up to {self.high:g} {self.unit}"
        return f"{self.low:g}..{self.high:g} {self.unit}".rstrip()


def _label(name: str, unit: str, what: str) -> Column:
    advice = f"Write the {what} of the test lung in {unit}."
    return Column(name, unit, 0.0, 500.0, positive=True, advice=advice)


def _measured(name: str, unit: str, low: float, high: float) -> Column:
    advice = f"Write the {name} in {unit}, or leave the cell blank."
    return Column(name, unit, low, high, blank=True, advice=advice)


COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("id", "", blank=True, whole=True),
        Column("breath_id", "", whole=True),
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
    """Check the names of the columns.

    Args:
        file: the path as the caller wrote it.
        names: the column names in file order.
        line: line of the header, or None in Parquet.

    Returns:
        A warning for each unknown column, which is ignored.

    Raises:
        RecordingError: a column is missing or occurs twice.
    """
    problems = []
    for name in dict.fromkeys(names):
        if name in COLUMNS and names.count(name) > 1:
            what = f"the header names {name} {names.count(name)} times"
            problems.append(RecordingProblem(file, what, "Keep one of them.", line, name, name))
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        column = missing[0] if len(missing) == 1 else None
        what = f"missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
        problems.append(RecordingProblem(file, what, _advice(names, missing), line, column))
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
            "This is a RespiraWorks file, of another ventilator and with other columns: read it "
            "with ventbench.recordings.load_respiraworks."
        )
    if len(names) == 1 and any(mark in names[0] for mark in ";\t|"):
        return "The columns must be separated by commas; `ventbench data import` reads others."
    hints = []
    for name in missing:
        plain = {other.strip().lower(): other for other in names if other not in COLUMNS}
        for match in get_close_matches(name.lower(), plain, n=1, cutoff=0.75):
            hints.append(f"rename {plain[match]!r} to {name}")
    if hints:
        return f"Perhaps {', '.join(hints)}."
    return f"The header is {HEADER}; `ventbench data import` reads other tables."
