"""CSV and pages: a pure function of the records, the same bytes at every build.

The page of the board holds both tracks of the newest round as sortable tables, who is not ranked,
and practice; each round has such a page of its own. The page of an entry holds figures, heat maps,
each draw beside the PID's, traces against the PID, and how to reproduce it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.text import flatten
from ventbench.board import canonical, frames, pages, ranking, replay
from ventbench.board.figures import Figures
from ventbench.board.frames import Column
from ventbench.board.ranking import BASELINES, Row, Track
from ventbench.board.replay import TRACE_BREATH, Load
from ventbench.board.rounds import Round
from ventbench.board.schema import ScoreContent
from ventbench.board.store import Store
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS

if TYPE_CHECKING:
    import jinja2

#: How many failures a page lists; the record has all.
MAX_FAILURES = 12

#: Columns of the page's tables.
PAGE_COLUMNS = [column for column in frames.COLUMNS if column.title]


@dataclass(frozen=True)
class Built:
    """What a build did: numbers of records and of files, and paths that were written or removed."""

    records: int
    files: int
    changed: tuple[str, ...]


def content(leaderboard: Store) -> dict[str, bytes]:
    """Return every built file by its path; InputError if jinja2 is not installed."""
    tracks = ranking.board(leaderboard)
    environment = pages.environment()
    built = {
        canonical.CSV: frames.csv_text(tracks).encode(),
        canonical.INDEX: _index(environment, leaderboard, ranking.newest(tracks), "").encode(),
    }
    for round_ in leaderboard.rounds:
        of_round = [track for track in tracks if track.draws == round_.name]
        page = _index(environment, leaderboard, of_round, "../", round_)
        built[f"{canonical.ROUNDS}/{round_.name}.html"] = page.encode()
    for track in tracks:
        built.update(_entry_pages(environment, track, leaderboard))
    return built


def inputs(folder: Path) -> dict[str, bytes]:
    """Return what a site holds of a leaderboard besides what is built, by path."""
    names = sorted(filter(canonical.named, canonical.walk(folder)[0]))
    return {name: (folder / name).read_bytes() for name in names}


def build(folder: Path, out: Path, simulators: Load | None = None) -> Built:
    """Write the site of a leaderboard into a folder: pages, CSV, and the records that they link to.

    The frozen simulators replay the records, unless others are given. Only files that differ are
    written; pages of an earlier build that are no more are removed.

    Raises:
        InputError: if a record was changed, or jinja2 is not installed.
        OSError: if a file cannot be read or written.
    """
    pages.environment()  # what it needs is missed before the replay, which may take minutes
    leaderboard = replay.load(folder, simulators)
    built = content(leaderboard)
    changed = []
    for name, text in (built | inputs(folder)).items():
        path = out / name
        if not path.is_file() or path.read_bytes() != text:
            files.write_bytes(path, text)
            changed.append(name)
    for name in sorted(filter(canonical.BUILT.fullmatch, canonical.walk(out)[0])):
        if name not in built:
            (out / name).unlink()
            changed.append(name)
    return Built(len(leaderboard.records), len(built), tuple(changed))


def _index(
    environment: jinja2.Environment,
    leaderboard: Store,
    tracks: Sequence[Track],
    root: str,
    round_: Round | None = None,
) -> str:
    """Return the page of the board, or that of a round; ``root`` leads to the page of the board."""
    entries = frames.entries(tracks)
    columns = _telling(entries)
    first = entries[0].record if entries else None
    page_round = round_ or next((track.round for track in tracks if track.round), None)
    # Under missing physics, practice is shown only where nothing is ranked.
    of_first = [track for track in tracks if track.draws == tracks[0].draws] if tracks else []
    stressed = [row for track in of_first for row in track.stress]
    return environment.get_template("index.html.j2").render(
        tracks=[(track, _rows(track, columns)) for track in tracks],
        columns=columns,
        titles=[column.title for column in columns],
        first=first,
        measured=any(track.hardware for track in tracks),
        aside=[row for row in entries if not row.listed],
        simulators=flatten(first.header.simulators) if first else [],
        stress=[pages.stress_context(row) for row in stressed],
        chart=pages.stress_chart(stressed),
        records=len(leaderboard.records),
        hardware=[row for track in tracks for row in track.hardware],
        protocol=protocol,
        round=page_round,
        rounds=leaderboard.rounds,
        root=root,
    )


def _telling(entries: Sequence[Row]) -> list[Column]:
    """Columns of the page that do not say the same of every entry that is shown in its tables."""
    listed = [row for row in entries if row.listed]
    return [
        column
        for column in PAGE_COLUMNS
        if len(listed) < 2
        or (cells := [column.cell(row) for row in listed]).count(cells[0]) < len(cells)
    ]


def _rows(track: Track, columns: Sequence[Column]) -> list[dict[str, Any]]:
    """Rows of the table of a track."""
    return [
        {
            "cells": [column.cell(row) for column in columns],
            "record": row.record,
            "baseline": row.record.name == BASELINES[track.name],
            "hardware": pages.hardware_of(track.hardware, row.record.name),
        }
        for row in track.listed
    ]


def _entry_pages(
    environment: jinja2.Environment, track: Track, leaderboard: Store
) -> dict[str, bytes]:
    """Return the pages of all entries of a track by their paths."""
    template = environment.get_template("entry.html.j2")
    base = ranking.baseline(track.listed)
    baseline_paths = None if base is None else pages.paths(base.record)
    rendered: dict[str, bytes] = {}
    for row in track.rows:
        path = pages.address(row.record)
        compared = None if row is base else base
        values = _values(row, leaderboard)
        values["compared"] = compared and compared.record.name
        values["count"] = len(track.listed)
        panels = pages.panels(pages.paths(row.record), compared and baseline_paths)
        values["panels"] = [[pages.trusted(panel) for panel in lung] for lung in panels]
        values["hardware"] = [x for x in track.hardware if x.record.name == row.record.name]
        stressed = [row] if row in track.stress else []
        values["stress"] = pages.stress_context(stressed[0]) if stressed else None
        values["worst"] = pages.stress_order(stressed[0]) if stressed else []
        values["chart"] = pages.stress_chart(stressed)
        values["root"] = "../" * path.count("/")
        rendered[path] = template.render(values).encode()
    return rendered


def _values(row: Row, leaderboard: Store) -> dict[str, Any]:
    record, header, figures = row.record, row.record.header, row.record.figures
    cells = {column.names[0]: column.cell(row) for column in PAGE_COLUMNS}
    return {
        "record": record,
        "status": row.status,
        "reasons": row.reasons,
        "counted": int(figures.ranked.sum()),
        "runs": figures.error.size,
        "cells": cells,
        "figures": [
            (column.title, cells[column.names[0]])
            for column in PAGE_COLUMNS
            if column.names[0] not in ("rank", "name", "normalised")
        ],
        "scaled": pages.heat_map(_ranking(figures, figures.normalised), pages.NORMALISED_LIMITS, 0),
        "heat": pages.heat_map(_ranking(figures, figures.error), pages.ERROR_LIMITS),
        "failures": header.failures[:MAX_FAILURES],
        "frames": [pages.trusted(pages.frame(pip)) for pip in protocol.PIPS],
        "pips": [f"{pip:g}" for pip in protocol.PIPS],
        "lungs": [(x.id, f"{x.R:g}", f"{x.C:g}") for x in LUNGS],
        "breath": TRACE_BREATH + 1,
        "provenance": _provenance(header),
        "history": row.history,
        "withdrawn": leaderboard.withdrawn,
        "protocol": protocol,
        "box": f"0 0 {pages.WIDTH} {pages.HEIGHT}",
    }


def _ranking(figures: Figures, values: Floats) -> Floats:
    """Nominal runs and the draws that rank, of a table of runs."""
    return values[[True, *figures.ranked]]


def _provenance(header: ScoreContent) -> list[tuple[str, list[tuple[str, str]]]]:
    submission = header.submission
    groups = (
        ("Training, as the authors state it", submission.manifest.training),
        ("Where it came from", header.provenance),
        ("Files of the submission, SHA-256", submission.files),
        ("Simulators", header.simulators),
        ("Draws", header.draws.to_json()),
        ("Sandbox", header.sandbox or {"layers": "none: scored in the scorer's process"}),
        ("Machine", header.machine),
        ("Versions", header.versions),
        ("Timing", header.timing),
    )
    flat = [(title, flatten(values)) for title, values in groups]
    return [(title, rows) for title, rows in flat if rows]
