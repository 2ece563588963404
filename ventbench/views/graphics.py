"""Polylines as SVG path data."""

from __future__ import annotations

import numpy as np

from ventbench.views.runs import Floats


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
