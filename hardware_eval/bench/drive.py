"""Driving the valves step by step, watched by the checks of a session: for tests, and to explore.

The exploration is the paper's (section 4.2 and table), which makes training recordings: targeted,
by safe PIDs, with the ranges and limits of :mod:`ventbench.train.exploration`. Each of its breaths
starts from a lung at rest, as those of a simulator do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.controllers import PIController
from hardware_eval.bench.loop import (
    Bench,
    EmergencyStop,
    Watched,
    shown,
    undisturbed,
)
from hardware_eval.bench.plan import PlannedRun
from hardware_eval.bench.raw_log import LOG, RawLog, lines, write_recording
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics.measured import worst
from ventbench.task.metrics.score import time_above
from ventbench.train.exploration import RANGES, explore

#: Chooses valves from the step and the pressure; begins anew at step 0.
Commands = Callable[[int, float], tuple[float, int]]


@dataclass(frozen=True)
class Program:
    """What drives the valves for a while: to measure something, or to look at it."""

    commands: Commands  #: chooses the valves.
    steps: int  #: how many.
    pip: float  #: highest pressure that is meant, cmH2O, for the checks.


def in_turn(pip: float, *turns: tuple[int, float, int]) -> Program:
    """Hold valves in turn, each for some steps: these, u_in, %, and u_out."""
    order = [valves for steps, *valves in turns for _ in range(steps)]

    def commands(step: int, pressure: float) -> tuple[float, int]:
        u_in, u_out = order[min(step, len(order) - 1)]
        return u_in, int(u_out)

    return Program(commands, len(order), pip)


def towards(targets: Sequence[float], P: float, I: float, u_out: int) -> Commands:  # noqa: E741
    """The protocol's PI towards a target a step, cmH2O; then the valve closed, with ``u_out``."""
    controller = PIController((P, I))

    def commands(step: int, pressure: float) -> tuple[float, int]:
        if step >= len(targets):
            return 0.0, u_out
        row = np.array([[step * protocol.DT, protocol.DT, pressure, targets[step]]])
        return max(controller.act(row, 0.0), 0.0), 0

    return commands


#: Rest before a breath that explores in time constants of the labelled lung with its expiratory
#: valve, and its limits, s.
_TIME_CONSTANTS, _REST = 4.0, (0.5, 6.0)

#: Resistance of that valve, cmH2O/(L/s).
_OUTLET = 5.0

#: Breaths in a row that a check stopped, after which nobody is left to trust.
_STOPPED = 3


@dataclass(frozen=True)
class Driven:
    """What came of driving the valves; arrays of shape ``(T,)``.

    Attributes:
        time, pressure, flow, u_in, u_out, late, busy: s, cmH2O, mL/s, %, 0/1, s, s; flow is NaN
            where it is not measured.
        trips, missed: see :class:`~hardware_eval.bench.loop.Watched`.
        held_up: see :class:`~hardware_eval.bench.loop.Ended`.
    """

    time: Floats
    pressure: Floats
    flow: Floats
    u_in: Floats
    u_out: Floats
    late: Floats
    busy: Floats
    trips: tuple[str, ...]
    held_up: bool
    missed: int


def drive(bench: Bench, lung: str, program: Program) -> Driven:
    """Drive the valves by a program, watched; the lung is vented before and after.

    Where the device did not answer a step in time, the pressure is that between its neighbours.

    Args:
        bench: device, clock, safety, operator.
        lung: label, for the checks.
        program: what to do.

    Raises:
        EmergencyStop: if the operator pressed the key.
        LinkError: if the device is lost.
    """
    watched = Watched(bench, lung, program.pip)
    try:
        with undisturbed():
            watched.begin()
            for step in range(program.steps):
                if watched.ended:
                    break
                pressure = shown(watched.look(program.pip))
                known = math.isfinite(pressure)
                chosen = program.commands(step, pressure) if known else watched.last
                watched.send_limited(*chosen)
    finally:
        watched.vent()
    log = watched.log
    whole = slice(len(log.u_in))
    names = ("time", "pressure", "flow", "u_in", "u_out", "late", "busy")
    columns = {name: np.array(getattr(log, name)[whole], float) for name in names}
    time, heard = columns["time"], np.array(watched.answered[whole], bool)
    if heard.any():
        for name in ("pressure", "flow"):
            columns[name][~heard] = np.interp(time[~heard], time[heard], columns[name][heard])
    held_up = watched.ended is not None and watched.ended.held_up
    return Driven(**columns, trips=watched.trips, held_up=held_up, missed=watched.missed)


