"""The small multiples of runs as a PNG, through matplotlib's object interface: no global state.

A panel is one lung and PIP: pressure above, u_in below, against time; the last scored breath from
its start to just after the target's fall. What is scored lies on a band.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ventbench import palette
from ventbench.base.text import number
from ventbench.pages import graphics, scores
from ventbench.pages.plots import few_colours
from ventbench.task import protocol
from ventbench.trajectories import Trajectories

#: Width, pixels, and resolution, dots an inch.
PIXELS, DPI = 1800, 150

#: Heights in inches: of the head, of the panels of a lung, and of the foot.
HEAD, ROW, FOOT = 0.9, 1.95, 0.3

#: The font that comes with matplotlib.
FONT = "DejaVu Sans"

_SMALL: dict[str, Any] = {"fontsize": 7, "parse_math": False, "family": FONT}


def png(runs: Sequence[Trajectories]) -> bytes:
    """Return the PNG; equal input gives equal bytes.

    Args:
        runs: matching runs, the one to look at first.
    """
    lungs, pips = runs[0].lungs, runs[0].pips
    width, height = PIXELS / DPI, HEAD + ROW * len(lungs) + FOOT
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(
        2 * len(lungs), len(pips), squeeze=False,
        gridspec_kw={
            "height_ratios": [2.6, 1.0] * len(lungs), "hspace": 0.26, "wspace": 0.16,
            "left": 0.05, "right": 0.99, "top": 1.0 - HEAD / height, "bottom": FOOT / height,
        },
    )  # fmt: skip
    numbers, names = scores.collect(runs), _drawn(scores.labels(runs))
    for j in range(len(pips)):
        limits = graphics.pressure_limits(runs, j)
        for i, lung in enumerate(lungs):
            upper, lower = axes[2 * i, j], axes[2 * i + 1, j]
            _panel(upper, lower, runs, (i, j), limits)
            upper.set_title(f"PIP {pips[j]:g}", loc="left", pad=3, **_SMALL)
            for k, error in enumerate(numbers.cells[:, i, j].tolist()):
                _number(upper, number(error), k, len(runs))
            if j == 0:
                upper.set_ylabel(f"{lung}, cmH2O", **_SMALL | {"weight": "bold"})
                lower.set_ylabel("u_in, %", **_SMALL)
            else:
                lower.tick_params(labelleft=False)
        axes[-1, j].tick_params(labelbottom=True)
    figure.text(0.012, 1.0 - 0.3 / height, names[0], fontsize=13, weight="bold", parse_math=False)
    read = (
        f"{scores.shared_tracks(runs)}. Breath {graphics.BREATH + 1} on each lung at each PIP, "
        "against time, s. Black: target. Band: scored. Numbers: mean absolute error, cmH2O."
    )
    (read,) = _drawn([read])
    figure.text(0.012, 1.0 - 0.5 / height, read, color=palette.QUIET, **_SMALL)
    for k, name in enumerate(names):
        place = 0.012 + 0.98 * k / max(len(names), 4)
        figure.text(place, 1.0 - 0.68 / height, f"— {name}", color=_color(k), **_SMALL)
    output = io.BytesIO()
    # Without the version of matplotlib, equal runs give equal bytes.
    figure.savefig(output, format="png", metadata={"Software": None})
    return few_colours(output.getvalue())


def _panel(
    upper: Axes,
    lower: Axes,
    runs: Sequence[Trajectories],
    at: tuple[int, int],
    limits: tuple[float, float],
) -> None:
    """Draw the runs of a lung and PIP, the first one above the others."""
    time, scored = graphics.shown_times(), slice(protocol.INSPIRATION_STEPS)
    target = runs[0].target[at][graphics.WINDOW]
    # Limits first, and apart from one another: to find common ones takes longest.
    upper.set(ylim=limits, yticks=(float(target.min()), runs[0].pips[at[1]]))
    lower.set(ylim=(-3.0, protocol.U_MAX + 3.0), yticks=graphics.VALVE_MARKS)
    for axes in (upper, lower):
        axes.set(xlim=(0.0, time[-1]), xticks=graphics.TIMES)
        axes.tick_params(length=0.0, labelsize=7, labelcolor=palette.QUIET, labelbottom=False)
        axes.spines[:].set_visible(False)
        axes.grid(axis="y", color=palette.LINE, linewidth=0.7)
        axes.axvspan(0.0, protocol.INSPIRATION_STEPS * protocol.DT, color=palette.BAND, zorder=0)
    for k in reversed(range(len(runs))):
        pressure, u_in = (x[at][graphics.WINDOW] for x in (runs[k].pressure, runs[k].u_in))
        pressure = np.where(np.isfinite(pressure), pressure, np.nan)
        upper.plot(time, pressure, color=_color(k), linewidth=0.9, alpha=0.5)
        upper.plot(time[scored], pressure[scored], color=_color(k), linewidth=1.9 - 0.5 * (k > 0))
        lower.step(time, u_in, color=_color(k), linewidth=1.0, where="post")
        if k == 0:
            upper.fill_between(time[scored], target[scored], pressure[scored], color=_color(k),
                               alpha=0.16, linewidth=0.0)  # fmt: skip
    upper.plot(time, target, color=palette.INK, linewidth=1.1, zorder=1)


def _number(axes: Axes, text: str, run: int, runs: int) -> None:
    """The number of a run at the upper right of a panel, in rows of four."""
    row, place = divmod(run, 4)
    last = min(runs - 4 * row, 4) - 1
    axes.text(
        1.0 - 0.17 * (last - place), 1.03 - 0.13 * row, text, transform=axes.transAxes,
        ha="right", color=_color(run), weight="bold" if run == 0 else "normal", **_SMALL,
    )  # fmt: skip


def _drawn(texts: Sequence[str]) -> list[str]:
    """Texts with a question mark for characters that the font lacks."""
    font = font_manager.get_font(font_manager.findfont(FONT))
    return ["".join(c if font.get_char_index(ord(c)) else "?" for c in text) for text in texts]


def _color(run: int) -> str:
    return palette.RUNS[palette.run_index(run)]
