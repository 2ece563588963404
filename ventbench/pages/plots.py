"""Charts by matplotlib: runs, stressor by severity, and the error of a PID over its gains.

In the chart of stressors the colour of a field is the share of runs that held the set pressure.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench import palette
from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError, require
from ventbench.base.text import number
from ventbench.pages import panels
from ventbench.task import protocol
from ventbench.task.stressors import CATEGORIES, SEVERITIES, stressor

if TYPE_CHECKING:
    from ventbench.train.pid_grid import PIDGrid
    from ventbench.trajectories import Trajectories

#: Values of D that are shown beside the best one, %/cmH2O.
SLICES = (0.0, 0.3, 1.0, 3.0, 10.0)

#: Errors above this multiple of the least one of a row look alike.
SATURATION = 3.0

#: Dots per inch of the pictures.
DPI = 110


def gain_map_png(grid: PIDGrid, *, each: bool = True, single: bool = True) -> bytes:
    """Draw the grid of PID gains: error over P and I, one row a lung, one map a value of D.

    ``each`` shows each lung, ``single`` the mean over several lungs.

    Raises:
        InputError: if matplotlib is missing.
    """
    require("matplotlib")
    error = grid.error.mean(axis=-1, dtype=np.float64)
    rows = list(zip(grid.lungs, error, strict=True)) if each else []
    if single and len(grid.lungs) > 1:
        rows.append(("mean of all", error.mean(axis=0)))
    columns = len(SLICES) + 1
    figure = _figure((2.5 * columns + 0.8, 2.5 * len(rows) + 0.7))
    figure.suptitle("Mean |pressure - target|, cmH2O; cross: the least of the map")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, values) in zip(axes, rows, strict=True):
        _row(figure, line, name, grid.gains, values)
    return _png(figure)


def _row(figure: Any, axes: Any, name: str, gains: Floats, error: Floats) -> None:
    best = int(np.argmin(error))
    shown = [d for d in SLICES if np.any(gains[:, 2] == d)]
    slices = [("best: ", float(gains[best, 2])), *(("", d) for d in shown)]
    low, image = float(error[best]), None
    for axis, (prefix, d) in zip(axes, slices, strict=False):
        image = _map(axis, gains, error, d, (low, SATURATION * low))
        axis.set_title(f"{prefix}D = {d:g}", fontsize=9)
    for axis in axes[len(slices) :]:
        axis.set_axis_off()
    gain = ", ".join(f"{value:g}" for value in gains[best])
    axes[0].set_ylabel(f"{name}\n{gain}: {low:.3f}\nP", fontsize=9)
    figure.colorbar(image, ax=list(axes), shrink=0.9, extend="max")


def _map(axis: Any, gains: Floats, error: Floats, d: float, limits: tuple[float, float]) -> Any:
    """One map; the values are not evenly spaced, so each is one cell wide."""
    here = gains[:, 2] == d
    (P, row), (I, column) = (  # noqa: E741
        np.unique(gains[here, k], return_inverse=True) for k in (0, 1)
    )
    values = np.full((P.size, I.size), np.nan)
    values[row, column] = error[here]
    image = axis.imshow(
        values, origin="lower", cmap="viridis_r", vmin=limits[0], vmax=limits[1], aspect="auto"
    )
    y, x = np.unravel_index(int(np.nanargmin(values)), values.shape)
    axis.plot(x, y, marker="x", color="#e2603c", markersize=7, markeredgewidth=2)
    axis.set_xlabel("I", fontsize=8)
    for ticks, labels in ((I, axis.set_xticks), (P, axis.set_yticks)):
        at = np.unique(np.linspace(0, ticks.size - 1, 5).round().astype(int))
        labels(at, [f"{ticks[k]:g}" for k in at], fontsize=7)
    return image


#: Inches of a column and a row of the chart, and of what stands around them.
COLUMN, ROW, AROUND = 1.12, 0.235, (4.6, 1.9)

#: From no run that held (dark) to all (white): one hue, so that it reads in grey as well.
COLORS = ("#8c1d18", "#c8452f", "#ec8a5e", "#f7cfae", "#ffffff")


def write_stress_chart(path: Path | str, scores: Sequence[Mapping[str, Any]]) -> Path:
    """Write the chart as a PNG, and return the path; equal input gives equal bytes.

    Args:
        path: target, ``.png`` by custom.
        scores: the key ``stress`` of what ``ventbench score --json`` wrote for each entry.

    Raises:
        InputError: if there is no score, or the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    content = stress_chart_png(scores)
    files.write_atomically(path, lambda file: file.write(content))
    return path


