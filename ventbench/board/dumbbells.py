"""Each draw's score beside the PID's on the same draw, as one small plot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.board.record import Record
from ventbench.text import number

#: Width of the drawing, left and width of its axis, height of a row.
WIDTH, LEFT, AXIS, ROW = 640, 40, 580, 14


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
    places = LEFT + AXIS * (both - low) / max(high - low, 1e-9)
    rows = enumerate(places.T.round(1).tolist(), 1)
    return Dumbbells(
        drawing="".join(_row(draw, own, other) for draw, (own, other) in rows),
        height=ROW * both.shape[1] + 30,
        low=number(low),
        high=number(high),
        better=int(np.sum(both[0] < both[1])),
        count=both.shape[1],
    )


def _row(draw: int, own: float, other: float) -> str:
    y = ROW * draw - 3
    return (
        f'<text x="{LEFT - 14}" y="{y + 4}">{draw}</text><path d="M{other} {y}H{own}"/>'
        f'<circle class="pid" cx="{other}" cy="{y}" r="3.5"/>'
        f'<circle class="own" cx="{own}" cy="{y}" r="4.5"/>'
    )
