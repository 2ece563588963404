"""Do draws differ as much as real rigs do? The table of docs/protocol.md.

Standard deviations between the scored rigs of one lung, pooled over the lungs, beside those over
the 20 development draws of one lung: of the deviation alone, and of all that a draw changes, which
is rig, member of the ensemble and deviation.

Usage:

    python benchmarks/rig_spread.py
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.plants import frozen
from ventbench.plants.hybrid import VALVE_KNOTS
from ventbench.plants.rigs import rigs_of
from ventbench.task import draws, protocol
from ventbench.train.rigs.label_test import resistance_and_compliance

#: Command at which valves are compared, %.
COMMAND = 20.0


def valve_flow(slopes: Floats) -> Floats:
    """Flow of valves at :data:`COMMAND`, L/s; shape without the last axis."""
    knots = np.asarray(VALVE_KNOTS)
    return slopes @ np.clip(COMMAND - knots, 0.0, np.append(np.diff(knots), np.inf))


def pooled(groups: Sequence[Floats]) -> float:
    """Standard deviation within groups."""
    squares = sum(float(np.sum((own - own.mean()) ** 2)) for own in groups)
    return float(np.sqrt(squares / sum(own.size - 1 for own in groups)))


def main() -> None:
    official = frozen.load()
    members: Any = official.members
    drawn = rigs_of(official).draws(draws.COUNT)
    resistance, compliance = resistance_and_compliance(members)
    interval = np.array([session.interval_ms for session in official.sessions.table])
    dead = 1e3 * (np.asarray(members.valve_delay) + np.asarray(members.valve_lag))
    ones = np.ones(drawn.cells.r_scale.shape)
    cells = drawn.cells
    # Of each quantity: members and sessions, its deviation in the draws, whether it is a ratio.
    quantities = {
        "resistance at 0.5 L/s": (resistance, np.asarray(cells.r_scale), True),
        "compliance": (compliance, np.asarray(cells.c_scale), True),
        f"flow of the valve at {COMMAND:g} %": (
            valve_flow(np.asarray(members.slopes, float)),
            ones,
            True,
        ),
        "control interval": (
            np.broadcast_to(interval, resistance.shape),
            np.asarray(cells.dt) / protocol.DT,
            True,
        ),
        "dead time and lag of the valve, ms": (
            dead,
            1e3 * protocol.DT * np.asarray(cells.delay),
            False,
        ),
    }
    print(
        "| standard deviation | between fitted rigs of a lung | deviations drawn | all of a draw |"
    )
    print("|---" * 4 + "|")
    for name, (values, deviation, ratio) in quantities.items():
        if ratio:
            values, deviation = np.log(values), np.log(deviation)
        rigs = pooled([values[0, list(own)] for own in official.rigs])
        lungs = range(len(official.rigs))
        alone = pooled([deviation[k] for k in lungs])
        whole = values if name != "control interval" else np.zeros_like(values)
        both = pooled([whole[drawn.member[k], drawn.rig[k]][:, None] + deviation[k] for k in lungs])
        shown = (f"{100 * x:.1f} %" if ratio else f"{x:.1f}" for x in (rigs, alone, both))
        print(f"| {name} | {' | '.join(shown)} |")


if __name__ == "__main__":
    main()
