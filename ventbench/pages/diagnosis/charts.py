"""Charts of a diagnosis for its template."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Floats, runs
from ventbench.diagnosis.findings import BreathRequest, NonparametricTerm, Traces
from ventbench.diagnosis.number_text import capital
from ventbench.diagnosis.residual_analysis import EDGE, Profile, profiles
from ventbench.diagnosis.result import Diagnosis
from ventbench.pages.charts import Chart, limits
from ventbench.physics.characteristics import Characteristic

#: The three simulators in the order of the legend, by key, which is the class of the line.
STAGES = {"before": "simulator as given", "refit": "R and C refitted", "after": "corrected"}


def stages(diagnosis: Diagnosis) -> dict[str, str]:
    """Those of :data:`STAGES` that a diagnosis has; not all where nothing is missing."""
    nothing = diagnosis.verdict == "nothing_missing"
    return {key: text for key, text in STAGES.items() if not (nothing and key == "after")}


#: Breaths that are shown of either kind.
WORST = 3

#: Left end of the logarithmic axis of the time since an edge, s.
_FIRST_EDGE_TIME = 0.01

#: Time that the magnified part of a breath shows before and after its largest error, s.
_BEFORE, _AFTER = 0.12, 0.28

#: Colour class of a characteristic without and with its mechanism.
_BASELINE, _ACTING = "refit", "after"

#: Breaths of a request that are drawn.
REQUESTED = 4


@dataclass(frozen=True, eq=False)
class BreathPanel:
    """One breath."""

    title: str  #: title, such as ``breath 17``.
    why: str  #: reason why the breath is shown.
    errors: dict[str, float]  #: root mean square over the inspiration by stage, cmH2O.
    pressure: Chart  #: chart of the pressure.
    magnified: Chart  #: the part of it where the refitted simulator errs most, magnified.
    error: Chart  #: chart of recorded minus simulated pressure.
    valve: Chart  #: chart of the command.


def rmse(traces: Traces, simulated: Floats) -> Floats:
    """Root mean square error of each breath's inspiration, cmH2O, ``(n,)``; NaN without any."""
    error = traces.breaths.pressure - simulated
    use = traces.breaths.inspiratory & np.isfinite(error)
    total = np.where(use, error**2, 0.0).sum(axis=1)
    count = use.sum(axis=1)
    return np.sqrt(np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0))


def worst(diagnosis: Diagnosis) -> list[tuple[int, str]]:
    """Held-out breaths with the largest errors of the refit, and of the correction."""
    traces = diagnosis.traces
    held = traces.held_out if traces.held_out.any() else np.ones(len(traces.held_out), bool)
    corrected = diagnosis.verdict != "nothing_missing"
    kinds = [(traces.refit, "worst before the correction" if corrected else "worst")]
    if corrected:
        kinds.append((traces.after, "worst after the correction"))
    chosen: dict[int, str] = {}
    for simulated, why in kinds:
        error = np.where(held, rmse(traces, simulated), -np.inf)
        order = np.argsort(-np.nan_to_num(error, nan=-np.inf), kind="stable")
        fresh = [i for i in order.tolist() if np.isfinite(error[i]) and i not in chosen]
        chosen |= dict.fromkeys(fresh[:WORST], why)
    return list(chosen.items())


def panels(diagnosis: Diagnosis) -> list[BreathPanel]:
    """Charts of the breaths of :func:`worst`."""
    traces = diagnosis.traces
    by_stage = {key: rmse(traces, getattr(traces, key)) for key in STAGES}
    several = len(traces.breaths.by_lung_index) > 1
    charts_of_breaths = []
    for i, why in worst(diagnosis):
        name = f"breath {traces.breaths.breath_id[i]}"
        if several:
            name += f", {traces.breaths.lung_ids[i]}"
        errors = {key: float(values[i]) for key, values in by_stage.items()}
        charts_of_breaths.append(_panel(traces, i, name, why, errors, [*stages(diagnosis)]))
    return charts_of_breaths