def stress_chart_png(scores: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the chart as a PNG; see :func:`write_stress_chart`."""
    if not scores:
        raise InputError("no stress score to draw")
    require("matplotlib")
    from matplotlib.colors import LinearSegmentedColormap

    order = [*CATEGORIES, "pairs"]
    category = {
        tuple(row["stressors"]): row["category"]
        for row in scores[0]["conditions"]
        if row["stressors"]
    }
    rows = sorted(category, key=lambda names: order.index(category[names]))
    by_id = [{row["condition"]: row for row in score["conditions"]} for score in scores]
    cells = [
        [of.get(f"{'+'.join(names)}:{severity}") for of in by_id for severity in SEVERITIES]
        for names in rows
    ]
    share = [[np.nan if cell is None else cell["survived"] for cell in row] for row in cells]
    columns = len(share[0])
    size = (AROUND[0] + COLUMN * columns, AROUND[1] + ROW * len(rows))
    figure = _figure(size)
    axes = figure.subplots()
    shade = LinearSegmentedColormap.from_list("held", COLORS)
    axes.imshow(share, cmap=shade, vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_yticks(range(len(rows)), [_title(names) for names in rows], fontsize=8.5)
    axes.set_xticks(range(columns), SEVERITIES * len(scores), fontsize=8.5)
    axes.tick_params(length=0.0, top=True, labeltop=True, bottom=False, labelbottom=False)
    axes.spines[:].set_visible(False)
    for y, row in enumerate(cells):
        kind = category[rows[y]]
        if y == 0 or kind != category[rows[y - 1]]:
            axes.axhline(y - 0.5, color=palette.LINE)
            axes.text(columns - 0.4, y, CATEGORIES.get(kind, kind), color=palette.QUIET, **_SMALL)
        for x, cell in enumerate(row):
            if cell is not None:
                ink = "white" if cell["survived"] < 0.35 else palette.INK
                axes.text(x, y, _cell(cell), color=ink, ha="center", **_SMALL)
    for k, score in enumerate(scores):
        axes.axvline(2 * k - 0.5, color=palette.LINE)
        value = "failed" if score["score"] is None else f"{score['score']:.2f} cmH2O"
        about = f"{value}, {100 * score['survived']:.0f} % held\n"
        about += f"{_number(by_id[k]['none']['error_cmH2O'])} cmH2O without stressor"
        text = f"{score['name']}\n{about}"
        axes.text(2 * k + 0.5, -1.6, text, ha="center", va="bottom", fontsize=8.5, parse_math=False)
    figure.supxlabel(
        "Colour and %: runs that held the set pressure within 2 cmH2O + 4 % in the third breath "
        "and stayed safe. Then what the stressor adds to the mean error, cmH2O; "
        "▲ n: runs with unsafe pressure.",
        fontsize=8.5, color=palette.QUIET,
    )  # fmt: skip
    return few_colours(_png(figure))


def few_colours(picture: bytes) -> bytes:
    """A PNG in 256 colours: a third of the size, and not to be told."""
    from PIL import Image

    image = Image.open(io.BytesIO(picture)).convert("RGB")
    small = image.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    output = io.BytesIO()
    small.save(output, format="PNG", optimize=True)
    return output.getvalue()


_SMALL: dict[str, Any] = {"fontsize": 8.5, "va": "center"}


def _title(names: tuple[str, ...]) -> str:
    if len(names) == 1:
        return stressor(names[0]).title
    return " + ".join(name.replace("_", " ") for name in names)


def _cell(row: Mapping[str, Any]) -> str:
    unsafe = f" ▲{row['unsafe_runs']}" if row["unsafe_runs"] else ""
    return f"{100 * row['survived']:.0f} %  {_number(row['rise_cmH2O'], sign=True)}{unsafe}"


def _number(value: float | None, sign: bool = False) -> str:
    """A number with one decimal; what rounds to zero has no sign."""
    text = number(math.nan if value is None else value, 1, sign)
    return "0.0" if text == "+0.0" else text


def _figure(size: tuple[float, float], **options: Any) -> Any:
    """A figure that has no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, **options or {"layout": "constrained"})
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Any, dpi: int = DPI) -> bytes:
    output = io.BytesIO()
    # Without the version of matplotlib, equal figures give equal bytes.
    figure.savefig(output, format="png", dpi=dpi, metadata={"Software": None})
    return output.getvalue()


#: Width of the small multiples of runs, pixels, and their resolution, dots an inch; heights in
#: inches: of the head, of the panels of a lung, and of the foot.
PIXELS, RUNS_DPI = 1800, 150
HEAD, LUNG, FOOT = 0.9, 1.95, 0.3

#: The font that comes with matplotlib.
FONT = "DejaVu Sans"

_TINY: dict[str, Any] = {"fontsize": 7, "parse_math": False, "family": FONT}


