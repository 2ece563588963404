"""The 6 x 6 small multiples of an entry page: whole numbers and short paths, since there are many.

A panel is the nominal inspiration of the last scored breath on one lung at one PIP: pressure above,
u_in below. Axes depend on the PIP alone, so that panels of all entries can be laid side by side.
Lengths are in units of the panel, y downwards.
"""

from __future__ import annotations

import functools

import numpy as np

from ventbench import protocol
from ventbench.board.record import Floats, Record

#: Size of a panel, left of its plots, units from one step to the next.
WIDTH, HEIGHT = 690, 600
LEFT, STEP = 70, 18

#: Top and height of the two plots.
TOP, PRESSURE_HEIGHT = 14, 350
VALVE_TOP, VALVE_HEIGHT = 400, 140

RIGHT = LEFT + STEP * protocol.INSPIRATION_STEPS
VALVE_BOTTOM = VALVE_TOP + VALVE_HEIGHT


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
        own: of :func:`paths`.
        pid: likewise; None for none.
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
