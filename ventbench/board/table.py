"""``leaderboard.csv``: every entry of every board in one table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from typing import Any

from ventbench.board.ranking import Interval, Row
from ventbench.board.text import plain, step_time

COLUMNS = (
    "version", "track", "status", "rank", "rank_low", "rank_high", "name", "family",
    "score_cmH2O", "score_low", "score_high", "to_pid_cmH2O", "to_pid_low", "to_pid_high",
    "to_above_cmH2O", "to_above_low", "to_above_high", "nominal_cmH2O", "worst_cmH2O",
    "worst_lung", "worst_pip", "exploitation_cmH2O", "clipped_share", "act_median_us",
    "failed_cells", "safe", "created", "record", "submission", "reasons",
)  # fmt: skip


def row(version: int, track: str, status: str, one: Row) -> list[Any]:
    """One line of the table, in the order of :data:`COLUMNS`."""
    record = one.record
    content = record.content
    worst, lung, pip = one.worst
    return [
        version,
        track,
        status,
        "" if one.rank is None else one.rank,
        *(one.ranks or ("", "")),
        record.name,
        record.manifest["family"],
        *_interval(one.score),
        *_interval(one.to_baseline),
        *_interval(one.to_above),
        _number(one.nominal),
        _number(worst),
        lung,
        "" if math.isnan(pip) else f"{pip:g}",
        _number(record.exploitation),
        _number(record.clipped_share),
        _number(step_time(content["timing"]), 2),
        content["failed_cells"],
        "yes" if all(content["safe"]) else "no",
        content["created"],
        record.sha256,
        content["submission"]["sha256"],
        plain("; ".join(one.entry.reasons)),
    ]


def text(rows: Iterable[list[Any]]) -> str:
    """The whole file."""
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(rows)
    return output.getvalue()


def _interval(found: Interval | None) -> tuple[str, str, str]:
    if found is None:
        return "", "", ""
    return _number(found.value), _number(found.low), _number(found.high)


def _number(value: float, digits: int = 6) -> str:
    # + 0.0: no "-0.000000".
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else ""
