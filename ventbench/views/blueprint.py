"""How the rerun viewer shows a run: all lungs at once first, then one lung in full a tab."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ventbench import protocol
from ventbench.lungs import lung as parse_lung
from ventbench.trajectories import Trajectories

#: Name of the timeline; its values are seconds since the start of the run.
TIMELINE = "run_time"

#: Entity of the text panel.
ABOUT = "/about"


@dataclass(frozen=True)
class Plot:
    """One quantity as it is shown.

    Attributes:
        quantity: last part of the entity path.
        title: with the unit.
        range: of the axis; None to fit the data.
        share: of a lung tab's height.
    """

    quantity: str
    title: str
    range: tuple[float, float] | None
    share: float


def plots(runs: Sequence[Trajectories]) -> tuple[Plot, ...]:
    """Pressure, u_in, error and u_out, on axes that hold all runs."""
    highest = _top([x for run in runs for x in (run.pressure, run.target)])
    pressure = min(1.06 * highest, 2.0 * protocol.SAFETY_PRESSURE)
    u_in = max(10.0, min(1.06 * _top([run.u_in for run in runs]), 1.06 * protocol.U_MAX))
    return (
        Plot("pressure", "airway pressure, cmH2O", (-0.05 * pressure, pressure), 4.0),
        Plot("u_in", "inspiratory valve u_in, %", (-0.06 * u_in, u_in), 2.2),
        Plot("error", "error = pressure - target, cmH2O", None, 2.2),
        Plot("u_out", "expiratory valve u_out, 1 open", (-0.1, 1.1), 1.3),
    )


def blueprint(runs: Sequence[Trajectories], names: Sequence[str], tab: int = 0) -> rrb.Blueprint:
    """Return the one blueprint.

    Args:
        runs: matching runs, the one to look at first.
        names: of the runs.
        tab: the one to open at: pressure, u_in, error, then the lungs.
    """
    lungs = runs[0].lungs
    columns = len({parse_lung(item).C for item in lungs})
    *overview, u_out = plots(runs)
    grids = [
        rrb.Grid(
            *(_view(item, plot, _last_scored_breath(), legend=item == lungs[-1]) for item in lungs),
            grid_columns=columns,
            name=f"All lungs: {plot.quantity}",
        )
        for plot in overview
    ]
    details = [_lung(item, (*overview, u_out), names[1:]) for item in lungs]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*grids, *details, active_tab=tab, name="Run"),
            rrb.TextDocumentView(origin=ABOUT, name="What you see"),
            column_shares=[3.6, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def reference_path(name: str, lung: str, quantity: str) -> str:
    """Entity of a reference run's quantity; the name may hold any character."""
    return f"/compare/{rr.escape_entity_path_part(name)}/{lung}/{quantity}"


def _lung(lung: str, shown: Sequence[Plot], references: Sequence[str]) -> rrb.Vertical:
    """One lung in full with the references: the whole run, all plots on one time axis."""
    linked = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    views = [_view(lung, plot, linked, references, plot is shown[0]) for plot in shown]
    return rrb.Vertical(*views, row_shares=[plot.share for plot in shown], name=lung)


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
    """One breath: over more time, small plots lose the labels of their time axes."""
    breath = protocol.BREATH_STEPS * protocol.DT
    start = max(protocol.SCORED_BREATHS) * breath
    at = rr.TimeRangeBoundary.absolute
    return rrb.TimeAxis(
        view_range=rr.TimeRange(start=at(seconds=start - 0.15), end=at(seconds=start + breath))
    )


def _top(arrays: Sequence[np.ndarray]) -> float:
    """Highest finite value, 0 at least."""
    return max(float(np.max(array, initial=0.0, where=np.isfinite(array))) for array in arrays)
