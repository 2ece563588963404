"""A scored run as a rerun recording: what is logged, how the viewer shows it, and the text beside.

One ``log_*`` function an idea. The blueprint shows all lungs at once first, then one lung in full a
tab.
"""

from __future__ import annotations

import tempfile
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

import ventbench
from ventbench import palette
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.text import escape_markdown
from ventbench.pages.panels import STEPS, distinct, labels, scored, shared_tracks
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.trajectories import Trajectories

APPLICATION = "ventbench"

#: Name of the timeline; its values are seconds since the start of the run.
TIMELINE = "run_time"

#: Entity of the text panel.
TEXT_ENTITY = "/about"


@dataclass(frozen=True)
class Plot:
    """Plot of one quantity."""

    quantity: str  #: last part of the entity path.
    title: str  #: title with the unit.
    range: tuple[float, float] | None  #: range of the axis; None to fit the data.
    share: float  #: share of a lung tab's height.


def recording(runs: Sequence[Trajectories]) -> bytes:
    """Return a whole ``.rrd`` file of matching runs, the one to look at first.

    Entities: ``/<lung>/{target,pressure,u_in,u_out,error,scored}`` of the first run, one value a
    PIP; ``/compare/<name>/<lung>/{pressure,u_in,u_out,error}`` of the others; ``/about``.

    Raises:
        InputError: if rerun is switched off by its environment variable.
    """
    names = viewer_names(runs)

    def log(stream: rr.RecordingStream) -> None:
        log_target(stream, runs[0])
        log_scored(stream, runs[0])
        log_run(stream, runs[0])
        for index in range(1, len(runs)):
            log_reference(stream, runs[index], names[index], index - 1)

    return written(names[0], blueprint(runs, names), markdown(runs, names), log)


def written(
    name: str, layout: rrb.Blueprint, text: str, log: Callable[[rr.RecordingStream], None]
) -> bytes:
    """Return an ``.rrd`` file of what a function logs, with a layout and a text beside.

    Raises:
        InputError: if rerun is switched off by its environment variable.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
    if not rr.is_enabled(stream):
        raise InputError("rerun is switched off by the environment variable RERUN; unset it")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "run.rrd")
        stream.save(file, default_blueprint=layout)
        stream.send_recording_name(name)
        stream.log(
            TEXT_ENTITY, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True
        )
        log(stream)
        stream.disconnect()  # writes the rest and the footer
        return file.read_bytes()


def displayable(text: str) -> str:
    """Text with characters of the viewer's font only: it ends itself over any other."""
    return "".join(c if " " <= c <= "~" or "\xa1" <= c <= "\u017e" else "?" for c in text)


def viewer_names(runs: Sequence[Trajectories]) -> list[str]:
    """Labels that the viewer's font can show."""
    return distinct([displayable(label) for label in labels(runs, cut="...")])


def log_target(stream: rr.RecordingStream, run: Trajectories) -> None:
    """Target pressure of every lung while a controller acts: a level line for each PIP.

    The falls to PEEP are left out: six of them from six pressures to one hide what is measured.
    """
    series = ["target, cmH2O"] * len(run.pips)
    phase = np.arange(STEPS) % protocol.BREATH_STEPS
    acting = phase < protocol.INSPIRATION_STEPS
    for lung, values in zip(run.lungs, run.target, strict=True):
        level = np.where(acting, values, np.nan)
        send(stream, f"/{lung}/target", run.time, level, series, [palette.TARGET], 1.0)


def log_scored(stream: rr.RecordingStream, run: Trajectories) -> None:
    """A bar along the bottom of every plot where the run is scored."""
    bar = np.where(scored(), 0.0, np.nan)[None]
    for lung in run.lungs:
        send(stream, f"/{lung}/scored", run.time, bar, ["scored part"], [palette.SCORED], 6.0)


def log_run(stream: rr.RecordingStream, run: Trajectories) -> None:
    """Pressure, valves and error of every lung, one line a PIP in that PIP's colour."""
    colors = [palette.PIPS[j % len(palette.PIPS)] for j in range(len(run.pips))]
    for quantity, unit, array in _quantities(run):
        series = [f"PIP {pip:g}, {unit}" for pip in run.pips]
        for lung, values in zip(run.lungs, array, strict=True):
            send(stream, f"/{lung}/{quantity}", run.time, values, series, colors, 2.0)


def log_reference(stream: rr.RecordingStream, run: Trajectories, name: str, index: int) -> None:
    """Pressure, valves and error of a run to compare with: thin, one colour, under its name."""
    colors = [palette.REFERENCES[index % len(palette.REFERENCES)]]
    for quantity, unit, array in _quantities(run):
        series = [f"{name}, {unit}"] * len(run.pips)
        for lung, values in zip(run.lungs, array, strict=True):
            entity = reference_path(name, lung, quantity)
            send(stream, entity, run.time, values, series, colors, 1.2)


def _quantities(run: Trajectories) -> tuple[tuple[str, str, Floats], ...]:
    return (
        ("pressure", "cmH2O", run.pressure),
        ("u_in", "%", run.u_in),
        ("u_out", "0/1", run.u_out),
        ("error", "cmH2O", run.pressure - run.target),
    )


def send(
    stream: rr.RecordingStream,
    entity: str,
    time: Floats,
    values: Floats,
    series: list[str],
    colors: list[str],
    width: float,
    timeline: str = TIMELINE,
) -> None:
    """Log lines: style once, values in bulk; ``values`` has shape ``(series, T)``."""
    n = len(series)
    look = rr.SeriesLines(
        colors=[palette.rgb(colors[i % len(colors)]) for i in range(n)],
        widths=[width] * n,
        names=series,
        # A valve holds its command until the next step.
        interpolation_mode="StepAfter" if entity.endswith(("/u_in", "/u_out")) else "Linear",
    )
    stream.log(entity, look, static=True)
    stream.send_columns(
        entity,
        indexes=[rr.TimeColumn(timeline, duration=time)],
        columns=rr.Scalars.columns(scalars=np.ascontiguousarray(values.T, dtype=float)),
    )