class BenchVentilator(Watched):
    """A device as the exploration drives it; see ``VentilatorInterface`` there.

    After a check has tripped, or the device has vented, it gives no pressures until the next start.
    What explores opens the valve again as soon as the pressure is below the limit, but the safety
    gate counts a breath's samples in all, and a late valve shows a command for two or three. So the
    first one above halves what the valve may open from then on, and the second closes it.
    """

    width = 1
    dt = protocol.DT

    def start(self, peep: float) -> Floats:
        """Vent until the lung is at rest, then begin a breath."""
        self.begin()
        return np.full(1, shown(self.look(self.pip)))

    def step(self, u_in: Floats, u_out: Floats) -> Floats:
        """Hold a command until the next step's deadline."""
        above = float(time_above(worst(self._safety.breath), self.pip, protocol.DT)) / protocol.DT
        halved = 0.5 * max(self.log.u_in, default=0.0)
        largest = (protocol.U_MAX, halved, 0.0)[min(round(above), 2)]
        self.send_limited(min(float(u_in[0]), largest), int(u_out[0]))
        return np.full(1, shown(self.look(self.pip)))


def collect(
    bench: Bench,
    lung: str,
    count: int,
    out: Path,
    *,
    seed: int = 0,
    ease: float = protocol.SAFETY_PRESSURE,
    about: dict[str, Any] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Breaths, str]:
    """Explore a lung at all PIPs in turn; a folder with breaths of the same seed is continued.

    Args:
        bench: device, clock, safety, operator.
        lung: label of the mounted lung.
        count: breaths in all.
        out: folder of the log and the recording.
        seed: of the disturbances.
        ease: pressure above which the valve closes, cmH2O.
        about: device, operator and notes for the log.
        progress: called with the number of finished breaths.

    Returns:
        All whole breaths of the folder, also of earlier sessions, as its recording holds them; and
        why it ended early, empty if it did not.

    Raises:
        InputError: if there are no ranges for the lung, or the folder is of another collection.
        LinkError: if the device is lost; what is done is kept.
    """
    if lung not in RANGES:
        raise InputError(f"no ranges to explore {lung} in; they exist for {', '.join(RANGES)}")
    if count < 1:
        raise InputError(f"{count} breaths to collect: ask for one at least")
    plan = {"lung": lung, "seed": seed, "pips": list(protocol.PIPS)}
    label, stopped, spoilt = parse_lung(lung), "", 0
    rest = float(np.clip(_TIME_CONSTANTS * 1e-3 * label.C * (label.R + _OUTLET), *_REST))
    ventilator = BenchVentilator(replace(bench, rest=rest), lung, max(protocol.PIPS))
    with RawLog(out / LOG) as log:
        logged = lines(log.path)
        done = {line["repeat"] for line in logged if line["type"] == "breath"}
        for line in logged:
            if line["type"] == "collection" and line["plan"] != plan:
                raise InputError(f"{log.path} is of {line['plan']}; choose another --out")
        log.append(
            {
                "type": "collection",
                "plan": plan,
                "safety": bench.settings.as_dict(),
                **(about or {}),
            }
        )
        try:
            for number in range(1, count + 1):
                if number in done:
                    continue
                pip = protocol.PIPS[(number - 1) % len(protocol.PIPS)]
                ventilator.pip = pip
                # A breath at a time, each with a seed of its own: a restart repeats none.
                own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
                with undisturbed():
                    explore(ventilator, lung, 1, seed=own, ease=ease, pips=(pip,))
                run = PlannedRun(number, "explore", "exploration", lung, pip, number)
                line = ventilator.log.line(run, 0, 0)
                log.append({**line, "whole": not ventilator.trips})
                spoilt = spoilt + 1 if ventilator.trips else 0
                progress(number)
                if ventilator.trips:
                    bench.operator.tell(f"breath {number} stopped: {ventilator.trips[0]}")
                if spoilt >= _STOPPED:
                    stopped = ventilator.trips[0]
                    break
        except EmergencyStop:
            stopped = "the operator pressed the emergency stop"
        finally:
            ventilator.vent()
    return write_recording(out, ("explore",)), stopped
