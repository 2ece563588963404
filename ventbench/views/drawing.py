"""Many lines and texts on one matplotlib axes, quickly and without global state."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import font_manager
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image

from ventbench.views.runs import Floats

#: The font that comes with matplotlib.
FONT = "DejaVu Sans"

#: Resolution, dots an inch.
DPI = 150


class Drawing:
    """Collects lines and areas by look, so that each look is one collection.

    Args:
        width: of the picture in units; all lengths are in these, y downwards.
        height: likewise.
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
