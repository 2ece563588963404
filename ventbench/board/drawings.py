"""What pages draw: intervals, draws, maps, profiles and traces, as SVG of numbers only.

Traces are 6 x 6 small multiples in whole numbers and short paths, since there are many. A panel is
the nominal inspiration of the last scored breath on one lung at one PIP: pressure above, u_in
below. Axes depend on the PIP alone, so that panels of all entries can be laid side by side. Lengths
are in units of the panel, y downwards.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.text import number
from ventbench.board import comparison, pages
from ventbench.board.ranking import Row
from ventbench.board.record import Record
from ventbench.task import protocol

#: Size of the small plot of an interval; the entry's dot never touches its edge.
INTERVAL_WIDTH, MARGIN = 120, 6

#: Plot of the draws: left and width of its axis, height of a row.
PLOT_LEFT, PLOT_AXIS, PLOT_ROW = 40, 580, 14

#: Limits between the shades of maps, cmH2O and points of the normalised score: the same for all
#: entries, so that maps can be compared.
ERROR_LIMITS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)
NORMALISED_LIMITS = (5.0, 15.0, 30.0, 50.0, 75.0, 100.0, 150.0, 250.0)
DIFFERENCE_LIMITS = (0.02, 0.2, 0.7, 2.0)

#: Size of a panel, left of its plots, units from one step to the next.
WIDTH, HEIGHT = 690, 600
LEFT, STEP = 70, 18

#: Top and height of the two plots.
TOP, PRESSURE_HEIGHT = 14, 350
VALVE_TOP, VALVE_HEIGHT = 400, 140

RIGHT = LEFT + STEP * protocol.INSPIRATION_STEPS
VALVE_BOTTOM = VALVE_TOP + VALVE_HEIGHT


def interval(row: Row, low: float, high: float) -> dict[str, str] | None:
    """Positions of a score and its interval on an axis that all rows of a track share."""
    if row.normalised is None:
        return None
    score = row.normalised.score
    # A logarithm, so that one bad entry does not press all others together.
    span = math.log(high / low) if high > low > 0.0 else 0.0

    def x(value: float) -> float:
        share = math.log(max(value, low) / low) / span if span else 0.5
        return MARGIN + (INTERVAL_WIDTH - 2 * MARGIN) * share

    left, dot, right = (x(v) for v in (score.low, score.value, score.high))
    return {"x": f"{left:.1f}", "width": f"{max(right - left, 1.0):.1f}", "dot": f"{dot:.1f}"}


@dataclass(frozen=True)
class Dumbbells:
    """The plot and what it says.

    Attributes:
        drawing: SVG elements, numbers only.
        height: of the drawing.
        low: text of the lower end of the axis.
        high: of the upper.
        better: on how many draws the entry is better.
        count: how many draws there are.
    """

    drawing: str
    height: int
    low: str
    high: str
    better: int
    count: int


def dumbbells(record: Record, pid: Record | None) -> Dumbbells | None:
    """Draw them; None where a draw failed or there is no PID to compare with."""
    if pid is None or not np.isfinite(record.by_draw).all():
        return None
    both = np.stack([record.by_draw, pid.by_draw])
    low, high = float(both.min()), float(both.max())
    places = PLOT_LEFT + PLOT_AXIS * (both - low) / max(high - low, 1e-9)
    rows = enumerate(places.T.round(1).tolist(), 1)
    return Dumbbells(
        drawing="".join(_row(draw, own, other) for draw, (own, other) in rows),
        height=PLOT_ROW * both.shape[1] + 30,
        low=number(low),
        high=number(high),
        better=int(np.sum(both[0] < both[1])),
        count=both.shape[1],
    )


def _row(draw: int, own: float, other: float) -> str:
    y = PLOT_ROW * draw - 3
    return (
        f'<text x="{PLOT_LEFT - 14}" y="{y + 4}">{draw}</text><path d="M{other} {y}H{own}"/>'
        f'<circle class="pid" cx="{other}" cy="{y}" r="3.5"/>'
        f'<circle class="own" cx="{own}" cy="{y}" r="4.5"/>'
    )


def heat_map(
    values: Floats, record: Record, limits: tuple[float, ...], digits: int = 2
) -> list[dict[str, Any]]:
    """Rows of a map of means over draws; the nominal value beside each.

    Args:
        values: nominal runs first, shape ``(1 + K, L, P)``.
        record: whose they are.
        limits: between the shades.
        digits: that are shown.
    """
    means = values[1:].mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [
                {
                    "text": number(value, digits),
                    "small": number(nominal, digits),
                    "shade": f"h{np.searchsorted(limits, value)}" if np.isfinite(value) else "hx",
                }
                for value, nominal in zip(means[i], values[0, i], strict=True)
            ],
            "mean": number(float(means[i].mean()), digits),
        }
        for i, lung in enumerate(record.lungs)
    ]


def difference_map(record: Record, other: Record) -> list[dict[str, Any]]:
    """Rows of the map of differences to another record, mean over draws; below zero is better."""
    cells = record.drawn.mean(axis=0) - other.drawn.mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [
                {"text": pages.signed(value, 2), "shade": _difference_shade(value)}
                for value in cells[i]
            ],
            "mean": pages.signed(float(cells[i].mean()), 2),
        }
        for i, lung in enumerate(record.lungs)
    ]


def _difference_shade(value: float) -> str:
    if not np.isfinite(value):
        return "hx"
    level = int(np.searchsorted(DIFFERENCE_LIMITS, abs(value)))
    return f"{'b' if value < 0 else 'w'}{level}" if level else "h0"


def _limits(pip: float) -> tuple[float, float]:
    """Pressure axis of a PIP, cmH2O: a little below PEEP, and room for an overshoot of 60 %."""
    height = pip - protocol.PEEP
    return protocol.PEEP - 0.12 * height, pip + 0.6 * height


def _y(pressure: Floats | float, pip: float) -> Floats:
    low, high = _limits(pip)
    share = (high - np.asarray(pressure)) / (high - low)
    return TOP + PRESSURE_HEIGHT * np.clip(share, 0.0, 1.0)


@functools.cache
def frame(pip: float) -> str:
    """What all panels of a PIP share, as SVG: target, ticks, time axis."""
    end = LEFT + round(1.0 / protocol.DT * STEP)
    ticks = [(value, round(float(_y(value, pip)))) for value in (protocol.PEEP, pip)]
    rules = [VALVE_TOP, VALVE_BOTTOM, *(y for _, y in ticks)]
    lines = "".join(f"M{LEFT} {y}H{RIGHT}" for y in rules)
    times = (("0", LEFT), ("0.5", (LEFT + end) // 2), ("1 s", end))
    return "".join(
        [
            f'<path class="t" d="M{LEFT} {round(float(_y(pip, pip)))}H{RIGHT - STEP}"/>',
            f'<path class="rule" d="{lines}"/>',
            *(f'<text class="y" x="{LEFT - 10}" y="{y + 9}">{v:g}</text>' for v, y in ticks),
            *(f'<text class="x" x="{x}" y="{HEIGHT - 18}">{text}</text>' for text, x in times),
        ]
    )


def panels(
    own: list[list[tuple[str, str]]], pid: list[list[tuple[str, str]]] | None
) -> list[list[str]]:
    """What is drawn in each panel, as SVG of numbers only; a template would take ten times as long.

    Args:
        own: paths of the entry, from :func:`paths`.
        pid: paths of the PID; None to draw none.
    """
    return [
        [
            (
                f'<path class="p pid" d="{pid[i][j][0]}"/><path class="u pid" d="{pid[i][j][1]}"/>'
                if pid
                else ""
            )
            + f'<path class="p own" d="{pressure}"/><path class="u own" d="{valve}"/>'
            for j, (pressure, valve) in enumerate(row)
        ]
        for i, row in enumerate(own)
    ]


def paths(record: Record) -> list[list[tuple[str, str]]]:
    """Paths of pressure and command of each lung and PIP."""
    valves = np.rint(VALVE_BOTTOM - VALVE_HEIGHT * record.u_in / protocol.U_MAX).astype(int)
    columns = []
    for j, pip in enumerate(record.pips):
        heights = np.rint(_y(record.pressure[:, j], pip)).astype(int)
        moves = np.diff(heights, axis=-1)
        rows = zip(heights[:, 0].tolist(), moves.tolist(), valves[:, j].tolist(), strict=True)
        columns.append([(_line(first, rest), _stairs(valve)) for first, rest, valve in rows])
    return [list(row) for row in zip(*columns, strict=True)]


def _line(first: int, moves: list[int]) -> str:
    """Path through points one step apart, relative to each other."""
    return f"m{LEFT} {first}" + "".join([f" {STEP} {move}" for move in moves])


def _stairs(heights: list[int]) -> str:
    """A command holds until the next step; equal ones are joined."""
    parts, before, run = [f"M{LEFT} {heights[0]}"], heights[0], 0
    for height in heights:
        if height != before:
            parts.append(f"h{run}V{height}")
            before, run = height, 0
        run += STEP
    return "".join([*parts, f"h{run}"])


def profile(record: Record) -> dict[str, str] | None:
    """Performance profile of an entry: a path in a box of 200 by 40, and the share below 100."""
    cells = record.headroom.normalised[1:][record.headroom.ranked]
    if not np.isfinite(cells).all():
        return None
    shares = comparison.profile(cells)
    points = zip(comparison.THRESHOLDS.tolist(), (40.0 * (1.0 - shares)).tolist(), strict=True)
    path = "M" + "L".join(f"{x:g} {y:.1f}" for x, y in points)
    below = float(shares[comparison.THRESHOLDS.tolist().index(100.0)])
    return {"path": path, "below": f"{100 * below:.0f}"}