def _panel(
    traces: Traces, i: int, name: str, why: str, errors: dict[str, float], looks: list[str]
) -> BreathPanel:
    """Charts of one breath, with the lines of some stages."""
    breath = traces.breaths
    end = _end(traces, i)
    use = breath.valid[i] & (breath.time[i] <= end)
    time, recorded = breath.time[i][use], breath.pressure[i][use]
    simulated = {key: getattr(traces, key)[i][use] for key in looks}
    pressure = Chart(
        (0.0, end),
        limits(recorded, traces.refit[i][use], traces.after[i][use]),
        "",
        "cmH2O",
        f"Pressure of {name}: recorded, and simulated before, after refit and corrected.",
        height=140.0,
    )
    low, high = window(time, recorded, simulated["refit"])
    pressure.band(low, high)
    within = (time >= low - 1e-9) & (time <= high + 1e-9)
    pressures = [recorded[within], *(simulated[key][within] for key in looks if key != "before")]
    magnified = Chart(
        (low, high),
        limits(*pressures),
        "",
        "magnified, cmH2O",
        f"{capital(name)} from {low:.2f} to {high:.2f} s, magnified.",
        height=130.0,
    )
    for chart, part in ((pressure, slice(None)), (magnified, within)):
        chart.line("seen", time[part], recorded[part])
        for key in looks:
            chart.line(key, time[part], simulated[key][part])
    errors_of_stage = {key: recorded - values for key, values in simulated.items()}
    error = Chart(
        (0.0, end),
        limits(*(errors_of_stage[key] for key in looks if key != "before"), least=1.0),
        "",
        "recorded − simulated, cmH2O",
        f"Error of {name}, recorded minus simulated: as given, refitted and corrected.",
        height=110.0,
    )
    for key in looks:
        error.line(key, time, errors_of_stage[key])
    valve = command(time, breath.u_in[i][use], end, f"Commands of {name}.", 84.0)
    return BreathPanel(name, why, errors, pressure, magnified, error, valve)


def window(time: Floats, recorded: Floats, simulated: Floats) -> tuple[float, float]:
    """Ends of the part of a breath around its largest error, s, of samples ``(T,)``.

    A recorded pressure is NaN where it is unknown.
    """
    size = np.nan_to_num(np.abs(recorded - simulated), nan=0.0)
    # Two neighbours together: a single outlier is no place.
    both = size + 0.5 * (np.append(size[1:], 0.0) + np.append(0.0, size[:-1]))
    middle, end = float(time[int(np.argmax(both))]), float(time[-1])
    low = min(max(middle - _BEFORE, 0.0), max(end - _BEFORE - _AFTER, 0.0))
    return low, min(low + _BEFORE + _AFTER, end)


def _end(traces: Traces, i: int) -> float:
    """End of the drawn part, s: a little after the inspiration."""
    breath = traces.breaths
    last = np.max(breath.time[i], initial=0.0, where=breath.valid[i])
    inspired = np.max(breath.time[i], initial=0.0, where=breath.inspiratory[i])
    return float(max(min(last, inspired + 0.6), 0.1))


def command(time: Floats, u_in: Floats, end: float, alt: str, height: float) -> Chart:
    """The inspiratory valve over time; a command holds until the next sample."""
    top = max(10.0, float(np.max(u_in, initial=0.0)))
    chart = Chart((0.0, end), (-0.04 * top, 1.08 * top), "s", "u_in, %", alt, height=height)
    chart.held("u", time, u_in)
    return chart


def by_axis(diagnosis: Diagnosis) -> list[Chart]:
    """Mean errors of the refitted and of the corrected simulator along each axis."""
    traces = diagnosis.traces
    inputs = (traces.breaths, traces.refit, traces.flow, traces.volume)
    refitted = profiles(*inputs)
    # Sorted by what the refitted one did, so that both are over the same samples.
    corrected = profiles(*inputs, simulated=traces.after)
    return [_axis(diagnosis, a, b) for a, b in zip(refitted, corrected, strict=True)]


