"""Geometry of the small multiples of the HTML report, and polylines as SVG.

A panel is one lung and PIP: pressure above, u_in below, on one time axis: the last scored breath
from its start to just after the target's fall. Lengths are in units of the panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.task import protocol
from ventbench.trajectories import Trajectories


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


#: Size of a panel, and its two plots: left, top, width, height.
WIDTH, HEIGHT = 184.0, 150.0
LEFT, TOP, PLOT_WIDTH, PRESSURE_HEIGHT = 25.0, 5.0, 156.0, 88.0
VALVE_TOP, VALVE_HEIGHT = 102.0, 34.0

#: Commands that are marked on the axis of u_in, %: the same in every panel.
VALVE_MARKS = (0.0, 50.0, protocol.U_MAX)

#: Times that are marked on the axis, s.
TIMES = (0.0, 0.5, 1.0, 1.5)

#: Steps of the breath that are shown: until 0.3 s after the target's fall.
SHOWN = round((protocol.FALL_END + 0.3) / protocol.DT)

#: The breath that is shown, counted from 0.
BREATH = max(protocol.SCORED_BREATHS)

#: Its steps in a run.
WINDOW = slice(BREATH * protocol.BREATH_STEPS, BREATH * protocol.BREATH_STEPS + SHOWN + 1)


@dataclass(frozen=True)
class RunPanel:
    """One lung and PIP, in panel units (y downwards)."""

    lung: str  #: id.
    pip: float  #: cmH2O.
    ticks: tuple[tuple[float, float], ...]  #: ticks of the pressure axis, value in cmH2O and y.
    target: Floats  #: polyline, shape ``(SHOWN + 1, 2)``.
    #: one polyline a run, shape ``(SHOWN + 1, 2)``; NaN where there is no finite pressure.
    pressures: tuple[Floats, ...]
    #: one polyline a run, u_in as a staircase, shape ``(2 * SHOWN + 1, 2)``.
    valves: tuple[Floats, ...]
    above: float | None  #: highest pressure of the first run if that is above the frame, cmH2O.


def panels(runs: Sequence[Trajectories]) -> list[list[RunPanel]]:
    """All panels, a row a lung; axes are the same down a column (one PIP)."""
    columns = [_column(runs, j) for j in range(len(runs[0].pips))]
    return [list(row) for row in zip(*columns, strict=True)]


def time_x(seconds: Floats | float) -> Floats:
    """Horizontal position of a time since the start of the breath, panel units."""
    return LEFT + np.asarray(seconds) / (SHOWN * protocol.DT) * PLOT_WIDTH


def inspiration(line: Floats) -> Floats:
    """Part of a pressure polyline that is scored."""
    return line[: protocol.INSPIRATION_STEPS]


def _column(runs: Sequence[Trajectories], j: int) -> list[RunPanel]:
    pip, window = runs[0].pips[j], WINDOW
    x = time_x(shown_times())
    low, high = pressure_limits(runs, j)

    def y(pressure: Floats | float) -> Floats:
        return TOP + (high - np.asarray(pressure)) / (high - low) * PRESSURE_HEIGHT

    def line(pressure: Floats) -> Floats:
        inside = np.clip(pressure, low - (high - low), high + (high - low))
        return np.stack([x, np.where(np.isfinite(pressure), y(inside), np.nan)], axis=-1)

    column = []
    for i, lung in enumerate(runs[0].lungs):
        pressures = [run.pressure[i, j, window] for run in runs]
        finite = pressures[0][np.isfinite(pressures[0])]
        highest = float(finite.max(initial=-np.inf))
        target = runs[0].target[i, j, window]
        marks = (float(target.min()), pip)
        column.append(
            RunPanel(
                lung=lung,
                pip=pip,
                ticks=tuple((value, float(y(value))) for value in marks),
                target=line(target),
                pressures=tuple(line(pressure) for pressure in pressures),
                valves=tuple(_stairs(x, run.u_in[i, j, window]) for run in runs),
                above=highest if highest > high else None,
            )
        )
    return column


def shown_times() -> Floats:
    """Times of the samples that are shown, s since the start of the breath, ``(SHOWN + 1,)``."""
    return np.arange(SHOWN + 1, dtype=np.float64) * protocol.DT


def pressure_limits(runs: Sequence[Trajectories], j: int) -> tuple[float, float]:
    """Pressure axis of a PIP: holds all runs, up to half the target's height beyond it."""
    target = runs[0].target[:, j, WINDOW]
    bottom, top = float(target.min()), float(target.max())
    height = max(top - bottom, 1.0)
    values = np.concatenate([run.pressure[:, j, WINDOW].ravel() for run in runs])
    values = values[np.isfinite(values)]
    high = min(float(values.max(initial=top)), top + 0.5 * height)
    low = max(float(values.min(initial=bottom)), bottom - 0.5 * height)
    return low - 0.08 * height, high + 0.08 * height


def valve_y(u_in: Floats | float) -> Floats:
    """Vertical position of a command, %, panel units."""
    return VALVE_TOP + (1.0 - np.asarray(u_in) / protocol.U_MAX) * VALVE_HEIGHT


def _stairs(x: Floats, u_in: Floats) -> Floats:
    """A command holds until the next step."""
    y = valve_y(np.where(np.isfinite(u_in), np.clip(u_in, 0.0, protocol.U_MAX), np.nan))
    return np.stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]], axis=-1)
