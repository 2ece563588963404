"""Driving the valves step by step, watched by the checks of a session."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hardware_eval import realtime
from hardware_eval.bench import safety
from hardware_eval.bench.loop import (
    Bench,
    EmergencyStop,
    answer_by,
    is_held_up,
    no_collection,
    sample_of,
)
from hardware_eval.wire.client import LinkError, NoAnswerError, RefusedError
from ventbench.base.arrays import Floats
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung

#: Chooses valves from the step and the pressure.
Commands = Callable[[int, float], tuple[float, int]]


@dataclass(frozen=True)
class Driven:
    """What came of driving the valves; arrays of shape ``(T,)``.

    Attributes:
        time, pressure, flow, u_in, u_out, late, busy: s, cmH2O, mL/s, %, 0/1, s, s; flow is NaN
            where it is not measured.
        trips: messages of the safety checks that tripped; the lung was vented then.
        held_up: whether host or line, too slow for the loop, ended it, and nothing else.
        missed: answers that did not come in time.
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


def drive(bench: Bench, lung: str, commands: Commands, steps: int, *, pip: float) -> Driven:
    """Drive the valves step by step, watched; the lung is vented before and after.

    Where the device did not answer a step in time, the pressure is that between its neighbours.

    Args:
        bench: device, clock, safety.
        lung: label, for the checks.
        commands: called with the step and the pressure, cmH2O.
        steps: how many.
        pip: highest pressure that is meant, cmH2O, for the checks.

    Raises:
        EmergencyStop: if the operator pressed the key.
        LinkError: if the device is lost.
    """
    client, clock = bench.client, bench.clock
    rows: list[tuple[float, ...]] = []
    watched = safety.init(parse_lung(lung))
    last: tuple[float, int] = (0.0, 1)
    trips: tuple[str, ...] = ()
    held_up, missed = False, 0
    with contextlib.ExitStack() as stack:
        stack.callback(_vent, bench)
        client.vent()
        clock.sleep_until(clock.now() + bench.rest)
        stack.enter_context(no_collection())
        stack.enter_context(realtime.priority())
        start = clock.now() + protocol.DT
        try:
            client.arm()
        except RefusedError as error:
            trips, steps = (f"the device cannot be armed: {error}",), 0
        for step in range(steps):
            deadline = start + step * protocol.DT
            clock.sleep_until(deadline)
            began = clock.now()
            if bench.operator.stop():
                raise EmergencyStop
            reading, late = None, began - deadline
            with contextlib.suppress(NoAnswerError):
                reading = client.heartbeat()
            missed += reading is None
            sample = sample_of(reading, began, last, pip, late)
            pressure = sample.pressure
            watched = safety.step(bench.settings, watched, sample)
            if watched.trips:
                trips = tuple(trip.message for trip in watched.trips)
                held_up = all(trip.check in safety.TIMING_CHECKS for trip in watched.trips)
                break
            wanted, u_out = commands(step, pressure) if math.isfinite(pressure) else last
            u_in, _ = safety.limit_command(bench.settings, last[0], wanted)
            try:
                client.command(u_in, u_out, answer_by(deadline, clock.now()))
            except RefusedError as error:
                trips, held_up = (str(error),), is_held_up(error.refusal.flags)
                break
            except NoAnswerError:
                missed += 1
            last = (u_in, u_out)
            busy = clock.now() - began
            flow, answered = sample.flow, sample.answered
            rows.append((began - start, pressure, flow, *last, late, busy, answered))
    columns = np.array(rows, float).reshape(-1, 8).T
    time, heard = columns[0], columns[7] > 0.0
    if heard.any():
        for column in columns[1:3]:
            column[~heard] = np.interp(time[~heard], time[heard], column[heard])
    return Driven(*columns[:7], trips, held_up, missed)  # type: ignore[arg-type]


def _vent(bench: Bench) -> None:
    with contextlib.suppress(LinkError):  # then the watchdog does
        bench.client.vent()
