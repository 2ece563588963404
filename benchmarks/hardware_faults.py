"""Every fault, what the bench did about it, and within how many milliseconds.

The paper's PID runs on an emulated lung on a virtual clock, with sensor noise and the converter's
step of PVP. Each fault begins at random moments of the second breath. The time is that from the
fault's beginning until the device holds the inspiratory valve closed and the expiratory one open.

    python benchmarks/hardware_faults.py [--trials 10] [--lung R20C20]

Prints the table of ``hardware_eval/README.md``, and what a self-test says of each fault.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import typer

from hardware_eval.bench.controllers import ControllerFailedError, PIController
from hardware_eval.bench.loop import Bench, EmergencyStop, Operator, run_once
from hardware_eval.bench.plan import CONTROL_GAINS, PlannedRun
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.selftest import selftest
from hardware_eval.emulation.simulated import PVP_SENSOR
from hardware_eval.wire.client import Client, LinkError
from tests.hardware_eval import faults
from tests.hardware_eval.faults import FaultKind, FaultyDevice, faulty_lung
from ventbench.task import protocol

#: Time at rest before each run, s.
REST = 2.0


@dataclass(frozen=True)
class Fault:
    """One row of the table: a fault of lung, valves or sensor, or something else that happens."""

    name: str  #: as people say it.
    lung: tuple[FaultKind, float] | None = None  #: kind and strength.
    #: what a controller does from then on, on a device; gives its command, %.
    controller: Callable[[FaultyDevice], float | None] | None = None
    key: bool = False  #: whether the emergency stop is pressed.
    inspiration: bool = False  #: whether it begins in an inspiration only.


def raises(device: FaultyDevice) -> float:
    raise ControllerFailedError("it raised ValueError")


def interrupts(device: FaultyDevice) -> float:
    raise KeyboardInterrupt


FAULTS = (
    Fault("sensor stuck", (FaultKind.SENSOR_STUCK, 1.0)),
    Fault("sensor noisy (3 cmH2O)", (FaultKind.SENSOR_NOISY, 3.0)),
    Fault("sensor's bus blocked", (FaultKind.BUS_BLOCKED, 1.0)),
    Fault("sensor gives nothing", (FaultKind.SENSOR_LOST, 1.0)),
    Fault("sensor 25 cmH2O too high", (FaultKind.SENSOR_OFFSET, 25.0)),
    Fault("sensor 10 cmH2O too low", (FaultKind.SENSOR_OFFSET, -10.0)),
    Fault("tube disconnected", (FaultKind.DISCONNECTED, 1.0)),
    Fault("tube occluded", (FaultKind.OCCLUDED, 1.0)),
    Fault("tube pinched (3 R)", (FaultKind.PINCHED, 3.0)),
    Fault("small leak", (FaultKind.LEAK, 0.02)),
    Fault("large leak", (FaultKind.LEAK, 0.5)),
    Fault("inspiratory valve stuck", (FaultKind.VALVE_STUCK, 1.0), inspiration=True),
    Fault("inspiratory valve at a tenth", (FaultKind.VALVE_WEAK, 0.1)),
    Fault("expiratory valve stuck closed", (FaultKind.EXPIRATORY_STUCK, 1.0)),
    Fault("controller opens the valve fully", controller=lambda device: 100.0),
    Fault("controller raises an exception", controller=raises, inspiration=True),
    Fault("controller does not answer", controller=lambda device: None, inspiration=True),
    Fault("Ctrl-C", controller=interrupts, inspiration=True),
    Fault("emergency stop key", key=True),
    Fault("cable pulled", controller=FaultyDevice.unplug),
)


class Troubled(PIController):
    """The paper's PID, which from a moment on, s, does something else if the fault says so."""

    def __init__(self, device: FaultyDevice, lung: str, fault: Fault, moment: float) -> None:
        super().__init__(CONTROL_GAINS[lung])
        self._device, self._fault, self._moment = device, fault, moment
        self.began: float | None = None

    def act(self, row: np.ndarray, budget: float) -> float | None:
        """Next command, %."""
        wanted, now = super().act(row, budget), self._device.clock.now()
        if self._fault.controller is None or now < self._moment:
            return wanted
        self.began = self.began or now
        return self._fault.controller(self._device)