def _axis(diagnosis: Diagnosis, refit: Profile, after: Profile) -> Chart:
    axis = refit.axis
    used = np.flatnonzero(refit.breaths > 0)
    edges = axis.edges[used[0] : used[-1] + 2] if used.size else axis.edges
    inside = slice(used[0], used[-1] + 1) if used.size else slice(None)
    mean, half, corrected = refit.mean[inside], refit.half[inside], after.mean[inside]
    half = np.where(np.isfinite(half), half, 0.0)
    y = limits(mean, corrected, [0.0], _clipped(mean - half, mean), _clipped(mean + half, mean))
    places = [place for place in diagnosis.location if place.axis == axis.name]
    unit = "" if axis.unit == "1" else f", {axis.unit}"
    where = "; ".join(f"{p.low:.6g} to {p.high:.6g}" for p in places) or "none"
    chart = Chart(
        (float(edges[0]), float(edges[-1])),
        y if y[1] - y[0] > 0.2 else limits(y, least=0.2, around=0.0),
        f"{axis.name}{unit}",
        "recorded − simulated, cmH2O",
        f"Mean error along {axis.name}{unit}; significant ranges: {where}.",
        width=330.0,
        height=190.0,
    )
    if axis.name == EDGE:
        # Half of what matters happens in the first two samples after an edge.
        chart.log, chart.x = True, (_FIRST_EDGE_TIME, max(float(edges[-1]), 2 * _FIRST_EDGE_TIME))
    for place in places:
        # The first breath's number is 1, the axis begins at 0.
        chart.band(place.low - (axis.name == "breath number"), place.high)
    chart.boxes("refit", edges, mean - half, mean + half)
    chart.stairs("refit", edges, mean)
    if diagnosis.verdict != "nothing_missing":
        chart.stairs("after", edges, corrected)
    return chart


def _clipped(end: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Ends of intervals, cut where they are so wide that they would hide everything else."""
    reach = 2.0 * np.nanmax(np.abs(mean), initial=0.1)
    return np.clip(end, -reach, reach)


def characteristic_chart(name: str, curve: Characteristic) -> Chart:
    """What a mechanism does to its own quantity, without it and with it."""
    chart = Chart(
        (float(curve.x.min()), float(curve.x.max())),
        limits(curve.baseline, curve.acting),
        curve.x_label,
        curve.y_label,
        f"{curve.y_label} over {curve.x_label}, without and with {name}.",
        width=360.0,
        height=200.0,
    )
    chart.line(_BASELINE, curve.x, curve.baseline)
    chart.line(_ACTING, curve.x, curve.acting)
    return chart


def nonparametric_term(shape: NonparametricTerm) -> Chart:
    """The curve of a nonparametric term."""
    chart = Chart(
        (float(shape.x.min()), float(shape.x.max())),
        limits(shape.y, [0.0]),
        shape.x_unit,
        shape.y_unit,
        f"Shape of {shape.name}: {shape.y_unit} over {shape.x_unit}.",
        width=420.0,
        height=220.0,
    )
    chart.line("after", shape.x, shape.y)
    return chart


def request(breaths: BreathRequest) -> list[Chart]:
    """The first breaths to record next."""
    charts = []
    for k in range(min(len(breaths.u_in), REQUESTED)):
        time = np.concatenate([[0.0], np.cumsum(breaths.dt[k][:-1])])
        chart = command(
            time, breaths.u_in[k], float(time[-1]), f"Commands of breath {k + 1} to record.", 130.0
        )
        for start, end in _open(time, breaths.u_out[k]):
            chart.band(start, end)
        charts.append(chart)
    return charts


def _open(time: np.ndarray, u_out: np.ndarray) -> list[tuple[float, float]]:
    """Times during which the expiratory valve is open."""
    ends = np.append(time, time[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in runs(u_out > 0.5)]
