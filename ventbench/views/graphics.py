"""Colours for dark and light ground and for colour-blind eyes; polylines as SVG path data."""

from __future__ import annotations

import numpy as np

from ventbench.views.runs import Floats

#: One colour a PIP, lowest first: cool to warm, distinct in hue and lightness.
PIP_COLORS = ("#6f83de", "#2b97d1", "#12a096", "#7f9f2d", "#c98a0c", "#e2603c")

#: Target pressure, and runs to compare with, in the rerun viewer (dark or light ground).
TARGET_COLOR = "#8f8f8f"
REFERENCE_COLORS = ("#d277b8", "#b58a5a", "#8fb6c9", "#c9b84f")

#: Mark of the scored part of a run.
SCORED_COLOR = "#12a073"

#: Runs on white: the entry blue, its first reference (PID) grey, then others.
RUN_COLORS = ("#0065b3", "#808080", "#c4570a", "#00795c", "#a1467e", "#8a6d00")

#: The same runs on dark ground.
RUN_COLORS_DARK = ("#5cb8ff", "#9d9d9d", "#ff9a52", "#3fc7a0", "#e58fc3", "#e0c04a")


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0..255, of ``#rrggbb``."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def pip_color(index: int) -> str:
    """Colour of the PIP with this index; they repeat after six."""
    return PIP_COLORS[index % len(PIP_COLORS)]


def run_index(index: int) -> int:
    """Index into :data:`RUN_COLORS` of a run; the entry's blue and the grey are never repeated."""
    return index if index < len(RUN_COLORS) else 2 + (index - 2) % (len(RUN_COLORS) - 2)


def path(line: Floats) -> str:
    """Path data of a polyline; it breaks where a point is not finite.

    Coordinates are rounded to a tenth and written relative to the point before, without drift.

    Args:
        line: points, shape ``(n, 2)``.
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
