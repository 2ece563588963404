"""The picture of the study: score against breaths of experience, and against time."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ventbench.training.study import LearningCurve, SampleStudy, band
from ventbench.views.graphics import RUN_COLORS

#: What the curves are called in the picture.
LABELS = {
    "policy-gradient": "policy gradient through the simulator",
    "policy-gradient-short": "the same, learning rate for 96 breaths",
    "ppo": "PPO",
    "dqn": "DQN",
}

_COLORS = dict(
    zip(LABELS, (RUN_COLORS[0], RUN_COLORS[4], RUN_COLORS[2], RUN_COLORS[3]), strict=True)
)


def png(study: SampleStudy) -> bytes:
    """Return the picture as PNG: interquartile means and their 95 % bands."""
    figure = Figure(figsize=(11.0, 4.6), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    _panel(left, study, lambda curve: curve.episodes)
    _panel(right, study, lambda curve: curve.seconds)
    left.set_xlabel("breaths of experience of one training")
    right.set_xlabel("seconds, all seeds together, without compiling")
    left.set_ylabel("score without noise, cmH2O")
    lines, names = left.get_legend_handles_labels()
    order = [names.index(name) for name in LABELS.values() if name in names]
    shown = [lines[i] for i in order], [names[i] for i in order]
    right.legend(*shown, loc="upper right", frameon=False, fontsize=9)
    seeds = len(study.curves[0].scores)
    figure.suptitle(f"{study.lung}: interquartile mean and 95 % band of {seeds} seeds", fontsize=11)
    canvas.draw()
    output = io.BytesIO()
    figure.savefig(output, format="png")
    return output.getvalue()


def _panel(axes: Any, study: SampleStudy, across: Callable[[LearningCurve], Any]) -> None:
    for curve in study.curves:
        x, color = across(curve)[1:], _COLORS[curve.method]
        low, high = band(curve.scores[:, 1:])
        axes.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
        axes.plot(x, curve.middle[1:], color=color, linewidth=1.6, label=LABELS[curve.method])
    axes.axhline(study.start, color="#5b636d", linestyle=":", linewidth=1.2)
    axes.axhline(study.best_pid, color="#5b636d", linestyle="--", linewidth=1.2)
    end = axes.get_xlim()[1]
    axes.annotate("the PID that is corrected", (end, study.start), va="bottom", ha="right", size=8)
    axes.annotate("best PID for this lung", (end, study.best_pid), va="bottom", ha="right", size=8)
    axes.set_xscale("log")
    lowest = min(float(np.min(curve.scores)) for curve in study.curves)
    axes.set_ylim(0.95 * lowest, 1.25 * study.start)  # room for the legend
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#d9dde2", linewidth=0.6)
