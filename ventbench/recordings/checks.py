"""Checks of values and of breaths. All are pure but for what they add to `Findings`."""

from __future__ import annotations

import numpy as np

from ventbench.recordings.findings import Findings
from ventbench.recordings.rows import Rows
from ventbench.recordings.schema import COLUMNS, Column


def check_values(rows: Rows, findings: Findings, *, clip: bool = False) -> dict[str, np.ndarray]:
    """Check each cell by itself: blank, infinite, out of range.

    Args:
        rows: whole breaths.
        findings: takes the problems.
        clip: bring u_in into 0..100 % and warn, where it is a problem otherwise.

    Returns:
        The columns, with u_in clipped if asked.
    """
    columns = dict(rows.columns)
    _add_blank(rows, findings, "breath_id", rows.blank_id)
    for name, values in rows.columns.items():
        column = COLUMNS[name]
        if column.whole:
            continue
        if not column.blank:
            _add_blank(rows, findings, name, np.isnan(values))
        infinite = np.isinf(values)
        if infinite.any():
            at = np.flatnonzero(infinite)
            what = "{value} is infinite"
            findings.add(rows.row0 + at, name, what, "Fix the row.", values=values[at])
        outside = _outside(values, column) & ~infinite
        if not outside.any():
            continue
        at = np.flatnonzero(outside)
        level, advice = "problem", column.advice
        what = f"{{value}} is outside {column.span}"
        if name == "u_in" and clip:
            level, advice, what = "warning", "It was clipped.", what
            columns[name] = np.where(infinite, values, np.clip(values, column.low, column.high))
        elif name == "u_out":
            what = "{value} is neither 0 nor 1"
        elif column.positive:
            what = f"{{value}} is not in {column.span}"
        findings.add(rows.row0 + at, name, what, advice, values=values[at], level=level)
    return columns


def _add_blank(rows: Rows, findings: Findings, name: str, blank: np.ndarray) -> None:
    if blank.any():
        what = f"the cell is blank, but {name} is needed in every row"
        at = rows.row0 + np.flatnonzero(blank)
        values = np.full(len(at), np.nan)
        findings.add(at, name, what, "Fill it in or remove the breath.", values=values)


def _outside(values: np.ndarray, column: Column) -> np.ndarray:
    if column.name == "u_out":
        return (values != 0.0) & (values != 1.0) & ~np.isnan(values)
    low = values <= column.low if column.positive else values < column.low
    return low | (values > column.high)


def check_ids(rows: Rows, findings: Findings, seen: dict[int, int]) -> None:
    """Check that no breath comes back after another one.

    Args:
        rows: whole breaths.
        findings: takes the problems.
        seen: first row of each breath so far, by breath_id; the new ones are added to it.
    """
    again, first = [], []
    starts = rows.row0 + rows.starts
    ids = rows.columns["breath_id"][rows.starts]
    for breath, row in zip(ids.tolist(), starts.tolist(), strict=True):
        earlier = seen.setdefault(breath, row)
        if earlier != row:
            again.append(row)
            first.append(earlier)
    findings.add(
        np.array(again, dtype=np.int64),
        "breath_id",
        "breath {value} comes again, it is already at {other}",
        "Keep the rows of a breath together, and give each breath an id of its own.",
        values=np.array([rows.columns["breath_id"][row - rows.row0] for row in again]),
        others=np.array(first, dtype=np.int64),
    )


def check_lung(rows: Rows, findings: Findings) -> None:
    """Check that R and C stay the same within each breath."""
    breath = np.repeat(np.arange(len(rows.starts)), rows.lengths)
    for name in ("R", "C"):
        values = rows.columns[name]
        first = values[rows.starts][breath]
        with np.errstate(invalid="ignore"):
            at = np.flatnonzero((values != first) & ~np.isnan(values) & ~np.isnan(first))
        if len(at) == 0:
            continue
        at = at[np.unique(breath[at], return_index=True)[1]]
        findings.add(
            rows.row0 + at,
            name,
            f"{name} changes to {{value}} within the breath, which starts at {{other}}",
            "A breath has one lung: give the second part its own breath_id, or fix the row.",
            values=values[at],
            others=rows.row0 + rows.starts[breath[at]],
        )


def check_single(rows: Rows, findings: Findings) -> None:
    """Check that each breath has at least two samples."""
    at = rows.starts[rows.lengths == 1]
    findings.add(
        rows.row0 + at,
        "breath_id",
        "breath {value} has one sample, at least two are needed",
        "Remove it, or keep the rows of a breath together.",
        values=rows.columns["breath_id"][at],
    )


def check_row_ids(rows: Rows, findings: Findings, last: int | None) -> int:
    """Warn where the column id does not increase; it is not used otherwise.

    Args:
        rows: whole breaths.
        findings: takes the warnings.
        last: id of the row before, or None at the start.

    Returns:
        The last id.
    """
    ids = rows.columns["id"]
    before = np.concatenate([ids[:1] - 1 if last is None else [last], ids[:-1]])
    at = np.flatnonzero(ids <= before)
    what = "id {value} is not greater than the one before"
    advice = "Number the rows 1, 2, 3, ...; the column is not used for anything else."
    findings.add(rows.row0 + at, "id", what, advice, values=ids[at], level="warning")
    return int(ids[-1])
