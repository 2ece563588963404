"""The stress track on the board: ranks by the stress score, and stressor by severity as a chart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ventbench.board import pages
from ventbench.board.ranking import Interval, Row, Track, rank_ranges
from ventbench.stress.results import StressTables
from ventbench.stress.stressors import CATEGORIES, SEVERITIES, Condition, conditions, stressor
from ventbench.text import number

#: Shares of survived runs below which a field of the chart gets the next darker shade.
SHARES = (1.0, 0.95, 0.85, 0.7, 0.5, 0.3)

#: Titles of the categories, in the words of a clinician.
CATEGORY_TITLES = {
    "valve": "Valve and supply",
    "circuit": "Circuit",
    "sensor": "Sensor",
    "lung": "Airway and lung",
    "patient": "Patient",
    "setting": "Other lungs",
    "pairs": "Two at once, both mild",
}


@dataclass(frozen=True)
class StressRow:
    """One entry on the stress track.

    Attributes:
        row: of the entry on the robustness track.
        tables: its stressed runs.
        score: stress score with its interval, cmH2O; None if a run failed.
        rank: 1 + the number of entries that are better beyond doubt; None if a run failed.
        ranks: ranks that it may have, see :func:`ventbench.board.ranking.rank_ranges`.
    """

    row: Row
    tables: StressTables
    score: Interval | None
    rank: int | None
    ranks: tuple[int, int] | None

    @property
    def name(self) -> str:
        """Name of the entry."""
        return self.row.record.name


def rows(track: Track) -> list[StressRow]:
    """Entries of a track that were run under the newest table of stressors, best first.

    Args:
        track: only its ranked entries count; those of other tables of stressors are left out.
    """
    stressed = [(row, own) for row in track.ranked if (own := row.record.stress) is not None]
    newest = max((own.stressors for _, own in stressed), default=0)
    current = [(row, own.tables) for row, own in stressed if own.stressors == newest]
    first = current[0][1] if current else None
    alike = [(row, own) for row, own in current if first is not None and own.comparable(first)]
    whole = [(row, own) for row, own in alike if math.isfinite(own.score)]
    means = [own.resampled(own.by_lung_and_draw) for _, own in whole]
    ranges = rank_ranges(np.stack(means)) if means else []
    made = []
    for (row, own), mean, ranks in zip(whole, means, ranges, strict=True):
        low, high = np.quantile(mean, (0.025, 0.975))
        score = Interval(own.score, float(low), float(high))
        made.append(StressRow(row, own, score, ranks[0], ranks))
    failed = [
        StressRow(row, own, None, None, None) for row, own in alike if not math.isfinite(own.score)
    ]
    return sorted(made, key=lambda row: (row.tables.score, row.name)) + failed


def of_entry(made: Sequence[StressRow], name: str) -> StressRow | None:
    """The row of an entry."""
    return next((row for row in made if row.name == name), None)


def shown(row: StressRow) -> dict[str, Any]:
    """A row for the templates."""
    figures = row.tables.headline()
    return {
        "name": row.name,
        "rank": row.rank,
        "ranks": row.ranks,
        "path": pages.entry_path(row.row.record.version, row.row.record.track, row.name),
        "family": row.row.record.manifest.family,
        "score": pages.interval(row.score, 2),
        "unstressed": pages.figure(row.tables.unstressed, 2),
        "rise": pages.signed(_float(figures["rise"]), 2),
        "rise_value": "" if figures["rise"] is None else f"{figures['rise']:.6f}",
        "survived": f"{100 * figures['survived']:.1f}",
        "unsafe": figures["unsafe_runs"],
        "runs": figures["stressed_runs"],
        "alarm": pages.figure(float(np.mean(row.tables.alarm_s[1:])), 2),
        "worst": pages.figure(_float(figures["worst_error"]), 1),
        "worst_where": title_of(figures["worst_condition"]),
    }


def chart(made: Sequence[StressRow]) -> list[dict[str, Any]]:
    """Stressor by severity: groups of rows, each with the fields of every entry.

    Args:
        made: entries under the same conditions; one or several.

    Returns:
        A group a category with ``title`` and ``rows``; a row has a ``title`` and ``fields``, for
        each entry one of each severity.
    """
    if not made:
        return []
    index = {condition: k for k, condition in enumerate(made[0].tables.conditions)}
    groups = []
    for category in CATEGORIES:
        names = dict.fromkeys(
            c.stressors[0]
            for c in index
            if len(c.stressors) == 1 and stressor(c.stressors[0]).category == category
        )
        lines = [
            _line(
                stressor(name).title, [(Condition((name,), s), s) for s in SEVERITIES], made, index
            )
            for name in names
        ]
        groups.append({"title": CATEGORY_TITLES[category], "rows": lines})
    pairs = [c for c in index if len(c.stressors) > 1]
    lines = [_line(_pair(c), [(c, "mild"), (None, "")], made, index) for c in pairs]
    groups.append({"title": CATEGORY_TITLES["pairs"], "rows": lines})
    return [group for group in groups if group["rows"]]


def title_of(condition: str) -> str:
    """A condition's id in words."""
    for known in conditions():
        if known.id == condition:
            titles = " + ".join(stressor(name).title for name in known.stressors)
            return f"{titles}, {known.severity}" if titles else "without stressor"
    return condition


def _pair(condition: Condition) -> str:
    return " + ".join(stressor(name).title for name in condition.stressors)


def _line(
    title: str,
    columns: Sequence[tuple[Condition | None, str]],
    made: Sequence[StressRow],
    index: dict[Condition, int],
) -> dict[str, Any]:
    fields = []
    for entry in made:
        for condition, severity in columns:
            at = None if condition is None else index.get(condition)
            fields.append(None if at is None else _field(entry, at, f"{title}, {severity}"))
    return {"title": title, "fields": fields}


def _field(entry: StressRow, at: int, title: str) -> dict[str, Any]:
    own = entry.tables.by_condition[at]
    share, rise = own["survived"], _float(own["rise_cmH2O"])
    unsafe = own["unsafe_runs"]
    return {
        "share": f"{100 * share:.0f}",
        "rise": number(rise, 1, sign=True) if math.isfinite(rise) else pages.NONE,
        "unsafe": unsafe,
        "shade": f"s{sum(share < limit for limit in SHARES)}",
        "said": f"{entry.name}, {title}: {100 * share:.0f} % survived, {unsafe} unsafe",
    }


def _float(value: float | None) -> float:
    return math.nan if value is None else value
