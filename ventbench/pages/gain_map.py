"""Chart of the error of a PID over its gains."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.errors import require

if TYPE_CHECKING:
    from ventbench.train.pid_search import PIDGrid

#: Values of D that are shown beside the best one, %/cmH2O.
SLICES = (0.0, 0.3, 1.0, 3.0, 10.0)

#: Errors above this multiple of the least one of a row look alike.
SATURATION = 3.0

#: Dots per inch of the chart.
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


def _figure(size: tuple[float, float]) -> Any:
    """A figure that has no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Any) -> bytes:
    output = io.BytesIO()
    # Without the version of matplotlib, equal figures give equal bytes.
    figure.savefig(output, format="png", dpi=DPI, metadata={"Software": None})
    return output.getvalue()
