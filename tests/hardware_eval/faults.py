"""Faults of an emulated lung, its valves and its sensor, and of the line to the host."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from hardware_eval.device.program import Hal, Sample
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.emulation.simulated import SimulatedHal
from hardware_eval.wire.client import DisconnectedError
from ventbench.plants.catalog import load_simulators
from ventbench.task import protocol
from ventbench.task.interfaces import Plant

#: Time in which the sensor of a disconnected tube falls to ambient pressure, s.
_AMBIENT_LAG = 0.05

#: Factor of the airway's resistance when it is occluded.
_OCCLUSION = 100.0


class FaultKind(Enum):
    """What can go wrong with a lung on its ventilator; ``strength`` is in the unit given here."""

    #: The sensor keeps showing what it showed when the fault began.
    SENSOR_STUCK = "sensor_stuck"
    #: The sensor shows ``strength`` cmH2O too much.
    SENSOR_OFFSET = "sensor_offset"
    #: The sensor gives no value.
    SENSOR_LOST = "sensor_lost"
    #: The sensor scatters with a standard deviation of ``strength`` cmH2O more.
    SENSOR_NOISY = "sensor_noisy"
    #: The sensor's bus is blocked: nobody who reads it gets on.
    BUS_BLOCKED = "bus_blocked"
    #: The inspiratory valve stays where it was.
    VALVE_STUCK = "valve_stuck"
    #: The inspiratory valve opens to the share ``strength`` of what is commanded.
    VALVE_WEAK = "valve_weak"
    #: The expiratory valve stays closed.
    EXPIRATORY_STUCK = "expiratory_stuck"
    #: The tube is off: nothing reaches the lung, the sensor shows ambient pressure.
    DISCONNECTED = "disconnected"
    #: The airway's resistance is ``strength`` times its value (a pinched tube: 3).
    PINCHED = "pinched"
    #: The airway's resistance is a hundred times its value.
    OCCLUDED = "occluded"
    #: A leak as if the expiratory valve stood open by the share ``strength``.
    LEAK = "leak"


class LineFaultKind(Enum):
    """What can go wrong on the line; ``strength`` is in the unit given here."""

    #: The device's answers come ``strength`` seconds later.
    LATE = "late"
    #: They come later by a random time, uniform up to ``strength`` seconds, in order.
    JITTER = "jitter"
    #: Each write of either side is lost with probability ``strength``.
    LOSS = "loss"
    #: Each byte of either side has one bit flipped with probability ``strength``.
    NOISE = "noise"
    #: The device says nothing, though it goes on.
    SILENT = "silent"


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the simulated hardware or of the line."""

    kind: FaultKind | LineFaultKind  #: what goes wrong.
    start: float  #: from when, s on the device's clock.
    end: float = math.inf  #: until when, s.
    strength: float = 1.0  #: how much; see the kinds.


def active(faults: Iterable[Fault], now: float) -> dict[object, float]:
    """Strengths of what acts at ``now``, s, by kind; of two of one kind the later one's."""
    return {fault.kind: fault.strength for fault in faults if fault.start <= now < fault.end}


class FaultyLung(SimulatedHal):
    """A lung on a ventilator with faults.

    Attributes:
        faults: what goes wrong; may be replaced while it runs.
    """

    def __init__(self, plant: Plant, **settings: Any) -> None:
        super().__init__(plant, **settings)
        self.faults: tuple[Fault, ...] = ()
        self._stuck_reading = self._stuck_valve = math.nan
        self._ambient_from: tuple[float, float] | None = None
        self._last = Sample(0.0, math.nan)
        self._new = vars(self).copy()

    def at_rest(self, faults: Sequence[Fault] = (), seed: int = 0) -> FaultyLung:
        """The same lung at rest, with other faults; nothing is compiled again."""
        fresh = copy.copy(self)
        vars(fresh).update(self._new)
        fresh.faults, fresh._random = tuple(faults), np.random.default_rng(seed)
        return fresh

    def shown(self, now: float) -> tuple[float, float]:
        kinds = active(self.faults, now)
        pressure, flow = super().shown(now)
        if FaultKind.DISCONNECTED in kinds:
            begun, before = self._ambient_from or (now, self._last.pressure)
            self._ambient_from = begun, before
            pressure, flow = before * math.exp(-(now - begun) / _AMBIENT_LAG), 0.0
        else:
            self._ambient_from = None
        if FaultKind.SENSOR_NOISY in kinds:
            pressure += kinds[FaultKind.SENSOR_NOISY] * float(self._random.standard_normal())
        return pressure + kinds.get(FaultKind.SENSOR_OFFSET, 0.0), flow

    def sample(self, now: float) -> Sample:
        kinds = active(self.faults, now)
        if FaultKind.BUS_BLOCKED in kinds:
            return self._last
        before, seen = self._last.pressure, super().sample(now)
        pressure = seen.pressure
        if FaultKind.SENSOR_STUCK in kinds:
            self._stuck_reading = pressure = (
                before if math.isnan(self._stuck_reading) else self._stuck_reading
            )
        else:
            self._stuck_reading = math.nan
        if FaultKind.SENSOR_LOST in kinds:
            pressure = math.nan
        self._last = Sample(now, pressure, seen.flow, saturated=pressure >= self._sensor.highest)
        return self._last

    def forced(self, now: float) -> tuple[float, float, float]:
        kinds = active(self.faults, now)
        u_in, share, r_scale = super().forced(now)
        if FaultKind.VALVE_STUCK in kinds:
            u_in = u_in if math.isnan(self._stuck_valve) else self._stuck_valve
            self._stuck_valve = u_in
        else:
            self._stuck_valve = math.nan
        u_in *= kinds.get(FaultKind.VALVE_WEAK, 1.0)
        r_scale *= kinds.get(FaultKind.PINCHED, 1.0)
        if FaultKind.EXPIRATORY_STUCK in kinds:
            share = 0.0
        share = max(share, kinds.get(FaultKind.LEAK, 0.0))
        if FaultKind.DISCONNECTED in kinds:
            u_in, share = 0.0, 1.0
        if FaultKind.OCCLUDED in kinds:
            r_scale = _OCCLUSION
        return u_in, share, r_scale


