"""Charts of a diagnosis: errors along each axis, the slot's shape, breaths to record next."""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.findings import BreathRequest, NonparametricTerm
from ventbench.diagnosis.residual_analysis import Profile, profiles
from ventbench.diagnosis.result import Diagnosis
from ventbench.views.diagnosis.breaths import command
from ventbench.views.diagnosis.chart import Chart, limits

#: Breaths of a request that are drawn.
SHOWN = 4


def by_axis(found: Diagnosis) -> list[Chart]:
    """Mean errors of the refitted and of the corrected simulator along each axis."""
    traces = found.traces
    inputs = (traces.breaths, traces.refit, traces.flow, traces.volume)
    refitted = profiles(*inputs)
    # Sorted by what the refitted one did, so that both are over the same samples.
    corrected = profiles(*inputs, simulated=traces.after)
    return [_axis(found, a, b) for a, b in zip(refitted, corrected, strict=True)]


def _axis(found: Diagnosis, refit: Profile, after: Profile) -> Chart:
    axis = refit.axis
    used = np.flatnonzero(refit.breaths > 0)
    edges = axis.edges[used[0] : used[-1] + 2] if used.size else axis.edges
    inside = slice(used[0], used[-1] + 1) if used.size else slice(None)
    mean, half, corrected = refit.mean[inside], refit.half[inside], after.mean[inside]
    half = np.where(np.isfinite(half), half, 0.0)
    y = limits(mean, corrected, [0.0], _near(mean - half, mean), _near(mean + half, mean))
    places = [place for place in found.location if place.axis == axis.name]
    unit = "" if axis.unit == "1" else f", {axis.unit}"
    where = "; ".join(f"{p.low:.6g} to {p.high:.6g}" for p in places) or "none"
    chart = Chart(
        (float(edges[0]), float(edges[-1])),
        y if y[1] - y[0] > 0.2 else limits(y, least=0.2, around=0.0),
        f"{axis.name}{unit}",
        "recorded - simulated, cmH2O",
        f"Mean error along {axis.name}{unit}; significant ranges: {where}.",
        width=330.0,
        height=190.0,
    )
    for place in places:
        # The first breath's number is 1, the axis begins at 0.
        chart.band(place.low - (axis.name == "breath number"), place.high)
    chart.boxes("refit", edges, mean - half, mean + half)
    chart.stairs("refit", edges, mean)
    if found.verdict != "nothing_missing":
        chart.stairs("after", edges, corrected)
    return chart


def _near(end: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Ends of intervals, without those so wide that they would hide all else."""
    reach = 2.0 * np.nanmax(np.abs(mean), initial=0.1)
    return np.clip(end, -reach, reach)


def slot(shape: NonparametricTerm) -> Chart:
    """The curve that a slot has taken."""
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


def request(wanted: BreathRequest) -> list[Chart]:
    """The first breaths to record next."""
    charts = []
    for k in range(min(len(wanted.u_in), SHOWN)):
        time = np.concatenate([[0.0], np.cumsum(wanted.dt[k][:-1])])
        chart = command(
            time, wanted.u_in[k], float(time[-1]), f"Commands of breath {k + 1} to record.", 130.0
        )
        for start, end in _open(time, wanted.u_out[k]):
            chart.band(start, end)
        charts.append(chart)
    return charts


def _open(time: np.ndarray, u_out: np.ndarray) -> list[tuple[float, float]]:
    """Times during which the expiratory valve is open."""
    is_open = np.concatenate([[False], u_out > 0.5, [False]])
    changes = np.flatnonzero(np.diff(is_open.astype(int)))
    ends = np.append(time, time[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in changes.reshape(-1, 2)]
