"""One set of axes as numbers for the template: lines, bands and ticks in picture units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ventbench.views import svg
from ventbench.views.runs import Floats

#: Room for the labels: left, right, top, bottom, picture units.
LEFT, RIGHT, TOP, BOTTOM = 34.0, 8.0, 16.0, 30.0


@dataclass
class Chart:
    """Axes with linear scales; y of the picture runs downwards.

    Attributes:
        x: ends of the horizontal axis.
        y: ends of the vertical axis.
        x_label: under it, with the unit.
        y_label: above the frame, with the unit.
        alt: what is seen, in words.
        width: of the picture.
        height: likewise.
        paths: class and path data of lines, the lowest first.
        areas: likewise of filled areas, below the lines.
        bands: left end and width of shaded ranges.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    x_label: str
    y_label: str
    alt: str
    width: float = 300.0
    height: float = 170.0
    paths: list[tuple[str, str]] = field(default_factory=list)
    areas: list[tuple[str, str]] = field(default_factory=list)
    bands: list[tuple[float, float]] = field(default_factory=list)

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom."""
        return LEFT, TOP, self.width - RIGHT, self.height - BOTTOM

    @property
    def x_ticks(self) -> list[tuple[str, float]]:
        """Texts and places."""
        values, texts = ticks(*self.x, 6)
        return [(t, round(float(self.at_x(v)), 1)) for t, v in zip(texts, values, strict=True)]

    @property
    def y_ticks(self) -> list[tuple[str, float]]:
        """Texts and places."""
        values, texts = ticks(*self.y, 4)
        return [(t, round(float(self.at_y(v)), 1)) for t, v in zip(texts, values, strict=True)]

    @property
    def zero(self) -> float | None:
        """Where y is zero, if that is inside."""
        return round(float(self.at_y(0.0)), 1) if self.y[0] < 0 < self.y[1] else None

    def at_x(self, value: ArrayLike) -> Floats:
        """Place on the horizontal axis."""
        left, _, right, _ = self.frame
        share = (np.asarray(value, float) - self.x[0]) / (self.x[1] - self.x[0])
        return left + share * (right - left)

    def at_y(self, value: ArrayLike) -> Floats:
        """Place on the vertical axis; what is far outside stays near the frame."""
        _, top, _, bottom = self.frame
        share = (np.asarray(value, float) - self.y[0]) / (self.y[1] - self.y[0])
        return bottom - np.clip(share, -0.5, 1.5) * (bottom - top)

    def line(self, look: str, x: ArrayLike, y: ArrayLike) -> None:
        """Add a line, which breaks where a point is NaN."""
        self.paths.append((look, svg.path(self._points(x, y))))

    def stairs(self, look: str, edges: ArrayLike, y: ArrayLike) -> None:
        """Add one level for each of k ranges with ``k + 1`` edges."""
        edges = np.asarray(edges, float)
        self.line(look, np.repeat(edges, 2)[1:-1], np.repeat(np.asarray(y, float), 2))

    def boxes(self, look: str, edges: ArrayLike, low: ArrayLike, high: ArrayLike) -> None:
        """Add an area from low to high in each of k ranges."""
        edges, parts = np.asarray(edges, float), []
        bounds = zip(np.asarray(low, float), np.asarray(high, float), strict=True)
        for k, (bottom, top) in enumerate(bounds):
            if np.isfinite(bottom) and np.isfinite(top):
                ends = edges[[k, k + 1]]
                upper, lower = self._points(ends, [top, top]), self._points(ends, [bottom, bottom])
                parts.append(svg.area(upper, lower))
        if parts:
            self.areas.append((look, "".join(parts)))

    def band(self, low: float, high: float) -> None:
        """Shade a range."""
        ends = self.at_x(np.clip([low, high], *self.x))
        left, right = float(ends[0]), float(ends[1])
        self.bands.append((round(left, 1), round(max(right - left, 1.0), 1)))

    def _points(self, x: ArrayLike, y: ArrayLike) -> Floats:
        return np.stack([self.at_x(x), self.at_y(y)], axis=-1)


def ticks(low: float, high: float, count: int) -> tuple[list[float], list[str]]:
    """At most about ``count`` round numbers from ``low`` to ``high``, and their texts."""
    wanted = max(high - low, 1e-9) / count
    scale = 10.0 ** np.floor(np.log10(wanted))
    step = float(scale * next(x for x in (1, 2, 5, 10) if x * scale >= 0.999 * wanted))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    values = [step * k for k in range(first, last + 1)]
    places = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return values, [f"{v + 0.0:.{places}f}" for v in values]


def limits(*arrays: ArrayLike, around: float = 0.06, least: float = 0.0) -> tuple[float, float]:
    """Ends of an axis that holds all finite values with some air.

    Args:
        arrays: of any shape.
        around: air at either end, as a share of the height.
        least: height at least.
    """
    flat = np.concatenate([np.ravel(np.asarray(array, float)) for array in arrays])
    flat = flat[np.isfinite(flat)]
    if flat.size == 0:
        return 0.0, max(least, 1.0)
    low, high = float(flat.min()), float(flat.max())
    missing = max(least - (high - low), 0.0) or (1.0 if high == low else 0.0)
    low, high = low - 0.5 * missing, high + 0.5 * missing
    return low - around * (high - low), high + around * (high - low)