class StopKey(Operator):
    """Presses the emergency stop at a moment, s."""

    def __init__(self, device: FaultyDevice, moment: float) -> None:
        self._device, self._moment = device, moment

    def stop(self) -> bool:
        """Whether the moment has come."""
        return self._device.clock.now() >= self._moment


def bench_of(device: FaultyDevice, operator: Operator | None = None) -> Bench:
    """A bench with a session of the device."""
    client = Client(device, device.clock)
    client.hello()
    return Bench(client, device.clock, DEFAULT, operator or Operator(), rest=REST)


def break_lung(device: FaultyDevice, fault: Fault, moment: float) -> None:
    """Let a fault of lung, valves or sensor begin at a moment, s, and no other."""
    hal: Any = device.service.hal
    hal.faults = ()
    if fault.lung is not None:
        kind, strength = fault.lung
        hal.faults = (faults.Fault(kind, moment, strength=strength),)


def trial(device: FaultyDevice, lung: str, fault: Fault, moment: float) -> tuple[str, float]:
    """What the bench did, and after how many ms the lung was vented (NaN: it was not)."""
    begins = device.clock.now() + REST + moment
    bench = bench_of(device, StopKey(device, begins) if fault.key else None)
    break_lung(device, fault, begins)
    controller = Troubled(device, lung, fault, begins)
    try:
        result = run_once(bench, PlannedRun(0, "scored", "pid", lung, 20.0, 1), controller)
        done = "went on" if result.status == "complete" else result.reason.partition(":")[0]
        done = "answers too late" if "answers took" in done else done
    except LinkError:
        done = "device's watchdog"
    except EmergencyStop:
        done = "vented by the key"
    except KeyboardInterrupt:
        done = "vented on the way out"
    # What the controller or the cable does shows when it is next asked.
    began = controller.began or begins
    device.clock.advance(0.3)
    if done == "went on":
        return done, float("nan")
    vented = [x.time for x in device.actuations if (x.u_in, x.u_out) == (0.0, 1)]
    return done, 1e3 * max(vented[-1] - began, 0.0)


def tested(device: FaultyDevice, lung: str, fault: Fault) -> str:
    """What the self-test says of a fault of the lung, if it is there from the start."""
    if fault.lung is None:
        return ""
    break_lung(device, fault, device.clock.now())
    try:
        sheet = selftest(bench_of(device), lung)
    except LinkError as error:
        return f"no-go: {error}"
    bad = [x.name.replace("_", " ") for x in sheet.findings if not x.ok]
    return f"no-go: {', '.join(bad)}" if bad else "go"


def mend(device: FaultyDevice) -> None:
    """Mend the device, and let the lung empty."""
    hal: Any = device.service.hal
    hal.faults = ()
    device.plug()
    device.clock.advance(8.0)


def main(trials: int = 10, lung: str = "R20C20", only: str = "") -> None:
    """Every fault, what the bench did about it, and within how many milliseconds.

    --only: only faults whose names hold this.
    """
    random = np.random.default_rng(0)
    device = FaultyDevice(faulty_lung(lung, sensor=PVP_SENSOR))
    for fault in (fault for fault in FAULTS if only in fault.name):
        done: dict[str, list[float]] = {}
        last = int((1.0 if fault.inspiration else 3.0) / protocol.DT) - 3
        for _ in range(trials):
            moment = 3.0 + protocol.DT * (1 + int(random.integers(1, last)))
            what, took = trial(device, lung, fault, moment)
            done.setdefault(what, []).append(took)
            mend(device)
        found = tested(device, lung, fault)
        mend(device)
        times = [x for values in done.values() for x in values if np.isfinite(x)]
        span = f"{np.median(times):.0f}, {max(times):.0f}" if times else "-"
        what = ", ".join(f"{name} ({len(values)})" for name, values in done.items())
        print(f"| {fault.name} | {what} | {span} | {found} |", flush=True)


if __name__ == "__main__":
    typer.run(main)
