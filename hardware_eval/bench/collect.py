"""Training recordings from a bench: the paper's targeted exploration with safe PIDs.

The exploration is that of :mod:`ventbench.train.exploration`, breath by breath, with its ranges
(paper, section 4.2 and table) and its limits; here it drives a device, watched by the same checks
as a session. Each breath starts from a lung at rest, as those of a simulator do.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval import realtime
from hardware_eval.bench import safety
from hardware_eval.bench.loop import Bench, BreathLog, EmergencyStop, answer_by, sample_of
from hardware_eval.bench.plan import PlannedRun
from hardware_eval.bench.raw_log import LOG, RECORDING, RawLog, lines, recording
from hardware_eval.wire.client import LinkError, NoAnswerError, RefusedError
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths, write
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.train.exploration import RANGES, explore

#: Rest before a breath in time constants of the labelled lung with its expiratory valve, and its
#: limits, s.
_TIME_CONSTANTS, _REST = 4.0, (0.5, 6.0)

#: Resistance of that valve, cmH2O/(L/s).
_OUTLET = 5.0

#: Breaths in a row that a check stopped, after which nobody is left to trust.
_STOPPED = 3


@dataclass(frozen=True)
class Collection:
    """What was collected."""

    breaths: Breaths  #: all whole breaths of the folder, also of earlier sessions.
    recording: Path  #: their file in the public schema.
    stopped: str  #: why it ended early; empty if it did not.


class BenchVentilator:
    """A device as the exploration drives it; see ``VentilatorInterface`` there.

    After a check has tripped, or the device has vented, it gives no pressures until the next start.

    Args:
        bench: device, clock, safety, operator.
        lung: label, for the checks.
    """

    width = 1
    dt = protocol.DT

    def __init__(self, bench: Bench, lung: str) -> None:
        self._bench, self._lung = bench, parse_lung(lung)
        tau = 1e-3 * self._lung.C * (self._lung.R + _OUTLET)
        self.rest = float(np.clip(_TIME_CONSTANTS * tau, *_REST))
        self.pip = max(protocol.PIPS)
        self.stopped = ""
        self.log = BreathLog()
        self._safety = safety.init(self._lung)
        self._start = self._deadline = 0.0
        self._last = (0.0, 1)

    def start(self, peep: float) -> Floats:
        """Vent until the lung is at rest, then begin a breath."""
        client, clock = self._bench.client, self._bench.clock
        client.vent()
        gc.collect()
        clock.sleep_until(clock.now() + self.rest)
        self._start = self._deadline = clock.now() + protocol.DT
        client.arm()
        self._safety, self._last = safety.init(self._lung), (0.0, 1)
        self.stopped, self.log = "", BreathLog()
        return self._look()

    def step(self, u_in: Floats, u_out: Floats) -> Floats:
        """Hold a command until the next step's deadline."""
        command = (float(u_in[0]), int(u_out[0]))
        log = self.log
        log.requested.append(command[0])
        log.u_in.append(command[0])
        log.u_out.append(command[1])
        log.busy.append(0.0)
        if not self.stopped:
            try:
                self._bench.client.command(
                    *command, answer_by(self._deadline, self._bench.clock.now())
                )
                self._last = command
            except RefusedError as error:
                self.stopped = str(error)
            except NoAnswerError:
                pass
        self._deadline += protocol.DT
        return self._look()

    def _look(self) -> Floats:
        bench, log = self._bench, self.log
        bench.clock.sleep_until(self._deadline)
        if bench.operator.stop():
            bench.client.vent()
            raise EmergencyStop
        if self.stopped:
            return np.full(1, np.nan)
        began = bench.clock.now()
        reading = None
        with contextlib.suppress(NoAnswerError):
            reading = bench.client.heartbeat()
        sample = sample_of(reading, began, self._last, self.pip, max(began - self._deadline, 0.0))
        log.time.append(began - self._start)
        log.pressure.append(sample.pressure)
        log.flow.append(sample.flow)
        log.target.append(self.pip)
        log.late.append(sample.late)
        self._safety = safety.step(bench.settings, self._safety, sample)
        if self._safety.trips:
            bench.client.vent()
            self.stopped = self._safety.trips[0].message
        return np.full(1, sample.pressure)


def collect(
    bench: Bench, lung: str, count: int, out: Path, *, seed: int = 0,
    ease: float = protocol.SAFETY_PRESSURE, about: dict[str, Any] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Collection:  # fmt: skip
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

    Raises:
        InputError: if there are no ranges for the lung, or the folder is of another collection.
        LinkError: if the device is lost; what is done is kept.
    """
    if lung not in RANGES:
        raise InputError(f"no ranges to explore {lung} in; they exist for {', '.join(RANGES)}")
    if count < 1:
        raise InputError(f"{count} breaths to collect: ask for one at least")
    plan = {"lung": lung, "seed": seed, "pips": list(protocol.PIPS)}
    ventilator, stopped, spoilt = BenchVentilator(bench, lung), "", 0
    with RawLog(out / LOG) as log:
        logged = list(lines(log.path))
        done = {line["repeat"] for line in logged if line["type"] == "breath"}
        for line in logged:
            if line["type"] == "collection" and line["plan"] != plan:
                raise InputError(f"{log.path} is of {line['plan']}; choose another --out")
        safe = bench.settings.as_dict()
        log.append({"type": "collection", "plan": plan, "safety": safe, **(about or {})})
        gc.disable()  # in a breath; collected at the rest before each
        try:
            for number in range(1, count + 1):
                if number in done:
                    continue
                pip = protocol.PIPS[(number - 1) % len(protocol.PIPS)]
                ventilator.pip = pip
                # A breath at a time, each with a seed of its own: a restart repeats none.
                own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
                with realtime.priority():
                    explore(ventilator, lung, 1, seed=own, ease=ease, pips=(pip,))
                run = PlannedRun(number, "explore", "exploration", lung, pip, number)
                line = ventilator.log.line(run, 0, 0)
                log.append({**line, "whole": not ventilator.stopped})
                spoilt = spoilt + 1 if ventilator.stopped else 0
                progress(number)
                if ventilator.stopped:
                    bench.operator.tell(f"breath {number} stopped: {ventilator.stopped}")
                if spoilt >= _STOPPED:
                    stopped = ventilator.stopped
                    break
        except EmergencyStop:
            stopped = "the operator pressed the emergency stop"
        finally:
            gc.enable()
            with contextlib.suppress(LinkError):
                bench.client.vent()
    breaths = recording(out / LOG, kinds=("explore",))
    write(breaths, out / RECORDING)
    return Collection(breaths, out / RECORDING, stopped)
