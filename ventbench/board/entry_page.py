"""The page of one entry: figures, heat maps, traces against the PID, how to reproduce it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ventbench import protocol
from ventbench.board import hardware_table, pages, plots, stress_table
from ventbench.board.hardware_table import HardwareRow
from ventbench.board.ranking import BASELINES, Row, Track
from ventbench.board.record import Record
from ventbench.board.schema import ScoreHeader
from ventbench.lungs import lung as parse_lung

if TYPE_CHECKING:
    import jinja2

#: How many failures a page lists; the record has all.
MAX_FAILURES = 12


def render_all(
    environment: jinja2.Environment,
    track: Track,
    versions: Sequence[int],
    measured: Sequence[HardwareRow] = (),
) -> dict[str, bytes]:
    """Return the pages of all entries of a track by their paths; see ``index_page.render``."""
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
