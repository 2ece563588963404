"""Charts by matplotlib: stressor by severity, and the error of a PID over its gains.

In the chart of stressors the colour of a field is the share of runs that held the set pressure
safely; beside it stands what the stressor adds to the error.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base import files
from ventbench.base.errors import InputError, require
from ventbench.task.stressors import CATEGORIES, SEVERITIES, stressor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ventbench.train.pid_grid import PIDGrid

#: Values of D that are shown beside the best one, %/cmH2O.
SLICES = (0.0, 0.3, 1.0, 3.0, 10.0)

#: Errors above this multiple of the least one of a row look alike.
SATURATION = 3.0

#: Dots per inch of the pictures.
DPI = 110


def gain_map_png(grid: PIDGrid, *, each: bool = True, single: bool = True) -> bytes:
    """Draw the grid of PID gains: error over P and I, one row a lung, one map a value of D.

    Args:
        grid: grid of one lung or more.
        each: show each lung.
        single: show the mean over lungs.

    Raises:
        InputError: if matplotlib is missing.
    """
    require("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    error = grid.error.mean(axis=-1, dtype=np.float64)
    rows = list(zip(grid.lungs, error, strict=True)) if each else []
    if single and len(grid.lungs) > 1:
        rows.append(("mean of all", error.mean(axis=0)))
    columns = len(SLICES) + 1
    figure = Figure(figsize=(2.5 * columns + 0.8, 2.5 * len(rows) + 0.7), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle("Mean |pressure - target|, cmH2O; cross: the least of the map")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, values) in zip(axes, rows, strict=True):
        _row(figure, line, name, grid.gains, values)
    output = io.BytesIO()
    # Without the version of matplotlib, equal grids give equal bytes.
    figure.savefig(output, format="png", dpi=DPI, metadata={"Software": None})
    return output.getvalue()


def _row(
    figure: Any, axes: Any, name: str, gains: NDArray[np.float64], error: NDArray[np.float64]
) -> None:
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


def _map(
    axis: Any,
    gains: NDArray[np.float64],
    error: NDArray[np.float64],
    d: float,
    limits: tuple[float, float],
) -> Any:
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
    for ticks, labels, put in (
        (I, axis.set_xticks, axis.set_xlabel),
        (P, axis.set_yticks, None),
    ):
        at = np.unique(np.linspace(0, ticks.size - 1, 5).round().astype(int))
        labels(at, [f"{ticks[k]:g}" for k in at], fontsize=7)
        if put is not None:
            put("I", fontsize=8)
    return image


#: Dots per inch of the picture.
DPI = 130

#: Sizes in inches: a row, a column of a severity, text on the left, room above and below.
ROW, COLUMN, LEFT, HEAD, FOOT = 0.235, 1.12, 4.1, 1.25, 0.85

#: Gap between two entries in columns, and between two categories in rows.
ENTRY_GAP, CATEGORY_GAP = 0.18, 0.45

INK, QUIET = "#16191d", "#5b636d"

#: From no run that held (dark) to all (white): one hue, so that it reads in grey as well.
COLORS = ("#8c1d18", "#c8452f", "#ec8a5e", "#f7cfae", "#ffffff")

_CATEGORY_TITLES = {
    "none": "without stressor",
    "valve": "valve and supply",
    "circuit": "circuit",
    "sensor": "sensor",
    "lung": "airway and lung",
    "patient": "patient",
    "setting": "other lungs",
    "pairs": "pairs",
}


def write_stress_chart(path: Path | str, scores: Sequence[Mapping[str, Any]]) -> Path:
    """Write the chart as a PNG.

    Args:
        path: target, ``.png`` by custom.
        scores: what ``ventbench score --track stress --json`` wrote for each entry.

    Returns:
        The path; equal input gives equal bytes.

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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    rows = _rows(scores[0])
    height = max(y for _, _, y in rows) + 1.0
    across = len(scores) * (len(SEVERITIES) + ENTRY_GAP)
    size = (LEFT + COLUMN * across + 0.2, HEAD + ROW * height + FOOT)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    box = (LEFT / size[0], FOOT / size[1], COLUMN * across / size[0], ROW * height / size[1])
    axes = figure.add_axes(box, xlim=(0.0, across), ylim=(height, 0.0))
    axes.set_axis_off()
    names = ", ".join(str(score["name"]) for score in scores)
    figure.text(
        0.15 / size[0], 1.0 - 0.3 / size[1], f"Stress track: {names}", fontsize=13, color=INK,
        weight="bold", parse_math=False, va="center",
    )  # fmt: skip
    _labels(axes, rows)
    for index, score in enumerate(scores):
        _entry(axes, score, rows, index * (len(SEVERITIES) + ENTRY_GAP))
    figure.text(
        0.15 / size[0], 0.42 / size[1],
        "Colour and %: runs that held the set pressure within 2 cmH2O + 4 % in the third breath "
        "and stayed safe.\nSmall: what the stressor adds to the mean error, cmH2O. "
        "▲ n: runs with unsafe pressure.",
        fontsize=8.5, color=QUIET, va="center", linespacing=1.5,
    )  # fmt: skip
    output = io.BytesIO()
    # Without the version of matplotlib, equal scores give equal bytes.
    figure.savefig(output, format="png", dpi=DPI, metadata={"Software": None})
    # 256 colours: a third of the size, and not to be told.
    picture = Image.open(output).convert("RGB")
    small = picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    output = io.BytesIO()
    small.save(output, format="PNG", optimize=True)
    return output.getvalue()


