"""The small multiples as a PNG, through matplotlib's object interface: no global state.

All panels lie in one axes in panel units: 36 axes would take seconds.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import font_manager
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image

from ventbench import palette
from ventbench.base.arrays import Floats
from ventbench.base.text import number
from ventbench.pages import graphics, scores
from ventbench.pages.scores import labels, shared_tracks
from ventbench.palette import BAND, INK, QUIET
from ventbench.palette import LINE as RULE
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.trajectories import Trajectories

#: Width, pixels.
PIXELS = 1800

#: Panel units: margin, gap between panels, heads of the figure (without legend) and of a row.
MARGIN, GAP, HEAD, ROW_HEAD = 14.0, 6.0, 50.0, 40.0

#: Height of one row of the legend, panel units.
LEGEND = 19.0

#: Errors in one row over a panel, and height of such a row, panel units.
ERRORS, ERROR_ROW = 4, 11.0

#: The font that comes with matplotlib.
FONT = "DejaVu Sans"

#: Resolution, dots an inch.
DPI = 150


def png(runs: Sequence[Trajectories]) -> bytes:
    """Return the PNG; equal input gives equal bytes.

    Args:
        runs: matching runs, the one to look at first.
    """
    columns, rows = len(runs[0].pips), len(runs[0].lungs)
    width = 2 * MARGIN + columns * graphics.WIDTH + (columns - 1) * GAP
    row_head = ROW_HEAD + ERROR_ROW * (_error_rows(len(runs)) - 1)
    height = 2 * MARGIN + HEAD + len(runs) * LEGEND + rows * (row_head + graphics.HEIGHT)
    draw = Drawing(width, height, PIXELS)
    numbers, names = scores.collect(runs), [draw.known(name) for name in labels(runs)]
    start = _head(draw, names, shared_tracks(runs))
    for i, row in enumerate(graphics.panels(runs)):
        top = start + i * (row_head + graphics.HEIGHT)
        _row_head(draw, row[0].lung, names, numbers.lungs[:, i], top)
        for j, panel in enumerate(row):
            origin = (MARGIN + j * (graphics.WIDTH + GAP), top + row_head)
            _panel(draw, panel, numbers.cells[:, i, j], origin, first=j == 0)
    used = start + rows * (row_head + graphics.HEIGHT) + MARGIN
    output = io.BytesIO()
    image = draw.image()
    # Room was kept for a legend of one row a run.
    image.crop((0, 0, image.width, round(used * PIXELS / width))).save(
        output, format="PNG", optimize=True
    )
    return output.getvalue()


def _head(draw: Drawing, names: Sequence[str], track: str) -> float:
    """Title, how to read the panels, legend; returns where the panels may start."""
    draw.text(MARGIN, MARGIN + 14, names[0], 17, INK, weight="bold")
    read = (
        f"Breath {graphics.BREATH + 1} on each lung at each PIP. Above: airway pressure, cmH2O; "
        "below: u_in, %; against time, s. Band: scored. Numbers: mean absolute error, cmH2O."
    )
    draw.text(MARGIN, MARGIN + 34, f"{draw.known(track)}. {read}", 10, QUIET)
    x, y = MARGIN, MARGIN + HEAD
    shown = [("target", INK, 1.1), *((n, _color(i), _width(i)) for i, n in enumerate(names))]
    for name, color, width in shown:
        length = 48 + draw.text_width(name, 11)
        if x > MARGIN and x + length > draw.width - MARGIN:
            x, y = MARGIN, y + LEGEND
        draw.line(np.array([[x, y + 4], [x + 18, y + 4]]), color, width, 5)
        draw.text(x + 23, y + 8, name, 11, INK)
        x += length
    return y + LEGEND


def _row_head(draw: Drawing, lung: str, names: Sequence[str], errors: Floats, top: float) -> None:
    """Name of a lung on the left, its errors on the right; without names where these are long."""
    about = parse_lung(lung)
    draw.text(MARGIN, top + 21, lung, 12, INK, weight="bold")
    text = f"R {about.R:g} cmH2O/(L/s), C {about.C:g} mL/cmH2O"
    draw.text(MARGIN + 70, top + 21, text, 10, QUIET)
    x = draw.width - MARGIN - 2
    shown = [f"{name} {number(error)}" for name, error in zip(names, errors, strict=True)]
    if sum(draw.text_width(label, 10) + 14 for label in shown) > draw.width - 350.0:
        shown = [number(error) for error in errors]
    for k, label in reversed(list(enumerate(shown))):
        draw.text(x, top + 21, label, 10, _color(k), ha="right")
        x -= draw.text_width(label, 10) + 14


def _panel(
    draw: Drawing,
    panel: graphics.RunPanel,
    errors: Floats,
    origin: tuple[float, float],
    first: bool,
) -> None:
    at = np.array(origin)
    left, right = graphics.LEFT, graphics.LEFT + graphics.PLOT_WIDTH
    bottom = graphics.VALVE_TOP + graphics.VALVE_HEIGHT
    end = float(graphics.time_x(protocol.INSPIRATION_STEPS * protocol.DT))
    band = np.array([[left, graphics.TOP], [end, graphics.TOP], [end, bottom], [left, bottom]])
    draw.fill(at + band, BAND, 1.0)
    marks = [*panel.ticks, *((u, float(graphics.valve_y(u))) for u in graphics.VALVE_MARKS)]
    for value, y in marks:
        draw.line(at + np.array([[left, y], [right, y]]), RULE, 0.7, 0)
        draw.text(at[0] + left - 4, at[1] + y + 3, f"{value:g}", 8.5, QUIET, ha="right")
    for t in graphics.TIMES:
        x, last = float(graphics.time_x(t)), t == graphics.TIMES[-1]
        text = f"{t:g}{' s' if last else ''}"
        draw.text(at[0] + x, at[1] + graphics.HEIGHT - 3, text, 8.5, QUIET, ha="center")
    draw.text(at[0] + left, at[1] - 1, f"PIP {panel.pip:g}", 9, QUIET)
    for k, error in enumerate(errors):
        line, place = divmod(k, ERRORS)
        last = min(len(errors) - ERRORS * line, ERRORS) - 1
        x = at[0] + right - 32 * (last - place)
        y = at[1] - 1 - ERROR_ROW * (_error_rows(len(errors)) - 1 - line)
        look = {"weight": "bold"} if k == 0 else {}
        draw.text(x, y, number(error), 9, _color(k), ha="right", **look)
    if first:
        draw.text(at[0] + right, at[1] + graphics.TOP + 9, "cmH2O", 8.5, QUIET, ha="right")
        draw.text(at[0] + right, at[1] + graphics.VALVE_TOP + 10, "u_in, %", 8.5, QUIET, ha="right")
    target = graphics.inspiration(panel.target)
    scored = graphics.inspiration(panel.pressures[0])
    if np.isfinite(scored).all():
        area = np.concatenate([_inside(scored), target[::-1]])
        draw.fill(at + area, _color(0), 0.16)
    draw.line(at + panel.target, INK, 1.1, 1)
    for k in range(len(panel.pressures) - 1, -1, -1):
        order = 2 + (k == 0)
        line = _inside(panel.pressures[k])
        draw.line(at + line, _color(k), 0.9, order, 0.5)
        draw.line(at + graphics.inspiration(line), _color(k), _width(k), order)
        draw.line(at + panel.valves[k], _color(k), 1.0, order)
    if panel.above is not None:
        draw.text(
            at[0] + right,
            at[1] + graphics.TOP + 21,
            f"↑ {panel.above:.0f}",
            8.5,
            _color(0),
            ha="right",
        )


def _inside(line: Floats) -> Floats:
    """A pressure line that stays in its frame."""
    limits = (graphics.TOP, graphics.TOP + graphics.PRESSURE_HEIGHT)
    return np.stack([line[:, 0], np.clip(line[:, 1], *limits)], axis=-1)


def _error_rows(runs: int) -> int:
    return -(-runs // ERRORS)


def _color(run: int) -> str:
    return palette.RUNS[palette.run_index(run)]


def _width(run: int) -> float:
    return 1.9 if run == 0 else 1.4


class Drawing:
    """Collects lines and areas by look, so that each look is one collection.

    Args:
        width: width of the picture in units; all lengths are in these, y downwards.
        height: height of the picture in units.
        pixels: the width in pixels.
    """

    def __init__(self, width: float, height: float, pixels: int):
        scale = pixels / width
        self.width, self.points = width, scale * 72.0 / DPI
        size = (pixels / DPI, round(height * scale) / DPI)
        figure = Figure(figsize=size, dpi=DPI, facecolor="white")
        self.canvas = FigureCanvasAgg(figure)
        self.axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, width), ylim=(height, 0.0))
        self.axes.set_axis_off()
        self.lines: dict[tuple[int, str, float, float], list[Floats]] = {}
        self.fills: dict[tuple[str, float], list[Floats]] = {}
        self.font = font_manager.get_font(font_manager.findfont(FONT))

    def known(self, text: str) -> str:
        """Text with a question mark for characters that the font lacks."""
        return "".join(c if self.font.get_char_index(ord(c)) else "?" for c in text)

    def text(self, x: float, y: float, text: str, size: float, color: str, **look: Any) -> None:
        """Text at its baseline; names are never taken for mathematics."""
        self.axes.text(
            x,
            y,
            text,
            fontsize=size * self.points,
            color=color,
            family=FONT,
            parse_math=False,
            **look,
        )

    def line(self, line: Floats, color: str, width: float, order: int, alpha: float = 1.0) -> None:
        """Polyline, shape ``(n, 2)``; a higher order lies above."""
        self.lines.setdefault((order, color, width, alpha), []).append(line)

    def fill(self, outline: Floats, color: str, alpha: float) -> None:
        """Area within an outline, shape ``(n, 2)``; below all lines."""
        self.fills.setdefault((color, alpha), []).append(outline)

    def text_width(self, text: str, size: float) -> float:
        """Width of a text in units, generously."""
        self.font.set_size(size, 72.0)
        self.font.set_text(text)
        return 1.03 * self.font.get_width_height()[0] / 64.0

    def image(self) -> Image.Image:
        """Draw everything; a picture of 256 colours, a third of the size and not to be told."""
        self._collect()
        self.canvas.draw()
        pixels = np.asarray(self.canvas.buffer_rgba())[..., :3]
        return Image.fromarray(np.ascontiguousarray(pixels)).quantize(
            256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )

    def _collect(self) -> None:
        for order, ((color, alpha), outlines) in enumerate(self.fills.items()):
            self.axes.add_collection(
                PolyCollection(outlines, facecolor=color, alpha=alpha, linewidth=0, zorder=order),
                autolim=False,
            )
        for (order, color, width, alpha), lines in self.lines.items():
            self.axes.add_collection(
                LineCollection(
                    lines,
                    colors=color,
                    linewidths=width * self.points,
                    alpha=alpha,
                    zorder=10 + order,
                    capstyle="round",
                ),
                autolim=False,
            )
