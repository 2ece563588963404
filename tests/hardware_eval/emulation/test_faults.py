"""Faults of lung, valves, sensor and line do what they say; on a virtual clock."""

from __future__ import annotations

import math
from typing import Any

import flax.struct
import pytest

from hardware_eval.emulation.simulated import SimulatedHal, simulated_lung
from hardware_eval.wire.client import Client, DisconnectedError, NoAnswerError
from hardware_eval.wire.messages import Capability, Flag, Mode
from tests.hardware_eval.faults import Fault, FaultKind, FaultyDevice, FaultyLung, LineFaultKind
from tests.hardware_eval.stand_in import Bench
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.plants.catalog import load_simulators
from ventbench.plants.single_compartment import single_compartment
from ventbench.task import protocol
from ventbench.task.interfaces import Signals
from ventbench.task.lungs import lung

STEPS = 34


@pytest.fixture(scope="module")
def hal_of_a_textbook_lung() -> FaultyLung:
    return FaultyLung(single_compartment(lung("R20C50")))


def _inspire(
    hal: FaultyLung, *faults: Fault, u_in: float = 10.0, steps: int = STEPS
) -> list[float]:
    """Pressures at the steps of an inspiration with a constant command, cmH2O."""
    fresh = hal.at_rest(faults)
    pressures = []
    for k in range(steps):
        fresh.actuate(0.03 * k, u_in, 0)
        pressures.append(fresh.sample(0.03 * (k + 1)).pressure)
    return pressures


def test_without_faults_the_lung_is_the_plant(hal_of_a_textbook_lung: FaultyLung) -> None:
    """Textbook: p = PEEP + q t / C + R q."""
    flow = 0.228  # L/s: 10 % of 22.8 mL/s per %
    expected = [protocol.PEEP + flow * 0.03 * (k + 1) / 0.05 + 20.0 * flow for k in range(STEPS)]
    assert _inspire(hal_of_a_textbook_lung) == pytest.approx(expected, abs=1e-3)


def test_samples_between_commands_change_nothing(hal_of_a_textbook_lung: FaultyLung) -> None:
    fresh = hal_of_a_textbook_lung.at_rest()
    pressures = []
    for k in range(STEPS):
        fresh.actuate(0.03 * k, 10.0 + k % 2, 0)
        for part in (0.001, 0.01, 0.02):
            fresh.sample(0.03 * k + part)
        pressures.append(fresh.sample(0.03 * (k + 1)).pressure)
    other = hal_of_a_textbook_lung.at_rest()
    for k in range(STEPS):
        other.actuate(0.03 * k, 10.0 + k % 2, 0)
        assert other.sample(0.03 * (k + 1)).pressure == pytest.approx(pressures[k], abs=1e-3)


def test_faults_change_the_pressure_as_they_say(hal_of_a_textbook_lung: FaultyLung) -> None:
    hal = hal_of_a_textbook_lung
    healthy = _inspire(hal)

    def last(kind: FaultKind, strength: float = 1.0) -> float:
        return _inspire(hal, Fault(kind, 0.3, strength=strength))[-1]

    offset = _inspire(hal, Fault(FaultKind.SENSOR_OFFSET, 0.3, 0.6, 2.0))
    assert [b - a for a, b in zip(healthy, offset, strict=True)] == pytest.approx(
        [2.0 if 0.3 <= 0.03 * (k + 1) < 0.6 - 1e-9 else 0.0 for k in range(STEPS)], abs=1e-3
    )
    stuck = _inspire(hal, Fault(FaultKind.SENSOR_STUCK, 0.305))
    assert set(stuck[10:]) == {stuck[9]}
    assert math.isnan(last(FaultKind.SENSOR_LOST))
    assert last(FaultKind.VALVE_WEAK, 0.5) < healthy[-1] - 3.0
    assert last(FaultKind.LEAK, 0.2) < healthy[-1] - 1.5
    assert last(FaultKind.PINCHED, 3.0) == pytest.approx(healthy[-1] + 2 * 20.0 * 0.228, abs=1e-2)
    assert last(FaultKind.OCCLUDED) > 60.0
    assert abs(last(FaultKind.DISCONNECTED)) < 0.1


@flax.struct.dataclass
class _Rigid:
    """A plant whose pressure follows the command, and which shows nothing else."""

    gain: Any

    def init(self, pressure: Any, peep: Any = None) -> Any:
        return pressure, Signals(pressure)

    def step(self, state: Any, u_in: Any, u_out: Any, dt: Any) -> tuple[Any, Any]:
        after = state + self.gain * u_in * dt
        return after, Signals(after)

    def vary(self, r_scale: Any, c_scale: Any, gain: Any = 1.0) -> Any:
        return _Rigid(self.gain * r_scale * gain)

    def parameters(self) -> None:
        return None


def test_a_plant_without_flow_says_so() -> None:
    hal = SimulatedHal(_Rigid(1.0))
    assert math.isnan(hal.sample(0.0).flow)
    assert not hal.identity.capabilities & Capability.FLOW