def _rows(score: Mapping[str, Any]) -> list[tuple[tuple[str, ...], str, float]]:
    """Stressors of a score with their category and their place, in the order of categories."""
    known = {tuple(row["stressors"]): row["category"] for row in score["conditions"]}
    rows, y = [], 0.0
    for category in ("none", *CATEGORIES, "pairs"):
        members = [names for names, own in known.items() if own == category]
        y += CATEGORY_GAP if rows and members else 0.0
        for names in members:
            rows.append((names, category, y))
            y += 1.0
    return rows


def _labels(axes: Axes, rows: list[tuple[tuple[str, ...], str, float]]) -> None:
    seen = set()
    for names, category, y in rows:
        if category not in seen:
            seen.add(category)
            place = -LEFT / COLUMN + 0.12
            axes.text(
                place, y + 0.5, _CATEGORY_TITLES[category], fontsize=8.5, color=QUIET, va="center",
                clip_on=False,
            )  # fmt: skip
        if len(names) > 1:
            text = " + ".join(name.replace("_", " ") for name in names)
        else:
            text = stressor(names[0]).title if names else ""
        axes.text(-0.08, y + 0.5, text, fontsize=8.5, color=INK, va="center", ha="right")


def _entry(
    axes: Axes,
    score: Mapping[str, Any],
    rows: list[tuple[tuple[str, ...], str, float]],
    left: float,
) -> None:
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import Rectangle

    shade = LinearSegmentedColormap.from_list("held", COLORS)
    by_id = {row["condition"]: row for row in score["conditions"]}
    middle = left + len(SEVERITIES) / 2
    value = "failed" if score["score"] is None else f"{score['score']:.2f} cmH2O"
    held = f"{100 * score['survived']:.0f} % held"
    axes.text(
        middle, -2.05, str(score["name"]), fontsize=9.5, weight="bold", color=INK, ha="center",
        parse_math=False,
    )  # fmt: skip
    axes.text(middle, -1.15, f"{value}, {held}", fontsize=8.5, color=QUIET, ha="center")
    for column, severity in enumerate(SEVERITIES):
        axes.text(left + column + 0.5, -0.3, severity, fontsize=8.5, color=INK, ha="center")
    for names, category, y in rows:
        if category == "none":
            cells = [(by_id["none"], left, 2.0)]
        else:
            ids = [f"{'+'.join(names)}:{severity}" for severity in SEVERITIES]
            cells = [(by_id[key], left + k, 1.0) for k, key in enumerate(ids) if key in by_id]
        for row, x, width in cells:
            share = row["survived"]
            axes.add_patch(
                Rectangle(
                    (x + 0.02, y + 0.05), width - 0.04, 0.9,
                    facecolor=shade(round(20.0 * share) / 20.0),  # few colours: a small file
                    edgecolor="#d9dde2", linewidth=0.6,
                )
            )  # fmt: skip
            ink = "white" if share < 0.35 else INK
            axes.text(
                x + (0.42 if width == 1 else 0.8), y + 0.52, f"{100 * share:.0f} %",
                fontsize=8.5, color=ink, va="center", ha="right",
            )  # fmt: skip
            text = _shown(row["error_cmH2O"] if category == "none" else row["rise_cmH2O"])
            if category != "none" and text[0].isdigit() and text != "0.0":
                text = f"+{text}"
            axes.text(
                x + (0.72 if width == 1 else 1.2), y + 0.52, text, fontsize=7.5,
                color=ink, va="center", ha="right",
            )  # fmt: skip
            if row["unsafe_runs"]:
                axes.text(
                    x + width - 0.06, y + 0.52, f"▲{row['unsafe_runs']}", fontsize=7.5, color=ink,
                    va="center", ha="right",
                )  # fmt: skip


def _shown(value: float | None) -> str:
    """A number with one decimal; what rounds to zero has no sign."""
    return "failed" if value is None else f"{round(value, 1) + 0.0:.1f}"
