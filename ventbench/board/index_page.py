"""The page of one version: both tracks as sortable tables, and who is not ranked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ventbench import protocol
from ventbench.board import hardware_table, pages, stress_table
from ventbench.board.hardware_table import HardwareRow
from ventbench.board.ranking import BASELINES, Interval, Row, SealedEntry, Track
from ventbench.board.sealed import DECIMALS
from ventbench.board.store import Store
from ventbench.text import number

if TYPE_CHECKING:
    import jinja2

#: Size of the small plot of an interval; the entry's dot never touches its edge.
WIDTH, MARGIN = 120, 6


def render(
    environment: jinja2.Environment,
    store: Store,
    version: int,
    versions: Sequence[int],
    tracks: Sequence[Track],
) -> str:
    """Return the page of a version.

    Args:
        environment: from :func:`ventbench.board.pages.environment`.
        store: the leaderboard.
        version: of the protocol.
        versions: all of them, newest first.
        tracks: of the version.
    """
    measured = {track.name: hardware_table.rows(store.records, track) for track in tracks}
    rows = [(track, status, row) for track in tracks for status, row in track.rows]
    header = rows[0][2].record.header if rows else None
    stressed = [row for track in tracks for row in stress_table.rows(track)]
    return environment.get_template("index.html.j2").render(
        version=version,
        versions=[
            {"number": v, "path": pages.version_path(v, versions), "here": v == version}
            for v in versions
        ],
        tracks=[_track(track, measured[track.name]) for track in tracks],
        aside=[_aside(*row) for row in rows],
        sealed=[_sealed(track, entry) for track in tracks for entry in track.sealed],
        seasons=sorted(store.seasons.values(), key=lambda season: season.id),
        simulators=pages.flatten(header.simulators) if header else [],
        draws=header.draws if header else None,
        normalised=version > 1,
        stress=[stress_table.shown(row) for row in stressed],
        chart=stress_table.chart(stressed),
        head=store.head,
        records=len(store.records),
        hardware=[
            {**hardware_table.shown(row), "track": track.name}
            for track in tracks
            for row in measured[track.name]
        ],
        protocol=protocol,
    )


def _track(track: Track, measured: Sequence[HardwareRow]) -> dict[str, Any]:
    scores = [own for row in track.ranked if (own := _ranked_by(row)) is not None]
    low = min((x.low for x in scores), default=1.0)
    high = max((x.high for x in scores), default=1.0)
    return {
        "name": track.name,
        "title": pages.TITLES[track.name],
        "baseline": BASELINES[track.name],
        "rows": [_row(track, row, low, high, measured) for row in track.ranked],
    }


def _row(
    track: Track, row: Row, low: float, high: float, measured: Sequence[HardwareRow]
) -> dict[str, Any]:
    record = row.record
    own = hardware_table.of_entry(measured, record.name)
    worst, lung, pip = row.worst
    step = pages.step_time(record.header.timing)
    return {
        "rank": row.rank,
        "ranks": row.ranks,
        "name": record.name,
        "path": pages.entry_path(track.version, track.name, record.name),
        "family": record.manifest.family,
        "baseline": record.name == BASELINES[track.name],
        "score": pages.interval(row.score),
        "plot": _plot(row, low, high),
        **_differences(row),
        "nominal": _figure(row.nominal),
        "worst": {**_figure(worst), "where": f"{lung}, {pip:g}"},
        "exploitation": _figure(record.exploitation),
        "clipped": _figure(100.0 * record.clipped_share, 1),
        "step": _figure(step, 0),
        "hardware": None if own is None else hardware_table.shown(own),
    }


def _ranked_by(row: Row) -> Interval | None:
    """The score that ranks: the normalised one in version 2."""
    return row.score if row.normalised is None else row.normalised.score


def _differences(row: Row) -> dict[str, Any]:
    """Differences of the score that ranks, and in version 2 that score."""
    own = row.normalised
    if own is None:
        return {
            "normalised": None,
            "to_pid": pages.difference(row.to_baseline),
            "to_above": pages.difference(row.to_above),
        }
    return {
        "normalised": pages.interval(own.score, 1),
        "to_pid": pages.difference(own.to_baseline, 1),
        "to_above": pages.difference(own.to_above, 1),
    }


def _aside(track: Track, status: str, row: Row) -> dict[str, Any] | None:
    """A line of the list of entries that are not ranked."""
    if status == "ranked":
        return None
    return {
        "name": row.record.name,
        "track": track.name,
        "path": pages.entry_path(track.version, track.name, row.record.name),
        "official": status != "not official",
        "score": pages.interval(row.score),
        "reasons": list(row.entry.reasons),
    }


def _sealed(track: Track, entry: SealedEntry) -> dict[str, Any]:
    """A line of the list of entries on hidden draws."""
    content = entry.record.content
    return {
        "season": content.season.id,
        "name": entry.record.name,
        "track": track.name,
        "created": content.created,
        "scores": {
            key: pages.NONE if value is None else number(value, DECIMALS)
            for key, value in sorted(content.scores.items())
        },
        "state": "official" if entry.official else "not official",
        "reasons": list(entry.reasons),
    }


def _plot(row: Row, low: float, high: float) -> dict[str, str] | None:
    """Positions of a score and its interval on an axis that all rows of a track share."""
    score = _ranked_by(row)
    if score is None:
        return None
    # A logarithm, so that one bad entry does not press all others together.
    span = math.log(high / low) if high > low > 0.0 else 0.0

    def x(value: float) -> float:
        share = math.log(max(value, low) / low) / span if span else 0.5
        return MARGIN + (WIDTH - 2 * MARGIN) * share

    left, dot, right = (x(v) for v in (score.low, score.value, score.high))
    return {"x": f"{left:.1f}", "width": f"{max(right - left, 1.0):.1f}", "dot": f"{dot:.1f}"}


def _figure(value: float, digits: int = 3) -> dict[str, str]:
    """Text of a number and what it is sorted by; empty if it does not exist."""
    if not math.isfinite(value):
        return {"text": pages.NONE, "value": ""}
    return {"text": number(value, digits), "value": f"{value:.9g}"}
