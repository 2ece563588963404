"""A diagnosis as a matplotlib figure: held-out breaths, and errors before and after."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ventbench import palette
from ventbench.diagnosis import report_text
from ventbench.diagnosis.result import Diagnosis
from ventbench.pages.diagnosis.charts import stages, worst

#: Colours of the recording and of the three simulators, on white.
_COLORS = {
    "recorded": palette.INK,
    "before": palette.GREY,
    "refit": palette.RUNS[1],
    "after": palette.RUNS[0],
}

#: Breaths that are drawn at most.
_BREATHS = 3


def figure(diagnosis: Diagnosis) -> Figure:
    """Draw the held-out breaths with the largest errors, and the errors of all held-out breaths.

    Args:
        diagnosis: what to show.

    Returns:
        A figure without global state; a notebook shows it, ``savefig`` writes it.
    """
    shown = [(key, text) for key, text, _ in stages(diagnosis)]
    chosen = [index for index, _ in worst(diagnosis)[:_BREATHS]]
    plot = Figure(figsize=(4.2 * (len(chosen) + 1), 3.6), layout="constrained")
    axes = np.atleast_1d(plot.subplots(1, len(chosen) + 1))
    for axis, index in zip(axes, chosen, strict=False):
        _breath(axis, diagnosis, index, shown)
    if chosen:
        axes[0].set_ylabel("airway pressure, cmH2O")
        axes[0].legend(frameon=False, fontsize="small")
    _errors(axes[-1], diagnosis, shown)
    plot.suptitle(report_text.headline(diagnosis), fontsize="medium", wrap=True)
    return plot


def _breath(axis: Axes, diagnosis: Diagnosis, index: int, shown: list[tuple[str, str]]) -> None:
    traces = diagnosis.traces
    valid = traces.breaths.valid[index]
    time = traces.breaths.time[index][valid]
    recorded = traces.breaths.pressure[index][valid]
    axis.plot(time, recorded, color=_COLORS["recorded"], linewidth=2.0, label="recorded")
    for key, text in shown:
        pressure = getattr(traces, key)[index][valid]
        axis.plot(time, pressure, color=_COLORS[key], linewidth=1.2, label=text)
    lung = traces.breaths.lung_ids[index]
    axis.set_title(f"breath {traces.breaths.breath_id[index]}, {lung}", fontsize="small")
    axis.set_xlabel("time, s")


def _errors(axis: Axes, diagnosis: Diagnosis, shown: list[tuple[str, str]]) -> None:
    """Root-mean-square errors as bars, with the noise of the measurement as a line."""
    errors = diagnosis.open_loop
    for row, (key, _) in enumerate(shown):
        error = getattr(errors, key).rmse
        axis.barh(row, error, color=_COLORS[key])
        axis.annotate(f"{error:.2f}", (error, row), (4, 0), textcoords="offset points", va="center")
    if np.isfinite(errors.noise_floor):
        axis.axvline(errors.noise_floor, color="#5b636d", linestyle=":")
        axis.set_xlabel("RMS error, cmH2O (dotted: noise)")
    axis.set_yticks(range(len(shown)), [text for _, text in shown])
    axis.invert_yaxis()
    axis.margins(x=0.2)
    axis.set_title(f"{len(errors.held_out_breaths)} held-out breaths", fontsize="small")
