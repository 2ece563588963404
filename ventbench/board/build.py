"""CSV and pages: a pure function of the records, the same bytes at every build.

The page of the board holds both tracks as sortable tables, and who is not ranked. The page of an
entry holds figures, heat maps, each draw beside the PID's, traces against the PID, and how to
reproduce it.

Traces are 6 x 6 small multiples in whole numbers and short paths, since there are many. A panel is
the nominal inspiration of the last scored breath on one lung at one PIP: pressure above, u_in
below. Axes depend on the PIP alone, so that panels of all entries can be laid side by side. Lengths
are in units of the panel, y downwards.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench.base import files
from ventbench.base.text import number
from ventbench.board import canonical, frames, pages, ranking, store
from ventbench.board.frames import Line
from ventbench.board.ranking import BASELINES, Row, Track
from ventbench.board.record import Floats, Record
from ventbench.board.schema import ScoreHeader
from ventbench.board.store import Store
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung

if TYPE_CHECKING:
    import jinja2

#: How many failures a page lists; the record has all.
MAX_FAILURES = 12

#: Size of the small plot of an interval; the entry's dot never touches its edge.
INTERVAL_WIDTH, MARGIN = 120, 6

#: Columns of the page's tables.
SHOWN = [column for column in frames.COLUMNS if column.title]

#: Plot of the draws: left and width of its axis, height of a row.
PLOT_LEFT, PLOT_AXIS, PLOT_ROW = 40, 580, 14

#: Limits between the shades of maps, cmH2O and points of the normalised score: the same for all
#: entries, so that maps can be compared.
ERROR_LIMITS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)
NORMALISED_LIMITS = (5.0, 15.0, 30.0, 50.0, 75.0, 100.0, 150.0, 250.0)
DIFFERENCE_LIMITS = (0.02, 0.2, 0.7, 2.0)

#: Size of a panel, left of its plots, units from one step to the next.
WIDTH, HEIGHT = 690, 600
LEFT, STEP = 70, 18

#: Top and height of the two plots.
TOP, PRESSURE_HEIGHT = 14, 350
VALVE_TOP, VALVE_HEIGHT = 400, 140

RIGHT = LEFT + STEP * protocol.INSPIRATION_STEPS
VALVE_BOTTOM = VALVE_TOP + VALVE_HEIGHT


@dataclass(frozen=True)
class Built:
    """What a build did.

    Attributes:
        records: how many there are.
        files: how many pages there are, CSV included.
        changed: relative paths that were written or removed.
    """

    records: int
    files: int
    changed: tuple[str, ...]


def content(leaderboard: Store) -> dict[str, bytes]:
    """Return every built file by its path.

    Args:
        leaderboard: all of its records.

    Raises:
        InputError: if jinja2 is not installed.
    """
    tracks = ranking.board(leaderboard)
    environment = pages.environment()
    built = {
        canonical.CSV: frames.csv_text(tracks).encode(),
        canonical.INDEX: _index(environment, leaderboard, tracks).encode(),
    }
    for track in tracks:
        built.update(_entry_pages(environment, track))
    return built


def build(folder: Path, out: Path) -> Built:
    """Write the site of a leaderboard: pages, CSV, and the records that they link to.

    Only files that differ are written; pages of an earlier build that are no more are removed.

    Args:
        folder: of the leaderboard.
        out: folder of the site.

    Raises:
        InputError: if a record was changed, or jinja2 is not installed.
        OSError: if a file cannot be read or written.
    """
    leaderboard = store.load(folder)
    built = content(leaderboard)
    named = sorted(filter(canonical.named, canonical.walk(folder)[0]))
    changed = []
    for name, text in [*built.items(), *((name, (folder / name).read_bytes()) for name in named)]:
        path = out / name
        if not path.is_file() or path.read_bytes() != text:
            files.write_atomically(path, lambda file, text=text: file.write(text))
            changed.append(name)
    for name in sorted(filter(canonical.BUILT.fullmatch, canonical.walk(out)[0])):
        if name not in built:
            (out / name).unlink()
            changed.append(name)
    return Built(len(leaderboard.records), len(built), tuple(changed))


def _index(environment: jinja2.Environment, leaderboard: Store, tracks: tuple[Track, ...]) -> str:
    """Return the page of the board."""
    lines = frames.lines(tracks)
    header = lines[0].row.record.header if lines else None
    stressed = [row for track in tracks for row in track.stress]
    return environment.get_template("index.html.j2").render(
        tracks=[_track(track) for track in tracks],
        columns=SHOWN,
        aside=[_aside(line) for line in lines if line.status != "ranked"],
        simulators=pages.flatten(header.simulators) if header else [],
        draws=header.draws if header else None,
        stress=[pages.stress_shown(row) for row in stressed],
        chart=pages.stress_chart(stressed),
        records=len(leaderboard.records),
        hardware=[
            {**pages.hardware_shown(row), "track": track.name}
            for track in tracks
            for row in track.hardware
        ],
        protocol=protocol,
    )


def _track(track: Track) -> dict[str, Any]:
    scores = [row.normalised.score for row in track.ranked if row.normalised is not None]
    low = min((x.low for x in scores), default=1.0)
    high = max((x.high for x in scores), default=1.0)
    rows = []
    for row in track.ranked:
        own = pages.hardware_of(track.hardware, row.record.name)
        rows.append(
            {
                "cells": [column.cell(Line(track, "ranked", row)) for column in SHOWN],
                "path": pages.entry_path(track.name, row.record.name),
                "baseline": row.record.name == BASELINES[track.name],
                "plot": _plot(row, low, high),
                "hardware": None if own is None else pages.hardware_shown(own),
            }
        )
    return {"name": track.name, "title": track.name.capitalize(), "rows": rows}


def _aside(line: Line) -> dict[str, Any]:
    """A line of the list of entries that are not ranked."""
    return {
        "name": line.row.record.name,
        "track": line.track.name,
        "path": pages.entry_path(line.track.name, line.row.record.name),
        "score": pages.figure(line.row.error.value) if line.row.error else pages.NONE,
        "reasons": list(line.row.entry.reasons),
    }


def _plot(row: Row, low: float, high: float) -> dict[str, str] | None:
    """Positions of a score and its interval on an axis that all rows of a track share."""
    if row.normalised is None:
        return None
    score = row.normalised.score
    # A logarithm, so that one bad entry does not press all others together.
    span = math.log(high / low) if high > low > 0.0 else 0.0

    def x(value: float) -> float:
        share = math.log(max(value, low) / low) / span if span else 0.5
        return MARGIN + (INTERVAL_WIDTH - 2 * MARGIN) * share

    left, dot, right = (x(v) for v in (score.low, score.value, score.high))
    return {"x": f"{left:.1f}", "width": f"{max(right - left, 1.0):.1f}", "dot": f"{dot:.1f}"}


def _entry_pages(environment: jinja2.Environment, track: Track) -> dict[str, bytes]:
    """Return the pages of all entries of a track by their paths."""
    template = environment.get_template("entry.html.j2")
    base = track.baseline
    other = None if base is None else paths(base)
    made: dict[str, bytes] = {}
    for status, row in track.rows:
        name = row.record.name
        path = pages.entry_path(track.name, name)
        if path in made:  # an older official record beside a newer unofficial one
            continue
        same = base is not None and row.record.sha256 == base.sha256
        values = _values(Line(track, status, row), None if same else base)
        drawn = panels(paths(row.record), None if same else other)
        values["panels"] = [[pages.trusted(panel) for panel in lung] for lung in drawn]
        measured = (own for own in track.hardware if own.record.name == name)
        values["hardware"] = [pages.hardware_shown(own) for own in measured]
        stressed = [own for own in track.stress if own.name == name]
        values["stress"] = pages.stress_shown(stressed[0]) if stressed else None
        values["chart"] = pages.stress_chart(stressed)
        values["root"] = "../" * path.count("/")
        made[path] = template.render(values).encode()
    return made


def _values(line: Line, base: Record | None) -> dict[str, Any]:
    track, status, row = line
    record, header = row.record, row.record.header
    draws = dumbbells(record, base)
    cells = {column.names[0]: column.cell(line) for column in SHOWN}
    return {
        "record": record,
        "content": header,
        "manifest": record.manifest,
        "status": status,
        "reasons": row.entry.reasons,
        "track": track.name,
        "count": len(track.ranked),
        "cells": cells,
        "figures": [
            (column.title, cells[column.names[0]])
            for column in SHOWN
            if column.names[0] not in ("rank", "name", "normalised")
        ],
        "scaled": _map(record.headroom.normalised, record, NORMALISED_LIMITS, 0),
        "compared": base.name if base else None,
        "heat": _map(np.concatenate([record.nominal[None], record.drawn]), record, ERROR_LIMITS),
        "differences": _difference_map(record, base) if base else None,
        "draws": draws,
        "dots": pages.trusted(draws.drawing) if draws else None,
        "safety": _safety(record),
        "failures": header.failures[:MAX_FAILURES],
        "frames": [pages.trusted(frame(pip)) for pip in record.pips],
        "pips": [f"{pip:g}" for pip in record.pips],
        "lungs": [(name, *_setting(name)) for name in record.lungs],
        "breath": record.breath,
        "provenance": _provenance(header),
        "history": _history(row),
        "protocol": protocol,
        "box": f"0 0 {WIDTH} {HEIGHT}",
    }


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


@dataclass(frozen=True)
class Dumbbells:
    """The plot and what it says.

    Attributes:
        drawing: SVG elements, numbers only.
        height: of the drawing.
        low: text of the lower end of the axis.
        high: of the upper.
        better: on how many draws the entry is better.
        count: how many draws there are.
    """

    drawing: str
    height: int
    low: str
    high: str
    better: int
    count: int


def dumbbells(record: Record, pid: Record | None) -> Dumbbells | None:
    """Draw them; None where a draw failed or there is no PID to compare with."""
    if pid is None or not np.isfinite(record.by_draw).all():
        return None
    both = np.stack([record.by_draw, pid.by_draw])
    low, high = float(both.min()), float(both.max())
    places = PLOT_LEFT + PLOT_AXIS * (both - low) / max(high - low, 1e-9)
    rows = enumerate(places.T.round(1).tolist(), 1)
    return Dumbbells(
        drawing="".join(_row(draw, own, other) for draw, (own, other) in rows),
        height=PLOT_ROW * both.shape[1] + 30,
        low=number(low),
        high=number(high),
        better=int(np.sum(both[0] < both[1])),
        count=both.shape[1],
    )


def _row(draw: int, own: float, other: float) -> str:
    y = PLOT_ROW * draw - 3
    return (
        f'<text x="{PLOT_LEFT - 14}" y="{y + 4}">{draw}</text><path d="M{other} {y}H{own}"/>'
        f'<circle class="pid" cx="{other}" cy="{y}" r="3.5"/>'
        f'<circle class="own" cx="{own}" cy="{y}" r="4.5"/>'
    )


def _map(
    values: Floats, record: Record, limits: tuple[float, ...], digits: int = 2
) -> list[dict[str, Any]]:
    """Rows of a map of means over draws; the nominal value beside each.

    Args:
        values: nominal runs first, shape ``(1 + K, L, P)``.
        record: whose they are.
        limits: between the shades.
        digits: that are shown.
    """
    means = values[1:].mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [
                {
                    "text": number(value, digits),
                    "small": number(nominal, digits),
                    "shade": f"h{np.searchsorted(limits, value)}" if np.isfinite(value) else "hx",
                }
                for value, nominal in zip(means[i], values[0, i], strict=True)
            ],
            "mean": number(float(means[i].mean()), digits),
        }
        for i, lung in enumerate(record.lungs)
    ]


def _difference_map(record: Record, other: Record) -> list[dict[str, Any]]:
    """Rows of the map of differences to another record, mean over draws; below zero is better."""
    cells = record.drawn.mean(axis=0) - other.drawn.mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [
                {"text": pages.signed(value, 2), "shade": _difference_shade(value)}
                for value in cells[i]
            ],
            "mean": pages.signed(float(cells[i].mean()), 2),
        }
        for i, lung in enumerate(record.lungs)
    ]


def _difference_shade(value: float) -> str:
    if not np.isfinite(value):
        return "hx"
    level = int(np.searchsorted(DIFFERENCE_LIMITS, abs(value)))
    return f"{'b' if value < 0 else 'w'}{level}" if level else "h0"


def _limits(pip: float) -> tuple[float, float]:
    """Pressure axis of a PIP, cmH2O: a little below PEEP, and room for an overshoot of 60 %."""
    height = pip - protocol.PEEP
    return protocol.PEEP - 0.12 * height, pip + 0.6 * height


def _y(pressure: Floats | float, pip: float) -> Floats:
    low, high = _limits(pip)
    share = (high - np.asarray(pressure)) / (high - low)
    return TOP + PRESSURE_HEIGHT * np.clip(share, 0.0, 1.0)


@functools.cache
def frame(pip: float) -> str:
    """What all panels of a PIP share, as SVG: target, ticks, time axis."""
    end = LEFT + round(1.0 / protocol.DT * STEP)
    ticks = [(value, round(float(_y(value, pip)))) for value in (protocol.PEEP, pip)]
    rules = [VALVE_TOP, VALVE_BOTTOM, *(y for _, y in ticks)]
    lines = "".join(f"M{LEFT} {y}H{RIGHT}" for y in rules)
    times = (("0", LEFT), ("0.5", (LEFT + end) // 2), ("1 s", end))
    return "".join(
        [
            f'<path class="t" d="M{LEFT} {round(float(_y(pip, pip)))}H{RIGHT - STEP}"/>',
            f'<path class="rule" d="{lines}"/>',
            *(f'<text class="y" x="{LEFT - 10}" y="{y + 9}">{v:g}</text>' for v, y in ticks),
            *(f'<text class="x" x="{x}" y="{HEIGHT - 18}">{text}</text>' for text, x in times),
        ]
    )


def panels(
    own: list[list[tuple[str, str]]], pid: list[list[tuple[str, str]]] | None
) -> list[list[str]]:
    """What is drawn in each panel, as SVG of numbers only; a template would take ten times as long.

    Args:
        own: paths of the entry, from :func:`paths`.
        pid: paths of the PID; None to draw none.
    """
    return [
        [
            (
                f'<path class="p pid" d="{pid[i][j][0]}"/><path class="u pid" d="{pid[i][j][1]}"/>'
                if pid
                else ""
            )
            + f'<path class="p own" d="{pressure}"/><path class="u own" d="{valve}"/>'
            for j, (pressure, valve) in enumerate(row)
        ]
        for i, row in enumerate(own)
    ]


def paths(record: Record) -> list[list[tuple[str, str]]]:
    """Paths of pressure and command of each lung and PIP."""
    valves = np.rint(VALVE_BOTTOM - VALVE_HEIGHT * record.u_in / protocol.U_MAX).astype(int)
    columns = []
    for j, pip in enumerate(record.pips):
        heights = np.rint(_y(record.pressure[:, j], pip)).astype(int)
        moves = np.diff(heights, axis=-1)
        rows = zip(heights[:, 0].tolist(), moves.tolist(), valves[:, j].tolist(), strict=True)
        columns.append([(_line(first, rest), _stairs(valve)) for first, rest, valve in rows])
    return [list(row) for row in zip(*columns, strict=True)]


def _line(first: int, moves: list[int]) -> str:
    """Path through points one step apart, relative to each other."""
    return f"m{LEFT} {first}" + "".join([f" {STEP} {move}" for move in moves])


def _stairs(heights: list[int]) -> str:
    """A command holds until the next step; equal ones are joined."""
    parts, before, run = [f"M{LEFT} {heights[0]}"], heights[0], 0
    for height in heights:
        if height != before:
            parts.append(f"h{run}V{height}")
            before, run = height, 0
        run += STEP
    return "".join([*parts, f"h{run}"])
