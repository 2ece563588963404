"""Checking the names of the columns."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

from ventbench.recordings.errors import Problem, RecordingError
from ventbench.recordings.schema import COLUMNS, HEADER, REQUIRED

_RESPIRAWORKS = {"run", "test", "breath", "cmd_inh_valve", "cmd_exh_valve"}


def check_names(file: str, names: Sequence[str], line: int | None) -> tuple[Problem, ...]:
    """Check column names.

    Args:
        file: the path as the caller wrote it.
        names: the column names in file order.
        line: line of the header, or None in Parquet.

    Returns:
        A warning for each column that is not known and will be ignored.

    Raises:
        RecordingError: a column is missing or is there twice.
    """
    problems = []
    for name in dict.fromkeys(names):
        if name in COLUMNS and names.count(name) > 1:
            what = f"the header names {name} {names.count(name)} times"
            problems.append(Problem(file, what, "Keep one of them.", line, name, name))
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        column = missing[0] if len(missing) == 1 else None
        what = f"missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}"
        problems.append(Problem(file, what, _advice(names, missing), line, column))
    if problems:
        raise RecordingError(problems)
    advice = f"Rename it if it is one of {HEADER}."
    return tuple(
        Problem(file, f"column {name!r} is not known and is ignored", advice, line, name)
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
        return "The columns must be separated by commas."
    hints = []
    for name in missing:
        plain = {other.strip().lower(): other for other in names if other not in COLUMNS}
        for match in get_close_matches(name.lower(), plain, n=1, cutoff=0.75):
            hints.append(f"rename {plain[match]!r} to {name}")
    if hints:
        return f"Perhaps {', '.join(hints)}."
    return f"The header is {HEADER}."