def _plots(runs: Sequence[Trajectories]) -> tuple[Plot, ...]:
    """Pressure, u_in and error, on axes that hold all runs.

    The expiratory valve is logged but not shown: no controller moves it. Its room goes to u_in,
    whose axis else has one mark.
    """
    arrays = [x for run in runs for x in (run.pressure, run.target)]
    highest = max(float(np.max(x, initial=0.0, where=np.isfinite(x))) for x in arrays)
    pressure = min(1.06 * highest, 2.0 * protocol.SAFETY_PRESSURE)
    u_in = 1.06 * protocol.U_MAX
    return (
        Plot("pressure", "airway pressure, cmH2O", (-0.05 * pressure, pressure), 4.0),
        Plot("u_in", "inspiratory valve u_in, %", (-0.06 * u_in, u_in), 3.6),
        Plot("error", "error = pressure - target, cmH2O", None, 2.2),
    )


def blueprint(runs: Sequence[Trajectories], names: Sequence[str]) -> rrb.Blueprint:
    """Return the one blueprint: tabs of pressure, u_in and error, then of the lungs."""
    lungs = runs[0].lungs
    columns = len({parse_lung(lung).C for lung in lungs})
    plots = _plots(runs)
    grids = [
        rrb.Grid(
            *(_view(lung, plot, _last_scored_breath(), legend=lung == lungs[-1]) for lung in lungs),
            grid_columns=columns,
            name=f"All lungs: {plot.quantity}",
        )
        for plot in plots
    ]
    details = [_lung_tab(lung, plots, names[1:]) for lung in lungs]
    tabs = rrb.Tabs(*grids, *details, active_tab=0, name="Run")
    return beside_text(tabs, "What you see", 3.6, TIMELINE)


def beside_text(tabs: rrb.Tabs, name: str, share: float, timeline: str) -> rrb.Blueprint:
    """Views with the text panel beside them, so many times as wide, and all else closed."""
    return rrb.Blueprint(
        rrb.Horizontal(
            tabs, rrb.TextDocumentView(origin=TEXT_ENTITY, name=name), column_shares=[share, 1]
        ),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def reference_path(name: str, lung: str, quantity: str) -> str:
    """Entity of a reference run's quantity; the name may hold any character."""
    return f"/compare/{rr.escape_entity_path_part(name)}/{lung}/{quantity}"


def _lung_tab(lung: str, plots: Sequence[Plot], references: Sequence[str]) -> rrb.Vertical:
    """One lung in full with the references: the whole run, all plots on one time axis."""
    linked = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    views = [_view(lung, plot, linked, references, plot is plots[0]) for plot in plots]
    return rrb.Vertical(*views, row_shares=[plot.share for plot in plots], name=lung)


def _view(
    lung: str, plot: Plot, time: rrb.TimeAxis, references: Sequence[str] = (), legend: bool = False
) -> rrb.TimeSeriesView:
    contents = [f"/{lung}/{plot.quantity}", f"/{lung}/scored"]
    if plot.quantity == "pressure":
        contents.append(f"/{lung}/target")
    contents += [reference_path(name, lung, plot.quantity) for name in references]
    # Where 0 is not the bottom, the bar is a thin zero line over the scored part.
    thin: dict[Any, Any] = {
        f"/{lung}/scored": rr.SeriesLines.from_fields(widths=[1.5]).visualizer()
    }
    return rrb.TimeSeriesView(
        origin=f"/{lung}",
        contents=contents,
        overrides=None if plot.range else thin,
        name=f"{lung}: {plot.title}",
        axis_x=time,
        axis_y=rrb.ScalarAxis(range=plot.range) if plot.range else None,
        # Errors are mostly negative, what else there is positive.
        plot_legend=rrb.PlotLegend(
            rrb.Corner2D.RightTop if plot.range else rrb.Corner2D.RightBottom, visible=legend
        ),
    )


def _last_scored_breath() -> rrb.TimeAxis:
    """One breath: over more time, small plots lose the labels of their time axes.

    It ends before the next full second, whose label would be cut at the edge.
    """
    breath = protocol.BREATH_STEPS * protocol.DT
    start = max(protocol.SCORED_BREATHS) * breath
    at = rr.TimeRangeBoundary.absolute
    return rrb.TimeAxis(
        view_range=rr.TimeRange(
            start=at(seconds=start - 0.15), end=at(seconds=start + breath - 0.1)
        )
    )


def markdown(runs: Sequence[Trajectories], names: Sequence[str]) -> str:
    """Say what is seen; names are escaped."""
    names = [escape_markdown(name) for name in names]
    last = max(protocol.SCORED_BREATHS) + 1
    compared = f"- **thin lines** in a lung's tab: {', '.join(names[1:])}\n" if names[1:] else ""
    return f"""# {names[0]}

{escape_markdown(shared_tracks(runs))}

- **one colour a PIP**, {min(runs[0].pips):g} to {max(runs[0].pips):g} cmH2O
- **thin grey**: target, while the controller acts
{compared}- **green bar** at the bottom: scored part

**All lungs**: breath {last}. **A lung's tab**: the whole run; the expiratory valve, `u_out`, is the
same for all. Time is in seconds since the run began. `ventbench view RUN --out report.html` has the
scores.

ventbench {ventbench.__version__}
"""
