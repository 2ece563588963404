"""A diagnosis as a rerun recording: traces of every breath, errors by breath, maps of the error."""

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
from ventbench.pages.rerun_log import beside_text, known, send, written

#: Colours of the three simulators, and of the recording, on dark and light ground.
COLORS = {
    "before": palette.TARGET,
    "refit": palette.PIPS[5],
    "after": palette.PIPS[1],
    "recorded": palette.PIPS[2],
}

#: Pixels of a map for each sample and breath.
_ZOOM = 6

#: Name of the timeline; its values are seconds with a lung's breaths end to end.
TIMELINE = "recording_time"


def write(path: Path, diagnosis: Diagnosis) -> Path:
    """Write a recording with its blueprint, ``.rrd`` by custom, and return the path.

    Entities, for each lung: ``/<lung>/pressure/{recorded,before,refit,after}``,
    ``/<lung>/error/{before,refit,after}`` (recorded - simulated), ``/<lung>/u_in``,
    ``/<lung>/u_out``, ``/<lung>/held_out``, breaths end to end on the timeline;
    ``/by_breath/{before,refit,after}``, ``/map/{refit,after}`` and ``/about``.

    Raises:
        InputError: if rerun is switched off by its environment variable.
        OSError: if the file cannot be written.
    """

    def log(stream: rr.RecordingStream) -> None:
        for lung, index in diagnosis.traces.breaths.by_lung_index.items():
            log_lung(stream, diagnosis, lung, index)
        log_by_breath(stream, diagnosis)
        log_maps(stream, diagnosis)

    name = f"diagnosis of {known(diagnosis.simulator)}"
    content = written(name, blueprint(diagnosis), markdown(diagnosis), log)
    files.write_atomically(path, lambda file: file.write(content))
    return path


def markdown(diagnosis: Diagnosis) -> str:
    """The text panel: the diagnosis in words, and a guide to the views."""
    verdict, *others = (escape_markdown(known(text)) for text in report_text.sentences(diagnosis))
    places = [
        escape_markdown(number_text.error_region(place, diagnosis.noise[0]))
        for place in diagnosis.location[:5]
    ]
    lines = [f"## {verdict}", "", *(f"{text}\n" for text in others)]
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
        "- Errors by breath: root mean square of each breath's inspiration, cmH2O; each "
        "simulator on its own scale",
        "- Maps: one row a breath, time to the right; red: simulated too low, blue: too high",
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
        entity, shown = f"/{lung}/{part}", np.ravel(values).astype(float)[None, order]
        send(stream, entity, time[order], shown, [name], [color], width, TIMELINE)

    line("pressure/recorded", breaths.pressure, "recorded", COLORS["recorded"], 3.0)
    for key, text, _ in stages(diagnosis):
        simulated = getattr(traces, key)[index]
        line(f"pressure/{key}", simulated, text, COLORS[key], 1.5)
        line(f"error/{key}", breaths.pressure - simulated, text, COLORS[key], 1.5)
    line("u_in", breaths.u_in, "u_in, %", palette.PIPS[4], 1.5)
    line("u_out", np.asarray(breaths.u_out, float), "u_out, 1 open", palette.PIPS[0], 1.5)
    held = np.where(traces.held_out[index][:, None] & breaths.valid, 0.0, np.nan)
    line("held_out", held, "held out of every fit", palette.REFERENCES[0], 6.0)


def log_by_breath(stream: rr.RecordingStream, diagnosis: Diagnosis) -> None:
    """Root mean square errors of every breath, in the order of the recording."""
    number = np.arange(1, len(diagnosis.traces.breaths) + 1)
    for key, _, _ in stages(diagnosis):
        values = np.nan_to_num(rmse(diagnosis.traces, getattr(diagnosis.traces, key)))
        bars = rr.BarChart(values, color=palette.rgb(COLORS[key]), abscissa=number)
        stream.log(f"/by_breath/{key}", bars, static=True)


def log_maps(stream: rr.RecordingStream, diagnosis: Diagnosis) -> None:
    """Errors of all breaths as pictures on one scale of colours, the first breath on top."""
    traces = diagnosis.traces
    errors = {
        key: traces.breaths.pressure - getattr(traces, key) for key, _, _ in stages(diagnosis)
    }
    errors.pop("before")
    refit = np.abs(errors["refit"][np.isfinite(errors["refit"])])
    top = max(3.0 * diagnosis.noise[0], float(np.quantile(refit, 0.98)) if refit.size else 0.0, 0.1)
    for key, error in errors.items():
        picture = np.repeat(np.repeat(diverging(error / top), _ZOOM, axis=0), _ZOOM, axis=1)
        stream.log(f"/map/{key}", rr.Image(picture), static=True)


def diverging(share: Floats) -> np.ndarray:
    """Blue below zero, white at zero, red above; grey where unknown, uint8 ``(..., 3)``."""
    known = np.clip(np.nan_to_num(share), -1.0, 1.0)[..., None]
    red, blue = np.array(palette.rgb("#c4370a")), np.array(palette.rgb("#0065b3"))
    end = np.where(known > 0, red, blue)
    color = 255.0 + np.abs(known) * (end - 255.0)
    return np.where(np.isfinite(share)[..., None], color, 128.0).round().astype(np.uint8)


def blueprint(diagnosis: Diagnosis) -> rrb.Blueprint:
    """Layout of the views."""
    lungs = diagnosis.traces.breaths.by_lung_index
    keys = ["before", "refit", "after"][: 2 if diagnosis.verdict == "nothing_missing" else 3]
    names = {"before": "as given", "refit": "R and C refitted", "after": "corrected"}
    bars = [
        rrb.BarChartView(origin=f"/by_breath/{key}", name=f"RMSE by breath, {names[key]}, cmH2O")
        for key in keys
    ]
    maps = [
        rrb.Spatial2DView(origin=f"/map/{key}", name=f"Error over time and breath, {names[key]}")
        for key in keys[1:]
    ]
    linked = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    tabs = rrb.Tabs(
        _lung(*_worst(diagnosis), "Worst held-out breath"),
        *(_lung(lung, linked, lung) for lung in lungs),
        rrb.Vertical(*bars, name="Errors by breath"),
        rrb.Horizontal(*maps, name="Maps of the error"),
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
    shown = rr.TimeRange(start=edge(seconds=start - 0.1), end=edge(seconds=end))
    return lung, rrb.TimeAxis(view_range=shown)
