"""CSV and pages: a pure function of the records, the same bytes at every build.

The page of a version holds both tracks as sortable tables, and who is not ranked. The page of an
entry holds figures, heat maps, traces against the PID, and how to reproduce it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ventbench import files, protocol
from ventbench.board import (
    frames,
    hardware_table,
    layout,
    pages,
    plots,
    ranking,
    store,
    stress_table,
)
from ventbench.board.hardware_table import HardwareRow
from ventbench.board.ranking import BASELINES, Interval, Row, SealedEntry, Track
from ventbench.board.record import Record
from ventbench.board.schema import ScoreHeader
from ventbench.board.sealed import DECIMALS
from ventbench.board.store import Store
from ventbench.lungs import lung as parse_lung
from ventbench.text import number

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True)
class Built:
    """What a build did.

    Attributes:
        records: how many there are.
        pages: how many files belong to the leaderboard, CSV included.
        changed: relative paths that were written or removed.
    """

    records: int
    pages: int
    changed: tuple[str, ...]


def content(leaderboard: Store) -> dict[str, bytes]:
    """Return every built file by its path within the leaderboard's folder.

    Args:
        leaderboard: all of its records.

    Raises:
        InputError: if jinja2 is not installed.
    """
    boards = ranking.boards(leaderboard.records, leaderboard.attested, leaderboard.breaches) or {
        pages.CURRENT: ranking.empty(pages.CURRENT)
    }
    built = {"leaderboard.csv": frames.csv_text(boards).encode()}
    environment = pages.environment()
    versions = list(boards)
    for version, tracks in boards.items():
        page = _version_page(environment, leaderboard, version, versions, tracks)
        built[pages.version_path(version, versions)] = page.encode()
        for track in tracks:
            measured = hardware_table.rows(leaderboard.records, track)
            built.update(_entry_pages(environment, track, versions, measured))
    return built


def build(folder: Path) -> Built:
    """Bring CSV and pages up to date with the records; only files that differ are written.

    Files that no build writes are left alone.

    Args:
        folder: of the leaderboard.

    Raises:
        InputError: if a record or the chain was changed, or jinja2 is not installed.
        OSError: if a file cannot be read or written.
    """
    leaderboard = store.load(folder)
    built = content(leaderboard)
    changed = []
    for name, text in built.items():
        path = folder / name
        if not path.is_file() or path.read_bytes() != text:
            files.write_atomically(path, lambda file, text=text: file.write(text))
            changed.append(name)
    for name in sorted(present(folder) - built.keys()):
        (folder / name).unlink()
        changed.append(name)
    return Built(len(leaderboard.records), len(built), tuple(changed))


def present(folder: Path) -> set[str]:
    """Relative paths of the built files that are there now."""
    return {name for name in layout.walk(folder)[0] if layout.BUILT.fullmatch(name)}


#: How many failures a page lists; the record has all.
MAX_FAILURES = 12


def _entry_pages(
    environment: jinja2.Environment,
    track: Track,
    versions: Sequence[int],
    measured: Sequence[HardwareRow] = (),
) -> dict[str, bytes]:
    """Return the pages of all entries of a track by their paths; see :func:`_version_page`."""
    template = environment.get_template("entry.html.j2")
    base = track.baseline
    other = None if base is None else plots.paths(base)
    stressed = stress_table.rows(track)
    made = {}
    for status, row in track.rows:
        path = pages.entry_path(track.version, track.name, row.record.name)
        if path in made:  # an older official record beside a newer unofficial one
            continue
        same = base is not None and row.record.sha256 == base.sha256
        values = _values(track, status, row, None if same else base)
        values["panels"] = _panels(row.record, None if same else other)
        values["hardware"] = [
            hardware_table.shown(own) for own in measured if own.record.name == row.record.name
        ]
        stress = stress_table.of_entry(stressed, row.record.name)
        values["stress"] = None if stress is None else stress_table.shown(stress)
        values["chart"] = [] if stress is None else stress_table.chart([stress])
        values["back"] = "../" * path.count("/") + pages.version_path(track.version, versions)
        values["root"] = "../" * path.count("/")
        made[path] = template.render(values).encode()
    return made


def _values(track: Track, status: str, row: Row, base: Record | None) -> dict[str, Any]:
    record, header = row.record, row.record.header
    worst, lung, pip = row.worst
    draws = plots.dumbbells(record, base)
    own = row.normalised
    gap = row.score.value - row.nominal if row.score else math.nan
    return {
        "record": record,
        "content": header,
        "manifest": record.manifest,
        "status": status,
        "reasons": row.entry.reasons,
        "track": track.name,
        "version": track.version,
        "rank": row.rank,
        "ranks": row.ranks,
        "count": len(track.ranked),
        "score": pages.interval(row.score),
        "normalised": pages.interval(own.score, 1) if own else None,
        "to_pid": pages.difference(own.to_baseline, 1)
        if own
        else pages.difference(row.to_baseline),
        "to_above": pages.difference(own.to_above, 1) if own else pages.difference(row.to_above),
        "scaled": plots.normalised_map(record),
        "above": _above(track, row),
        "baseline": BASELINES[track.name],
        "compared": base.name if base else None,
        "nominal": pages.figure(row.nominal),
        "gap": pages.signed(gap),
        "worst": pages.figure(worst),
        "worst_where": f"{lung} at PIP {pip:g}" if lung else "",
        "exploitation": pages.figure(record.exploitation),
        "clipped": pages.figure(100.0 * record.clipped_share, 1),
        "step": pages.figure(pages.step_time(header.timing), 0),
        "heat": plots.error_map(record),
        "limits": plots.ERROR_LIMITS,
        "differences": plots.difference_map(record, base) if base else None,
        "draws": draws,
        "dots": pages.trusted(draws.drawing) if draws else None,
        "safety": _safety(record),
        "failures": header.failures[:MAX_FAILURES],
        "frames": [pages.trusted(plots.frame(pip)) for pip in record.pips],
        "pips": [f"{pip:g}" for pip in record.pips],
        "lungs": [(name, *_setting(name)) for name in record.lungs],
        "breath": record.breath,
        "provenance": _provenance(header),
        "history": _history(row),
        "protocol": protocol,
        "box": f"0 0 {plots.WIDTH} {plots.HEIGHT}",
    }


def _panels(record: Record, other: list[list[tuple[str, str]]] | None) -> list[list[Any]]:
    """Traces of the entry and of the PID of each lung and PIP, ready for the page."""
    drawn = plots.panels(plots.paths(record), other)
    return [[pages.trusted(panel) for panel in row] for row in drawn]


def _above(track: Track, row: Row) -> str | None:
    place = next((i for i, ranked in enumerate(track.ranked) if ranked is row), 0)
    return track.ranked[place - 1].record.name if place else None


def _safety(record: Record) -> list[dict[str, Any]]:
    """A row a lung: highest pressure, longest time above the limit, whether the gate is passed."""
    highest, steps = record.peak.max(axis=(0, 2)), record.steps_above.max(axis=(0, 2))
    return [
        {
            "name": name,
            "peak": pages.figure(float(highest[i]), 1),
            "above": int(steps[i]),
            "safe": record.header.safe[i],
        }
        for i, name in enumerate(record.lungs)
    ]


def _setting(name: str) -> tuple[str, str]:
    lung = parse_lung(name)
    return f"{lung.R:g}", f"{lung.C:g}"


def _provenance(header: ScoreHeader) -> list[tuple[str, list[tuple[str, str]]]]:
    submission = header.submission
    groups = (
        ("Training, as the authors state it", submission.manifest.training),
        ("Where it came from", header.provenance),
        ("Files of the submission, SHA-256", submission.files),
        ("Simulators", header.simulators),
        ("Draws", header.draws.about()),
        ("Sandbox", header.sandbox or {"layers": "none: scored in the scorer's process"}),
        ("Machine", header.machine),
        ("Versions", header.versions),
        ("Timing", header.timing),
    )
    flat = [(title, pages.flatten(values)) for title, values in groups]
    return [(title, rows) for title, rows in flat if rows]


def _history(row: Row) -> list[dict[str, Any]]:
    """All records of the entry, newest first, and what became of each."""
    counts = row.record.sha256
    lines = []
    for event in row.entry.history:
        record = event.record
        state = "counts" if record.sha256 == counts else "superseded"
        if not event.official and state != "counts":
            state = "not official"
        if event.withdrawn is not None:
            state = "withdrawn"
        lines.append(
            {
                "sha256": record.sha256,
                "created": record.header.created,
                "official": event.official,
                "state": state,
                "reason": event.withdrawn or record.header.reason,
            }
        )
    return lines


#: Size of the small plot of an interval; the entry's dot never touches its edge.
WIDTH, MARGIN = 120, 6


def _version_page(
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
