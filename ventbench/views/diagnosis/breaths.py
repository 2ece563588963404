"""Pictures of single breaths: recorded, as given, refitted, corrected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.diagnosis.findings import Traces
from ventbench.diagnosis.result import Diagnosis
from ventbench.views.diagnosis.chart import Chart, limits
from ventbench.views.runs import Floats

#: The three simulators in the order of the legend: key, text, class of the line.
STAGES = (
    ("before", "simulator as given", "before"),
    ("refit", "R and C refitted", "refit"),
    ("after", "corrected", "after"),
)

#: Breaths that are shown of either kind.
SHOWN = 3


@dataclass(frozen=True, eq=False)
class Panel:
    """One breath.

    Attributes:
        title: such as ``breath 17``.
        why: it is shown.
        errors: root mean square over the inspiration by stage, cmH2O.
        pressure: its chart.
        valve: chart of the command.
    """

    title: str
    why: str
    errors: dict[str, float]
    pressure: Chart
    valve: Chart


def rmse(traces: Traces, simulated: Floats) -> Floats:
    """Root mean square error of each breath's inspiration, cmH2O, ``(n,)``; NaN without any."""
    error = traces.breaths.pressure - simulated
    use = traces.breaths.inspiratory & np.isfinite(error)
    total = np.where(use, error**2, 0.0).sum(axis=1)
    count = use.sum(axis=1)
    return np.sqrt(np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0))


def worst(found: Diagnosis) -> list[tuple[int, str]]:
    """Held-out breaths to look at: where the refit errs most, and where the correction does."""
    traces = found.traces
    held = traces.held_out if traces.held_out.any() else np.ones(len(traces.held_out), bool)
    corrected = found.verdict != "nothing_missing"
    kinds = [(traces.refit, "worst before the correction" if corrected else "worst")]
    if corrected:
        kinds.append((traces.after, "worst after the correction"))
    chosen: dict[int, str] = {}
    for simulated, why in kinds:
        error = np.where(held, rmse(traces, simulated), -np.inf)
        order = np.argsort(-np.nan_to_num(error, nan=-np.inf), kind="stable")
        fresh = [i for i in order.tolist() if np.isfinite(error[i]) and i not in chosen]
        chosen |= dict.fromkeys(fresh[:SHOWN], why)
    return list(chosen.items())


def panels(found: Diagnosis) -> list[Panel]:
    """Pictures of :func:`worst`."""
    traces = found.traces
    by_stage = {key: rmse(traces, getattr(traces, key)) for key, _, _ in STAGES}
    several = len(traces.breaths.by_lung_index) > 1
    shown = []
    for i, why in worst(found):
        name = f"breath {traces.breaths.breath_id[i]}"
        if several:
            name += f", {traces.breaths.lung_ids[i]}"
        errors = {key: float(values[i]) for key, values in by_stage.items()}
        pressure = _pressure(traces, i, name, found.verdict != "nothing_missing")
        shown.append(Panel(name, why, errors, pressure, _valve(traces, i, name)))
    return shown


def _end(traces: Traces, i: int) -> float:
    """Until a little after the inspiration, s; the rest is much the same."""
    breath = traces.breaths
    last = np.max(breath.time[i], initial=0.0, where=breath.valid[i])
    inspired = np.max(breath.time[i], initial=0.0, where=breath.inspiratory[i])
    return float(max(min(last, inspired + 0.6), 0.1))


def _pressure(traces: Traces, i: int, name: str, corrected: bool) -> Chart:
    breath = traces.breaths
    use = breath.valid[i] & (breath.time[i] <= _end(traces, i))
    time, recorded = breath.time[i][use], breath.pressure[i][use]
    near = limits(recorded, traces.refit[i][use], traces.after[i][use])
    chart = Chart(
        (0.0, _end(traces, i)),
        near,
        "",
        "cmH2O",
        f"Pressure of {name}: recorded, and simulated before, after refit and corrected.",
        height=140.0,
    )
    chart.line("seen", time, recorded)
    for key, _, look in STAGES:
        if look != "after" or corrected:
            chart.line(look, time, getattr(traces, key)[i][use])
    return chart


def _valve(traces: Traces, i: int, name: str) -> Chart:
    breath = traces.breaths
    use = breath.valid[i] & (breath.time[i] <= _end(traces, i))
    return command(
        breath.time[i][use], breath.u_in[i][use], _end(traces, i), f"Commands of {name}.", 84.0
    )


def command(time: Floats, u_in: Floats, end: float, alt: str, height: float) -> Chart:
    """The inspiratory valve over time; a command holds until the next sample."""
    top = max(10.0, float(np.max(u_in, initial=0.0)))
    chart = Chart((0.0, end), (-0.04 * top, 1.08 * top), "s", "u_in, %", alt, height=height)
    chart.line("u", np.repeat(time, 2)[1:], np.repeat(u_in, 2)[:-1])
    return chart
