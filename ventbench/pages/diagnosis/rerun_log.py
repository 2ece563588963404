"""A diagnosis as a rerun recording: traces of every breath, and the answer in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ventbench import palette
from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.text import escape_markdown
from ventbench.diagnosis import number_text, report_text
from ventbench.diagnosis.result import Diagnosis
from ventbench.pages.diagnosis.charts import rmse, stages
from ventbench.pages.rerun_log import beside_text, displayable, send, written

#: Colours of the three simulators, and of the recording, on dark and light ground.
COLORS = {
    "before": palette.TARGET,
    "refit": palette.PIPS[5],
    "after": palette.PIPS[1],
    "recorded": palette.PIPS[2],
}

#: Name of the timeline; its values are seconds with a lung's breaths end to end.
TIMELINE = "recording_time"


def write(path: Path, diagnosis: Diagnosis) -> Path:
    """Write a recording with its blueprint, ``.rrd`` by custom, and return the path.

    Entities, for each lung: ``/<lung>/pressure/{recorded,before,refit,after}``,
    ``/<lung>/error/{before,refit,after}`` (recorded - simulated), ``/<lung>/u_in``,
    ``/<lung>/u_out``, ``/<lung>/held_out``, breaths end to end on the timeline; and ``/about``.

    Raises:
        InputError: if rerun is switched off by its environment variable.
        OSError: if the file cannot be written.
    """

    def log(stream: rr.RecordingStream) -> None:
        for lung, index in diagnosis.traces.breaths.by_lung_index.items():
            log_lung(stream, diagnosis, lung, index)

    name = f"diagnosis of {displayable(diagnosis.simulator)}"
    content = written(name, blueprint(diagnosis), markdown(diagnosis), log)
    files.write_atomically(path, lambda file: file.write(content))
    return path


def markdown(diagnosis: Diagnosis) -> str:
    """The text panel: the diagnosis in words, and a guide to the views."""
    verdict, *sentences = (
        escape_markdown(displayable(text)) for text in report_text.sentences(diagnosis)
    )
    places = [
        escape_markdown(number_text.error_region(place, diagnosis.noise[0]))
        for place in diagnosis.location[:5]
    ]
    lines = [f"## {verdict}", "", *(f"{text}\n" for text in sentences)]
    if places:
        lines += ["## Where the refitted simulator errs", "", *(f"- {text}" for text in places), ""]
    lines += [
        "## What you see",
        "",
        "- the first tab: the held-out breath on which the refitted simulator errs most",
        "- a lung's tab: all its breaths end to end; "
        "**green**: recorded, **grey**: simulator as given, **orange**: R and C refitted, "
        "**blue**: corrected; the bar at the bottom marks breaths that no fit has seen",
        "- error: recorded minus simulated, cmH2O",
    ]
    return "\n".join(lines) + "\n"


def log_lung(
    stream: rr.RecordingStream, diagnosis: Diagnosis, lung: str, index: np.ndarray
) -> None:
    """Traces of one lung's breaths, laid end to end."""
    traces = diagnosis.traces
    breaths = traces.breaths.select(index)
    start = np.arange(len(index))[:, None] * span(diagnosis)
    time = (start + breaths.time).ravel().astype(np.float64)
    order = breaths.valid.ravel()

    def line(part: str, values: Floats, name: str, color: str, width: float) -> None:
        entity, samples = f"/{lung}/{part}", np.ravel(values).astype(float)[None, order]
        send(stream, entity, time[order], samples, [name], [color], width, TIMELINE)

    line("pressure/recorded", breaths.pressure, "recorded", COLORS["recorded"], 3.0)
    for key, text in stages(diagnosis).items():
        simulated = getattr(traces, key)[index]
        line(f"pressure/{key}", simulated, text, COLORS[key], 1.5)
        line(f"error/{key}", breaths.pressure - simulated, text, COLORS[key], 1.5)
    line("u_in", breaths.u_in, "u_in, %", palette.PIPS[4], 1.5)
    line("u_out", np.asarray(breaths.u_out, float), "u_out, 1 open", palette.PIPS[0], 1.5)
    held = np.where(traces.held_out[index][:, None] & breaths.valid, 0.0, np.nan)
    line("held_out", held, "held out of every fit", palette.REFERENCES[0], 6.0)


def blueprint(diagnosis: Diagnosis) -> rrb.Blueprint:
    """Layout of the views."""
    lungs = diagnosis.traces.breaths.by_lung_index
    linked = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    tabs = rrb.Tabs(
        _lung(*_worst(diagnosis), "Worst held-out breath"),
        *(_lung(lung, linked, lung) for lung in lungs),
        active_tab=0,
        name="Diagnosis",
    )
    return beside_text(tabs, "In words", 2.6, TIMELINE)


def span(diagnosis: Diagnosis) -> float:
    """Time from one breath's start to the next one's, s: the longest breath and a gap."""
    breaths = diagnosis.traces.breaths
    return float(np.max(breaths.time, initial=0.0, where=breaths.valid)) + 0.1


def _lung(lung: str, time: rrb.TimeAxis, name: str) -> rrb.Vertical:
    """Traces of one lung on one time axis."""
    rows = (
        ("pressure", f"{lung}: airway pressure, cmH2O", 4.0),
        ("error", f"{lung}: error = recorded - simulated, cmH2O", 3.0),
        ("u_in", f"{lung}: inspiratory valve u_in, %", 2.0),
        ("u_out", f"{lung}: expiratory valve u_out, 1 open", 1.2),
    )
    views = []
    for part, title, _ in rows:
        contents = [f"/{lung}/{part}/**" if part in ("pressure", "error") else f"/{lung}/{part}"]
        if part == "pressure":
            contents.append(f"/{lung}/held_out")
        views.append(
            rrb.TimeSeriesView(
                origin=f"/{lung}",
                contents=contents,
                name=title,
                axis_x=time,
                axis_y=rrb.ScalarAxis(range=(-0.1, 1.1)) if part == "u_out" else None,
                plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=part == "pressure"),
            )
        )
    return rrb.Vertical(*views, row_shares=[share for *_, share in rows], name=name)


def _worst(diagnosis: Diagnosis) -> tuple[str, rrb.TimeAxis]:
    """Lung and times of the held-out breath on which the refitted simulator errs most."""
    traces = diagnosis.traces
    error = np.nan_to_num(rmse(traces, traces.refit), nan=-1.0)
    breath = int(np.argmax(np.where(traces.held_out, error, -1.0)))
    lung = str(traces.breaths.lung_ids[breath])
    start = span(diagnosis) * int(np.flatnonzero(traces.breaths.by_lung_index[lung] == breath)[0])
    end, edge = start + span(diagnosis), rr.TimeRangeBoundary.absolute
    time_range = rr.TimeRange(start=edge(seconds=start - 0.1), end=edge(seconds=end))
    return lung, rrb.TimeAxis(view_range=time_range)
