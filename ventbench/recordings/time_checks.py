"""Checks of the column time_step."""

from __future__ import annotations

import numpy as np

from ventbench.recordings.findings import Findings
from ventbench.recordings.rows import Rows

_SORT = "Sort the rows of the breath by time_step, and remove rows that are there twice."


def check_times(rows: Rows, findings: Findings) -> None:
    """Check that time increases within each breath, from one known time to the next.

    A row that repeats another one is named as such. In breaths without times, a row is a repeat if
    it equals the row before in every column, `id` too.

    Args:
        rows: whole breaths.
        findings: takes the problems.
    """
    time = rows.columns["time_step"]
    breath = np.repeat(np.arange(len(rows.starts)), rows.lengths)
    known = np.flatnonzero(np.isfinite(time))
    previous, here = known[:-1], known[1:]
    late = (time[here] <= time[previous]) & (breath[here] == breath[previous])
    if late.any():
        _add_order(rows, findings, previous[late], here[late])
    blank = np.isnan(time)
    at = np.flatnonzero(blank[1:] & blank[:-1] & (breath[1:] == breath[:-1])) + 1
    at = at[_same(rows, at - 1, at, rows.columns)] if len(at) else at
    _add_repeat(rows, findings, at - 1, at, "id", rows.columns["id"])


def _add_order(rows: Rows, findings: Findings, previous: np.ndarray, here: np.ndarray) -> None:
    time = rows.columns["time_step"]
    equal = time[previous] == time[here]
    names = [name for name in rows.columns if name != "id"]
    repeat = equal & _same(rows, previous, here, names)
    _add_repeat(rows, findings, previous[repeat], here[repeat], "time_step", time)
    for chosen, what in (
        (equal & ~repeat, "two rows of the breath have the time {value} s, the other is {other}"),
        (~equal, "time goes back to {value} s from {other}"),
    ):
        at, before = here[chosen], previous[chosen]
        findings.add(rows.row0 + at, "time_step", what, _SORT, values=time[at],
                     others=rows.row0 + before)  # fmt: skip


def _add_repeat(
    rows: Rows,
    findings: Findings,
    previous: np.ndarray,
    here: np.ndarray,
    column: str,
    values: np.ndarray,
) -> None:
    findings.add(
        rows.row0 + here,
        column,
        "the row repeats {other}",
        "Remove one of the two.",
        values=values[here],
        others=rows.row0 + previous,
    )


def _same(rows: Rows, one: np.ndarray, other: np.ndarray, names: object) -> np.ndarray:
    same = np.ones(len(one), dtype=bool)
    for name in names:  # type: ignore[attr-defined]
        a, b = rows.columns[name][one], rows.columns[name][other]
        same &= (a == b) | ((a != a) & (b != b))
    return same