def test_a_stuck_valve_keeps_its_position(hal_of_a_textbook_lung: FaultyLung) -> None:
    fresh = hal_of_a_textbook_lung.at_rest((Fault(FaultKind.VALVE_STUCK, 0.1),))
    for k in range(10):
        fresh.actuate(0.03 * k, 10.0, 0)
        before = fresh.sample(0.03 * (k + 1)).pressure
    fresh.actuate(0.3, 0.0, 0)
    assert fresh.sample(0.33).pressure > before + 0.1


def test_the_device_vents_an_occluded_lung(hal_of_a_textbook_lung: FaultyLung) -> None:
    hal = hal_of_a_textbook_lung.at_rest((Fault(FaultKind.OCCLUDED, 0.3),))
    device = FaultyDevice(hal)
    client = Client(device, device.clock)
    client.hello()
    reading = client.arm()
    while reading.mode is Mode.RUNNING:
        reading = client.heartbeat()
        if reading.mode is Mode.RUNNING:
            reading = client.command(20.0, 0)
        device.clock.advance(0.02)
    assert Flag.OVERPRESSURE in reading.flags
    assert device.actuations[-1].time - 0.3 < 0.02
    device.clock.advance(1.0)
    assert client.heartbeat().pressure < 10.0


def test_a_frozen_lung_breathes_and_shows_its_flow() -> None:
    device = FaultyDevice(simulated_lung("R20C50"))
    client = Client(device, device.clock)
    welcome = client.hello()
    assert welcome.name == "emulated R20C50"
    client.arm()
    start, volume, pressures = device.clock.now(), 0.0, []
    for k in range(protocol.INSPIRATION_STEPS):
        reading = client.heartbeat()
        client.command(12.0, 0)
        pressures.append(reading.pressure)
        volume += reading.flow * 0.03
        device.clock.sleep_until(start + 0.03 * (k + 1))
    assert 12.0 < pressures[-1] < 40.0
    # Volume over recoil, which is the pressure less the airway's drop, mL/cmH2O: the rig's own.
    rig: Any = load_simulators("frozen").plant("R20C50")
    # Until it is armed no bias flow holds PEEP: the lung empties towards what the valve leaves.
    with float64():
        closed = protocol.PEEP - float(rig.valve(rig.rest) / rig.conductance)
    assert closed < pressures[0] < protocol.PEEP
    flow = reading.flow / 1000.0
    recoil = pressures[-1] - protocol.PEEP - float(rig.R + rig.K2 * abs(flow)) * flow
    assert volume / recoil == pytest.approx(1000.0 / float(rig.E), rel=0.25)


@pytest.mark.parametrize(
    ("kind", "strength", "times_out"),
    [
        (LineFaultKind.LATE, 0.030, True),
        (LineFaultKind.LATE, 0.010, False),
        (LineFaultKind.SILENT, 1.0, True),
        (LineFaultKind.LOSS, 1.0, True),
        (LineFaultKind.NOISE, 0.5, True),
    ],
)
def test_faults_of_the_line(kind: LineFaultKind, strength: float, times_out: bool) -> None:
    device = FaultyDevice(Bench())
    line = device.line
    client = Client(device, device.clock)
    client.hello()
    client.arm()
    line.faults = (Fault(kind, device.clock.now(), device.clock.now() + 0.5, strength),)
    if times_out:
        with pytest.raises(NoAnswerError, match="within 20 ms"):
            client.command(10.0, 0)
    else:
        before = device.clock.now()
        client.command(10.0, 0)
        assert device.clock.now() - before >= strength
    device.clock.advance(1.0)
    assert client.vent().mode is Mode.VENTED  # the line is in order again


def test_a_pulled_cable_vents_and_the_client_comes_back() -> None:
    bench = Bench()
    device = FaultyDevice(bench)
    client = Client(device, device.clock)
    client.hello(40.0)
    client.arm()
    client.command(10.0, 0)
    device.unplug()
    with pytest.raises(DisconnectedError):
        client.command(10.0, 0)
    device.clock.advance(0.1)
    assert bench.valves[-1][1:] == (0.0, 1)
    device.plug()
    assert client.reconnect().pressure_limit == 40.0
    assert client.arm().mode is Mode.RUNNING


def test_a_disturbed_tube_leaks_or_resists_until_it_is_mended() -> None:
    hal = SimulatedHal(single_compartment(lung("R20C50")))
    pressures = []
    for k, tube in enumerate(("", "leak", "pinch", "")):
        hal.disturb(tube)
        hal.actuate(k, 10.0, 0)
        pressures.append(hal.shown(k + 0.03)[0])
        hal.actuate(k + 0.03, 0.0, 1)
    healthy, leaking, pinched, mended = pressures
    assert leaking < healthy < pinched
    assert mended == pytest.approx(healthy, abs=0.5)
    with pytest.raises(InputError, match="choose of leak, pinch"):
        hal.disturb("fire")
