"""How the rerun viewer shows a diagnosis: worst breath, all of each lung, by breath, maps."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ventbench.diagnosis.result import Diagnosis
from ventbench.views.diagnosis.breaths import rmse

#: Name of the timeline; its values are seconds with a lung's breaths end to end.
TIMELINE = "recording_time"

#: Entity of the text panel.
ABOUT = "/about"


def blueprint(found: Diagnosis) -> rrb.Blueprint:
    """Return the one blueprint."""
    lungs = found.traces.breaths.by_lung_index
    keys = ["before", "refit", "after"][: 2 if found.verdict == "nothing_missing" else 3]
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
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(
                _lung(*_worst(found), "Worst held-out breath"),
                *(_lung(lung, linked, lung) for lung in lungs),
                rrb.Vertical(*bars, name="Errors by breath"),
                rrb.Horizontal(*maps, name="Maps of the error"),
                active_tab=0,
                name="Diagnosis",
            ),
            rrb.TextDocumentView(origin=ABOUT, name="In words"),
            column_shares=[2.6, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def span(found: Diagnosis) -> float:
    """Time from one breath's start to the next one's, s: the longest breath and a gap."""
    breaths = found.traces.breaths
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


def _worst(found: Diagnosis) -> tuple[str, rrb.TimeAxis]:
    """Lung and times of the held-out breath on which the refitted simulator errs most."""
    traces = found.traces
    error = np.nan_to_num(rmse(traces, traces.refit), nan=-1.0)
    breath = int(np.argmax(np.where(traces.held_out, error, -1.0)))
    lung = str(traces.breaths.lung_ids[breath])
    start = span(found) * int(np.flatnonzero(traces.breaths.by_lung_index[lung] == breath)[0])
    end, edge = start + span(found), rr.TimeRangeBoundary.absolute
    shown = rr.TimeRange(start=edge(seconds=start - 0.1), end=edge(seconds=end))
    return lung, rrb.TimeAxis(view_range=shown)