def runs_png(runs: Sequence[Trajectories]) -> bytes:
    """Return the small multiples of matching runs as a PNG; equal input gives equal bytes.

    A panel is one lung and PIP: pressure above, u_in below, against time; the last scored breath
    from its start to just after the target's fall. What is scored lies on a band.
    """
    lungs, pips = runs[0].lungs, runs[0].pips
    width, height = PIXELS / RUNS_DPI, HEAD + LUNG * len(lungs) + FOOT
    figure = _figure((width, height), dpi=RUNS_DPI, facecolor="white")
    axes = figure.subplots(
        2 * len(lungs), len(pips), squeeze=False,
        gridspec_kw={
            "height_ratios": [2.6, 1.0] * len(lungs), "hspace": 0.26, "wspace": 0.16,
            "left": 0.05, "right": 0.99, "top": 1.0 - HEAD / height, "bottom": FOOT / height,
        },
    )  # fmt: skip
    numbers, names = panels.collect(runs), _drawn(panels.labels(runs))
    for j in range(len(pips)):
        limits = panels.pressure_limits(runs, j)
        for i, lung in enumerate(lungs):
            upper, lower = axes[2 * i, j], axes[2 * i + 1, j]
            _panel(upper, lower, runs, (i, j), limits)
            upper.set_title(f"PIP {pips[j]:g}", loc="left", pad=3, **_TINY)
            for k, error in enumerate(numbers.cells[:, i, j].tolist()):
                _error(upper, number(error), k, len(runs))
            if j == 0:
                upper.set_ylabel(f"{lung}, cmH2O", **_TINY | {"weight": "bold"})
                lower.set_ylabel("u_in, %", **_TINY)
            else:
                lower.tick_params(labelleft=False)
        axes[-1, j].tick_params(labelbottom=True)
    figure.text(0.012, 1.0 - 0.3 / height, names[0], fontsize=13, weight="bold", parse_math=False)
    read = (
        f"{panels.shared_tracks(runs)}. Breath {panels.BREATH + 1} on each lung at each PIP, "
        "against time, s. Black: target. Band: scored. Numbers: mean absolute error, cmH2O."
    )
    (read,) = _drawn([read])
    figure.text(0.012, 1.0 - 0.5 / height, read, color=palette.QUIET, **_TINY)
    for k, name in enumerate(names):
        place = 0.012 + 0.98 * k / max(len(names), 4)
        figure.text(place, 1.0 - 0.68 / height, f"— {name}", color=_color(k), **_TINY)
    return few_colours(_png(figure, RUNS_DPI))


def _panel(
    upper: Any,
    lower: Any,
    runs: Sequence[Trajectories],
    at: tuple[int, int],
    limits: tuple[float, float],
) -> None:
    """Draw the runs of a lung and PIP, the first one above the others."""
    time, scored = panels.shown_times(), slice(protocol.INSPIRATION_STEPS)
    target = runs[0].target[at][panels.WINDOW]
    # Limits first, and apart from one another: to find common ones takes longest.
    upper.set(ylim=limits, yticks=(float(target.min()), runs[0].pips[at[1]]))
    lower.set(ylim=(-3.0, protocol.U_MAX + 3.0), yticks=panels.VALVE_MARKS)
    for axes in (upper, lower):
        axes.set(xlim=(0.0, time[-1]), xticks=panels.TIMES)
        axes.tick_params(length=0.0, labelsize=7, labelcolor=palette.QUIET, labelbottom=False)
        axes.spines[:].set_visible(False)
        axes.grid(axis="y", color=palette.LINE, linewidth=0.7)
        axes.axvspan(0.0, protocol.INSPIRATION_STEPS * protocol.DT, color=palette.BAND, zorder=0)
    for k in reversed(range(len(runs))):
        pressure, u_in = (x[at][panels.WINDOW] for x in (runs[k].pressure, runs[k].u_in))
        pressure = np.where(np.isfinite(pressure), pressure, np.nan)
        upper.plot(time, pressure, color=_color(k), linewidth=0.9, alpha=0.5)
        upper.plot(time[scored], pressure[scored], color=_color(k), linewidth=1.9 - 0.5 * (k > 0))
        lower.step(time, u_in, color=_color(k), linewidth=1.0, where="post")
        if k == 0:
            upper.fill_between(time[scored], target[scored], pressure[scored], color=_color(k),
                               alpha=0.16, linewidth=0.0)  # fmt: skip
    upper.plot(time, target, color=palette.INK, linewidth=1.1, zorder=1)


def _error(axes: Any, text: str, run: int, runs: int) -> None:
    """The number of a run at the upper right of a panel, in rows of four."""
    row, place = divmod(run, 4)
    last = min(runs - 4 * row, 4) - 1
    axes.text(
        1.0 - 0.17 * (last - place), 1.03 - 0.13 * row, text, transform=axes.transAxes,
        ha="right", color=_color(run), weight="bold" if run == 0 else "normal", **_TINY,
    )  # fmt: skip


def _drawn(texts: Sequence[str]) -> list[str]:
    """Texts with a question mark for characters that the font lacks."""
    from matplotlib import font_manager

    font = font_manager.get_font(font_manager.findfont(FONT))
    return ["".join(c if font.get_char_index(ord(c)) else "?" for c in text) for text in texts]


def _color(run: int) -> str:
    return palette.RUNS[palette.run_index(run)]
