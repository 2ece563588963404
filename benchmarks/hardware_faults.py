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

from hardware_eval.bench.controllers import ControllerFailedError, Count, PIDController
from hardware_eval.bench.loop import Bench, EmergencyStop, Operator, run_once
from hardware_eval.bench.plan import CONTROL_GAINS, PlannedRun
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.selftest import selftest
from hardware_eval.emulation.simulated import PVP_SENSOR
from hardware_eval.wire.client import Client, LinkError, NoAnswerError
from hardware_eval.wire.messages import Reading
from tests.hardware_eval import faults
from tests.hardware_eval.faults import FaultKind, FaultyDevice, faulty_lung
from ventbench.task import protocol

#: Time at rest before each run, s.
REST = 2.0


class HostDiedError(BaseException):
    """``kill -9``: nothing of the host runs after it, not even what cleans up."""


def unchanged(wanted: float) -> float:
    return wanted


class Troubled:
    """A PID that from a moment on does something else.

    Args:
        device: whose clock tells the moment.
        lung: whose gains it has.
        moment: s on that clock.
        trouble: called with its command from then on; gives the command that is sent.
    """

    longest_answer, beside = 0.0, Count()

    def __init__(
        self, device: FaultyDevice, lung: str, moment: float, trouble: Callable[[float], Any]
    ) -> None:
        self._pid = PIDController((*CONTROL_GAINS[lung], 0.0))
        self._device, self._moment, self._trouble = device, moment, trouble
        self._own = trouble is not unchanged
        self.began: float | None = None

    def act(self, row: np.ndarray, budget: float) -> float | None:
        """Next command, %."""
        wanted = self._pid.act(row, budget)
        if self._device.clock.now() < self._moment or wanted is None:
            return wanted
        if self._own and self.began is None:
            self.began = self._device.clock.now()
        return self._trouble(wanted)

    def close(self) -> None:
        """Nothing to end."""


class DeadClient(Client):
    """A host that says nothing more once it has died."""

    dead = False

    def vent(self) -> Reading:
        """Vent, unless it is dead."""
        if self.dead:
            raise NoAnswerError("the host is dead")
        return super().vent()


class StopKey(Operator):
    """Presses the emergency stop at a moment."""

    def __init__(self, device: FaultyDevice, moment: float) -> None:
        self._device, self._moment = device, moment

    def stop(self) -> bool:
        """Whether the moment has come."""
        return self._device.clock.now() >= self._moment


@dataclass(frozen=True)
class Fault:
    """One row of the table.

    Attributes:
        name: as people say it.
        lung: fault of lung, valves or sensor; None if it is another.
        controller: what the controller does from then on.
        device: what is done to the device's line at that moment.
        key: whether the emergency stop is pressed.
        dies: whether the host dies.
        inspiration: whether it begins in an inspiration only.
    """

    name: str
    lung: tuple[FaultKind, float] | None = None
    controller: Callable[[float], Any] | None = None
    device: Callable[[FaultyDevice], None] | None = None
    key: bool = False
    dies: bool = False
    inspiration: bool = False


def raises(wanted: float) -> float:
    raise ControllerFailedError("it raised ValueError")


def interrupts(wanted: float) -> float:
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
    Fault("controller opens the valve fully", controller=lambda wanted: 100.0),
    Fault("controller raises an exception", controller=raises, inspiration=True),
    Fault("controller does not answer", controller=lambda wanted: None, inspiration=True),
    Fault("Ctrl-C", controller=interrupts, inspiration=True),
    Fault("emergency stop key", key=True),
    Fault("host killed (kill -9)", dies=True, inspiration=True),
    Fault("cable pulled", device=FaultyDevice.unplug),
    Fault("host asleep or stopped", dies=True, inspiration=True),
)


def trial(device: FaultyDevice, lung: str, fault: Fault, moment: float) -> tuple[str, float]:
    """What the bench did, and after how many ms the lung was vented (NaN: it was not)."""
    hal: Any = device.service.hal
    client = Client(device, device.clock)
    client.hello()
    begins = device.clock.now() + REST + moment
    if fault.lung is not None:
        hal.faults = (faults.Fault(fault.lung[0], begins, strength=fault.lung[1]),)

    def dies(wanted: float) -> float:
        DeadClient.dead = True
        raise HostDiedError

    def acts(wanted: float) -> float:
        assert fault.device is not None
        fault.device(device)
        return wanted

    trouble: Callable[[float], Any] = fault.controller or unchanged
    if fault.dies:
        trouble = dies
    if fault.device is not None:
        trouble = acts
    operator = StopKey(device, begins) if fault.key else Operator()
    bench = Bench(client, device.clock, DEFAULT, operator, rest=REST)
    run = PlannedRun(0, "scored", "pid", lung, 20.0, 1)
    controller = Troubled(device, lung, begins, trouble)
    if fault.dies:
        bench = Bench(DeadClient(device, device.clock), device.clock, DEFAULT, operator, rest=REST)
        bench.client.hello()
    try:
        result = run_once(bench, run, controller)
        done = "went on" if result.status == "complete" else result.reason.partition(":")[0]
        done = "answers too late" if "answers took" in done else done
    except LinkError:
        done = "device's watchdog"
    except HostDiedError:
        done = "device's watchdog"
    except EmergencyStop:
        done = "vented by the key"
    except KeyboardInterrupt:
        done = "vented on the way out"
    DeadClient.dead = False
    # What the controller or the cable does shows when it is next asked.
    began = begins if controller.began is None else controller.began
    device.clock.advance(0.3)
    if done == "went on":
        return done, float("nan")
    vented = [x.time for x in device.actuations if (x.u_in, x.u_out) == (0.0, 1)]
    return done, 1e3 * max(vented[-1] - began, 0.0)


def clear(device: FaultyDevice) -> None:
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
        for _ in range(trials):
            within = 1.0 if fault.inspiration else 3.0
            moment = 3.0 + protocol.DT * (
                1 + int(random.integers(1, int(within / protocol.DT) - 3))
            )
            what, took = trial(device, lung, fault, moment)
            done.setdefault(what, []).append(took)
            clear(device)
        found = "" if fault.lung is None else _selftest(device, lung, fault)
        times = [x for values in done.values() for x in values if np.isfinite(x)]
        span = f"{np.median(times):.0f}, {max(times):.0f}" if times else "-"
        what = ", ".join(f"{name} ({len(values)})" for name, values in done.items())
        print(f"| {fault.name} | {what} | {span} | {found} |", flush=True)


def _selftest(device: FaultyDevice, lung: str, fault: Fault) -> str:
    """What the self-test says of the fault, if it is there from the start."""
    hal: Any = device.service.hal
    assert fault.lung is not None
    hal.faults = (faults.Fault(fault.lung[0], device.clock.now(), strength=fault.lung[1]),)
    client = Client(device, device.clock)
    client.hello()
    try:
        bench = Bench(client, device.clock, DEFAULT, Operator(), rest=REST)
        sheet = selftest(bench, lung)
        bad = [x.name.replace("_", " ") for x in sheet.findings if not x.ok]
        found = f"no-go: {', '.join(bad)}" if bad else "go"
    except LinkError as error:
        found = f"no-go: {error}"
    clear(device)
    return found


if __name__ == "__main__":
    typer.run(main)
