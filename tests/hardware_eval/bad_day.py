"""Sessions on a bad day, at random: what a line, a board, a sensor and other hosts can do."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import numpy as np

from hardware_eval.bench.controllers import PIController
from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.plan import make_plan
from hardware_eval.bench.raw_log import RawLog, lines
from hardware_eval.bench.safety import DEFAULT, VALVE_GAIN
from hardware_eval.bench.session import run_plan
from hardware_eval.device.program import DeviceService, Sample
from hardware_eval.wire.client import Client
from tests.hardware_eval import stand_in
from tests.hardware_eval.faults import Fault, FaultyDevice, LineFaultKind
from ventbench.task import protocol

#: How long common boards take until their program answers, s.
BOOT = 1.6


class Board:
    """A device that restarts whenever its port opens, or when a test says so."""

    def __init__(self, device: FaultyDevice, needs_lines: bool = False) -> None:
        self.device, self.clock = device, device.clock
        self.mute = needs_lines
        self.restarts = 0
        self.restart()

    def restart(self, boot: float = BOOT) -> None:
        """Begin anew, vented, without a session; bytes of before are lost."""
        device, self.restarts = self.device, self.restarts + 1
        device.service = DeviceService(device.service.hal, self.clock.now())
        device.unplug()
        device.plug()
        self.ready = self.clock.now() + boot

    def write(self, data: bytes) -> None:
        if self.clock.now() >= self.ready and not self.mute:
            self.device.write(data)

    def read(self, timeout: float) -> bytes:
        return self.device.read(timeout)

    def reopen(self) -> None:
        self.restart()

    def raise_lines(self) -> bool:
        self.mute = False
        return True

    def close(self) -> None:
        pass


@dataclass
class Lung(stand_in.Bench):
    """One compartment, R 5 cmH2O/(L/s) and C 20 mL/cmH2O, with a sensor that loses readings."""

    noise: float = 0.1
    lost: float = 0.0  #: share of the readings.
    volume: float = 0.0  #: above that at PEEP, mL.
    since: float = math.nan  #: time of ``volume``, s.
    command: tuple[float, int] = (0.0, 1)
    draws: Random = field(default_factory=lambda: Random(0))

    def sample(self, now: float) -> Sample:
        flow = self._advanced(now)
        outlet = 0.5 if self.command[1] else 1.0  # as much resistance behind the airway as before
        self.pressure = protocol.PEEP + outlet * self.volume / 20.0 + 5e-3 * flow
        seen = super().sample(now)
        return Sample(now, math.nan) if self.draws.random() < self.lost else seen

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        self._advanced(now)
        self.command = u_in, u_out

    def _advanced(self, now: float) -> float:
        """Advance to ``now``, s; returns the flow, mL/s."""
        dt = 0.0 if math.isnan(self.since) else now - self.since
        u_in, u_out = self.command
        flow = 0.0 if u_out else VALVE_GAIN * u_in
        self.volume = self.volume * math.exp(-dt / 0.2) if u_out else self.volume + flow * dt
        self.since = now
        return flow


@dataclass(frozen=True)
class Day:
    """What became of a session."""

    reason: str  #: why it is not done; empty if it is.
    lost: int  #: runs that are not complete.
    vented: bool  #: whether the valves vent at its end.
    attempts: int  #: at its runs.
    happened: Counter[str]  #: what happened to it.


def bad_day(path: Path, seed: int, repeats: int = 3) -> Day:
    """A session of a ramp and ``repeats`` runs, logged to ``path``, on a bad day.

    The board restarts, as it does whenever its port opens; another host calls; messages are lost or
    late; readings are lost; and a controller's answer is late.
    """
    draw, lung = Random(seed), Lung()
    device = FaultyDevice(lung)
    board = Board(device)
    client = Client(board, board.clock)
    client.hello()
    other = Client(device, device.clock)
    steps = 2 * protocol.BREATHS * protocol.INSPIRATION_STEPS  # of the first runs
    restarts = {draw.randrange(steps): draw.choice((0.05, 0.3, BOOT)) for _ in range(2)}
    calls, late = {draw.randrange(steps)}, {draw.randrange(steps)}
    loss, jitter, lung.lost = (draw.uniform(0.0, most) for most in (0.008, 0.006, 0.03))
    device.line.faults = (
        Fault(LineFaultKind.LOSS, 0.0, strength=loss),
        Fault(LineFaultKind.JITTER, 0.0, strength=jitter),
    )
    happened: Counter[str] = Counter()

    class Troubled(PIController):
        def act(self, row: np.ndarray, budget: float) -> float | None:
            happened["answers"] += 1
            count = happened["answers"]
            if count in restarts:
                board.restart(restarts[count])
            if count in calls:
                other.hello()
                happened["calls of another host"] += 1
            answer = super().act(row, budget)
            if count in late:
                happened["late answers"] += 1
                return None
            return answer

    plan = make_plan(["a"], ["R5C20"], pips=(10.0,), repeats=repeats, control_every=0, seed=seed)
    bench = Bench(client, board.clock, DEFAULT, Operator(), rest=0.5)
    with RawLog(path) as log:
        end = run_plan(bench, plan, lambda run: Troubled((2.0, 5.0)), log, about={})
    runs = [x for x in lines(path) if x["type"] == "run"]
    done = {x["run"] for x in runs if x["status"] == "complete"}
    happened["restarts"] = board.restarts - 1
    last = device.actuations[-1]
    lost = len({run.number for run in plan.runs} - done)
    return Day(end, lost, (last.u_in, last.u_out) == (0.0, 1), len(runs), happened)