def faulty_lung(lung: str, simulator: Any = "frozen", **settings: Any) -> FaultyLung:
    """As :func:`hardware_eval.emulation.simulated.simulated_lung`."""
    return FaultyLung(load_simulators(simulator).plant(lung), name=f"emulated {lung}", **settings)


class Line:
    """What a line with faults makes of written bytes.

    Attributes:
        faults: what goes wrong; may be replaced while it runs.
    """

    def __init__(self) -> None:
        self.faults: tuple[Fault, ...] = ()
        self._random = np.random.default_rng(0)
        self._latest = -math.inf

    def to_device(self, now: float, data: bytes) -> bytes:
        """What arrives at the device of what the host wrote at ``now``, s."""
        return self._damaged(active(self.faults, now), data)

    def to_host(self, now: float, data: bytes) -> tuple[float, bytes]:
        """When, s, and what leaves towards the host of what the device wrote at ``now``, s."""
        kinds = active(self.faults, now)
        if LineFaultKind.SILENT in kinds:
            return now, b""
        due = now + kinds.get(LineFaultKind.LATE, 0.0)
        if LineFaultKind.JITTER in kinds:
            due += float(self._random.uniform(0.0, kinds[LineFaultKind.JITTER]))
        self._latest = max(self._latest, due)  # a line keeps the order
        return self._latest, self._damaged(kinds, data)

    def _damaged(self, kinds: dict[object, float], data: bytes) -> bytes:
        if LineFaultKind.LOSS in kinds and self._random.uniform() < kinds[LineFaultKind.LOSS]:
            return b""
        if LineFaultKind.NOISE in kinds and data:
            array = np.frombuffer(data, np.uint8).copy()
            hit = self._random.uniform(size=len(array)) < kinds[LineFaultKind.NOISE]
            array[hit] ^= (1 << self._random.integers(0, 8, int(hit.sum()))).astype(np.uint8)
            return array.tobytes()
        return data


@dataclass(frozen=True, slots=True)
class Actuation:
    """A change of the valves: device time, s; inspiratory valve, %; expiratory valve, 0 or 1."""

    time: float
    u_in: float
    u_out: int


class FaultyDevice(LoopbackDevice):
    """A device in this process behind a line with faults, and a cable that can be pulled.

    Attributes:
        line: what it does to bytes.
        actuations: every change of the valves.
    """

    def __init__(
        self, hal: Hal, own_limit: float = protocol.SAFETY_PRESSURE, latency: float = 0.001
    ) -> None:
        self.line, self.plugged = Line(), True
        self.actuations = [Actuation(0.0, 0.0, 1)]
        super().__init__(hal, own_limit, latency)

    def unplug(self) -> None:
        """Pull the cable; what is on the way is lost."""
        self.plugged = False
        self._incoming.clear()
        self._outgoing.clear()

    def plug(self) -> None:
        """Put the cable back."""
        self.plugged = True

    def write(self, data: bytes) -> None:
        self.reopen()
        super().write(self.line.to_device(self.clock.now(), data))

    def read(self, timeout: float) -> bytes:
        self.reopen()
        return super().read(timeout)

    def reopen(self) -> None:
        if not self.plugged:
            raise DisconnectedError("the cable to the device is out")

    def turn(self, now: float, data: bytes) -> None:
        super().turn(now, data)
        state, last = self.service.state, self.actuations[-1]
        if (state.u_in, state.u_out) != (last.u_in, last.u_out):
            self.actuations.append(Actuation(now, state.u_in, state.u_out))

    def answer(self, now: float, data: bytes) -> None:
        if self.plugged:
            due, data = self.line.to_host(now, data)
            self._outgoing.append((due + self.latency, data))
