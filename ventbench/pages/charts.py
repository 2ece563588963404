"""Charts as pages draw them: axes, and lines, areas and ticks in picture units for a template."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats


@dataclass
class Chart:
    """Axes with linear scales, or a logarithmic horizontal one; y of the picture runs downwards."""

    x: tuple[float, float]  #: ends of the horizontal axis.
    y: tuple[float, float]  #: ends of the vertical axis.
    x_label: str  #: label under the frame, with the unit.
    y_label: str  #: label above the frame, with the unit.
    alt: str  #: description of the picture for those who cannot see it.
    width: float = 300.0  #: width of the picture.
    height: float = 170.0  #: height of the picture.
    #: class and path data of lines, the lowest first.
    paths: list[tuple[str, str]] = field(default_factory=list)
    #: class and path data of filled areas, below the lines.
    areas: list[tuple[str, str]] = field(default_factory=list)
    #: left end and width of shaded ranges.
    bands: list[tuple[float, float]] = field(default_factory=list)
    #: whether the horizontal axis is logarithmic; smaller values stand at its left end.
    log: bool = False
    #: room left, right, top and bottom of the frame, picture units.
    room: tuple[float, float, float, float] = (40.0, 16.0, 18.0, 30.0)
    marks: tuple[float, ...] = ()  #: values that the vertical axis marks in place of round ones.

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the frame, picture units."""
        left, right, top, bottom = self.room
        return left, top, self.width - right, self.height - bottom

    @property
    def x_ticks(self) -> list[tuple[str, float]]:
        """Texts and places of the ticks, picture units."""
        values, texts = log_ticks(*self.x) if self.log else ticks(*self.x, 6)
        return [(t, round(float(self.at_x(v)), 1)) for t, v in zip(texts, values, strict=True)]

    @property
    def y_ticks(self) -> list[tuple[str, float]]:
        """Texts and places of the ticks, picture units."""
        values, texts = ticks(*self.y, 4)
        if self.marks:
            values, texts = [*self.marks], [f"{value:g}" for value in self.marks]
        return [(t, round(float(self.at_y(v)), 1)) for t, v in zip(texts, values, strict=True)]

    @property
    def zero(self) -> float | None:
        """Place of y = 0, or None if it is outside."""
        return round(float(self.at_y(0.0)), 1) if self.y[0] < 0 < self.y[1] else None

    def at_x(self, value: ArrayLike) -> Floats:
        """Place on the horizontal axis."""
        left, _, right, _ = self.frame
        value, (low, high) = np.asarray(value, float), self.x
        if self.log:
            value, low, high = np.log(np.maximum(value, low)), np.log(low), np.log(high)
        share = (value - low) / (high - low)
        return left + share * (right - left)

    def at_y(self, value: ArrayLike) -> Floats:
        """Place on the vertical axis; values far outside stay near the frame."""
        _, top, _, bottom = self.frame
        share = (np.asarray(value, float) - self.y[0]) / (self.y[1] - self.y[0])
        return bottom - np.clip(share, -0.5, 1.5) * (bottom - top)

    def line(self, look: str, x: ArrayLike, y: ArrayLike) -> None:
        """Add a line, which breaks where a point is not finite."""
        self.paths.append((look, path(self._points(x, y))))

    def held(self, look: str, x: ArrayLike, y: ArrayLike) -> None:
        """Add a line of values each of which holds until the next one."""
        self.line(look, np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1])

    def between(self, look: str, x: ArrayLike, first: ArrayLike, second: ArrayLike) -> None:
        """Add the area between two lines; none where one of them has a gap."""
        if filled := area(self._points(x, first), self._points(x, second)):
            self.areas.append((look, filled))

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
                parts.append(area(upper, lower))
        if parts:
            self.areas.append((look, "".join(parts)))

    def band(self, low: float, high: float) -> None:
        """Shade a range."""
        ends = self.at_x(np.clip([low, high], *self.x))
        left, right = float(ends[0]), float(ends[1])
        self.bands.append((round(left, 1), round(max(right - left, 1.0), 1)))

    def _points(self, x: ArrayLike, y: ArrayLike) -> Floats:
        places = np.where(np.isfinite(y), self.at_y(y), np.nan)
        return np.stack([self.at_x(x), places], axis=-1)


def ticks(low: float, high: float, count: int) -> tuple[list[float], list[str]]:
    """Ticks: about ``count`` round numbers from ``low`` to ``high``, and their texts."""
    spacing = max(high - low, 1e-9) / count
    scale = 10.0 ** np.floor(np.log10(spacing))
    step = float(scale * next(x for x in (1, 2, 5, 10) if x * scale >= 0.999 * spacing))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    values = [step * k for k in range(first, last + 1)]
    places = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return values, [f"{v + 0.0:.{places}f}" for v in values]


def log_ticks(low: float, high: float) -> tuple[list[float], list[str]]:
    """Ticks of a logarithmic axis at 1, 2 and 5 times powers of ten, and their texts."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    values = [digit * 10.0**power for power in powers for digit in (1.0, 2.0, 5.0)]
    values = [value for value in values if low * (1 - 1e-9) <= value <= high * (1 + 1e-9)]
    return values, [f"{value:.6g}" for value in values]


def limits(*arrays: ArrayLike, around: float = 0.06, least: float = 0.0) -> tuple[float, float]:
    """Ends of an axis that holds all finite values, of a least height, with air at either end."""
    flat = np.concatenate([np.ravel(np.asarray(array, float)) for array in arrays])
    flat = flat[np.isfinite(flat)]
    if flat.size == 0:
        return 0.0, max(least, 1.0)
    low, high = float(flat.min()), float(flat.max())
    missing = max(least - (high - low), 0.0) or (1.0 if high == low else 0.0)
    low, high = low - 0.5 * missing, high + 0.5 * missing
    return low - around * (high - low), high + around * (high - low)


def path(line: Floats) -> str:
    """Path data of a polyline ``(n, 2)``; it breaks where a point is not finite.

    Coordinates are rounded to a tenth and written relative to the point before, without drift.
    """
    tenths = np.round(line * 10.0)
    parts: list[str] = []
    before: tuple[int, int] | None = None
    for point in tenths:
        if not np.all(np.isfinite(point)):
            before = None
            continue
        x, y = int(point[0]), int(point[1])
        if before is None:
            parts.append(f"M{_tenth(x)} {_tenth(y)}")
        elif (x, y) != before:
            parts.append(_line(x - before[0], y - before[1]))
        before = x, y
    return "".join(parts)


def area(upper: Floats, lower: Floats) -> str:
    """Path data of the area between two polylines over the same x; empty where one has a gap."""
    if not (len(upper) and np.isfinite(upper).all() and np.isfinite(lower).all()):
        return ""
    return path(np.concatenate([upper, lower[::-1]])) + "z"


def _line(dx: int, dy: int) -> str:
    if dy == 0:
        return f"h{_tenth(dx)}"
    if dx == 0:
        return f"v{_tenth(dy)}"
    second = _tenth(dy)
    return f"l{_tenth(dx)}{second if second.startswith('-') else ' ' + second}"


def _tenth(value: int) -> str:
    """A number of tenths in the shortest decimal notation: 0.5 is ``.5``."""
    text = f"{value / 10:g}"
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text
