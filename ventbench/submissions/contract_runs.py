"""What the contract shows a controller: plain runs, repetitions, and unusual inputs."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np

from ventbench import protocol
from ventbench.interfaces import Task
from ventbench.lungs import LUNG_IDS
from ventbench.submissions.cell import ROW
from ventbench.submissions.contract_driver import RENEW, RESET

#: Yields observations, receives commands in %.
Script = Generator[list[float], float, None]

#: Breaths and steps of one plain run.
BREATHS = 2
STEPS = BREATHS * protocol.INSPIRATION_STEPS

_PIP = 25.0  # cmH2O
_FULL, _TIME_CONSTANT = 60.0, 0.2  # of the stand-in for a lung, cmH2O at 100 % and s


class Run(NamedTuple):
    """One cell.

    Attributes:
        task: what the controller is told.
        script: what it is shown.
        unusual: what is unusual about it, for a sentence; empty if nothing is.
    """

    task: Task
    script: Script
    unusual: str = ""


def plain(tracks: Sequence[str]) -> list[Run]:
    """A run for each lung on the performance track, and for the unnamed one on the other.

    Args:
        tracks: that the submission enters.
    """
    runs = []
    for track in tracks:
        lungs = LUNG_IDS if track == "performance" else (None,)
        runs += [Run(task(track, lung), breaths()) for lung in lungs]
    return runs


def repeated(told: Task) -> list[Run]:
    """Return the plain run in another process; thrice in one, reset, then renewed between."""
    return [Run(told, breaths()), Run(told, _thrice())]


def unusual(told: Task) -> list[Run]:
    """Short runs with inputs at and beyond the edge of what a bench gives."""
    random = np.random.default_rng(0)
    steps = protocol.INSPIRATION_STEPS
    wild = random.uniform(-20.0, 80.0, steps)
    uneven = random.uniform(0.005, 0.1, steps)
    inputs = {
        "a control step of 10 ms": _played(dt=0.01),
        "a control step of 60 ms": _played(dt=0.06),
        "uneven control steps": _played(dt=uneven),
        "a pressure of -20 cmH2O": _played(pressure=-20.0),
        "a pressure of 120 cmH2O": _played(pressure=120.0),
        "a very noisy pressure": _played(pressure=wild),
        "a pressure and a target of 0 cmH2O": _played(pressure=0.0, target=0.0),
        "a target of 60 cmH2O": _played(target=60.0),
    }
    return [Run(told, script, f"with {what}") for what, script in inputs.items()]


def task(track: str, lung: str | None) -> Task:
    """What a controller is told of a run."""
    return Task(track, lung, protocol.DT, protocol.INSPIRATION_STEPS)


def breaths() -> Script:
    """Two breaths on a stand-in for a lung: pressure follows the valve with one time constant."""
    for _ in range(BREATHS):
        pressure, command = protocol.PEEP, 5.0
        for step in range(protocol.INSPIRATION_STEPS):
            time = step * protocol.DT
            answer = yield _row(time, protocol.DT, pressure, _target(time), command)
            command = min(max(answer, 0.0), protocol.U_MAX)
            rest = protocol.PEEP + _FULL * command / protocol.U_MAX
            pressure += (rest - pressure) * protocol.DT / _TIME_CONSTANT


def _thrice() -> Script:
    yield from breaths()
    for moment in (RESET, RENEW):
        yield _row(moment, protocol.DT, protocol.PEEP, _PIP, 5.0)
        yield from breaths()


def _played(
    dt: float | np.ndarray = protocol.DT,
    pressure: float | np.ndarray = 20.0,
    target: float = _PIP,
) -> Script:
    steps = protocol.INSPIRATION_STEPS
    widths = np.broadcast_to(dt, steps)
    times, pressures = np.cumsum(widths) - widths, np.broadcast_to(pressure, steps)
    command = 5.0
    columns = (times.tolist(), widths.tolist(), pressures.tolist())
    for time, width, measured in zip(*columns, strict=True):
        answer = yield _row(time, width, measured, target, command)
        command = min(max(answer, 0.0), protocol.U_MAX)


def _target(time: float, pip: float = _PIP) -> float:
    falls = (protocol.FALL_START, protocol.FALL_END)
    return float(np.interp(time, falls, (pip, protocol.PEEP)))


def _row(time: float, dt: float, pressure: float, target: float, command: float) -> list[float]:
    ahead = [_target(time + k * dt, target) for k in range(1, protocol.TARGETS_AHEAD + 1)]
    row = [time, dt, pressure, target, *ahead, command]
    assert len(row) == ROW
    return row
