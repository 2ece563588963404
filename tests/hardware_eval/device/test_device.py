"""The device's program guards the lung, whatever the host does; on a virtual clock."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from hardware_eval.device.program import OLDEST_SEEN, PERIOD, SENSOR_TIMEOUT
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.wire.client import Client, RefusedError
from hardware_eval.wire.messages import (
    Command,
    Flag,
    Mode,
    Packet,
    Reading,
    Reason,
    encode,
)
from tests.hardware_eval.stand_in import Bench
from ventbench.task import protocol

#: From the last command to vented valves, s.
VENTED_WITHIN = 0.100


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def device(bench: Bench) -> LoopbackDevice:
    return LoopbackDevice(bench)


@pytest.fixture
def client(device: LoopbackDevice) -> Client:
    client = Client(device, device.clock)
    client.hello()
    return client


def _vented(bench: Bench) -> bool:
    return bench.valves[-1][1:] == (0.0, 1)


def _run(client: Client, device: LoopbackDevice, steps: int = 3) -> Reading:
    reading = client.arm()
    for _ in range(steps):
        client.heartbeat()
        reading = client.command(12.34, 0)
        device.clock.advance(0.028)
    return reading


def test_commands_move_the_valves_of_an_armed_device_only(
    client: Client, device: LoopbackDevice, bench: Bench
) -> None:
    with pytest.raises(RefusedError, match="NOT_ARMED"):
        client.command(10.0, 0)
    assert _vented(bench)
    reading = _run(client, device)
    assert bench.valves[-1][1:] == (12.34, 0)
    assert (reading.u_in, reading.u_out, reading.mode) == (12.34, 0, Mode.RUNNING)
    assert reading.pressure == 5.0


@pytest.mark.parametrize("phase", [0.0, 0.001, 0.0049])
def test_silence_vents_within_a_tenth_of_a_second(
    client: Client, device: LoopbackDevice, bench: Bench, phase: float
) -> None:
    device.clock.advance(phase)
    _run(client, device, 1)
    last = max(time for time, u_in, _ in bench.valves if u_in > 0.0)
    sent = device.clock.now() - 0.028 - device.latency
    device.clock.advance(0.2)
    vented = min(time for time, u_in, u_out in bench.valves if time > last and u_out == 1)
    assert 0.05 < vented - sent <= VENTED_WITHIN
    reading = client.heartbeat()
    assert reading.mode is Mode.VENTED
    assert Flag.COMMANDS_STOPPED in reading.flags
    with pytest.raises(RefusedError, match="NOT_ARMED"):
        client.command(10.0, 0)
    assert _run(client, device).mode is Mode.RUNNING


def test_heartbeats_do_not_feed_the_watchdog(client: Client, device: LoopbackDevice) -> None:
    _run(client, device, 1)
    for _ in range(4):
        reading = client.heartbeat()
        device.clock.advance(0.028)
    assert reading.mode is Mode.VENTED


def test_pressure_above_the_limit_vents_at_once_and_bars_arming(
    client: Client, device: LoopbackDevice, bench: Bench
) -> None:
    _run(client, device)
    bench.pressure = 60.5
    device.clock.advance(PERIOD)
    assert _vented(bench)
    with pytest.raises(RefusedError, match="UNSAFE"):
        client.arm()
    bench.pressure = 20.0
    assert Flag.OVERPRESSURE in client.heartbeat().flags
    assert client.arm().flags is Flag.NONE


def test_the_host_lowers_the_pressure_limit_and_cannot_raise_it(
    device: LoopbackDevice, bench: Bench
) -> None:
    client = Client(device, device.clock)
    assert client.hello(200.0).pressure_limit == protocol.SAFETY_PRESSURE
    assert client.hello(30.0).pressure_limit == 30.0
    _run(client, device)
    bench.pressure = 30.5
    device.clock.advance(PERIOD)
    assert _vented(bench)


def test_a_limit_that_the_sensor_cannot_see_bars_arming(
    device: LoopbackDevice, bench: Bench
) -> None:
    bench.identity = replace(bench.identity, highest=50.8)
    client = Client(device, device.clock)
    client.hello()
    with pytest.raises(RefusedError, match="SENSOR_RANGE"):
        client.arm()
    client.hello(50.0)
    assert _run(client, device).mode is Mode.RUNNING


def test_a_sensor_at_the_end_of_its_range_vents_at_once(
    client: Client, device: LoopbackDevice, bench: Bench
) -> None:
    _run(client, device)
    bench.saturated = True
    device.clock.advance(PERIOD)
    assert _vented(bench)
    assert client.heartbeat().flags == Flag.OVERPRESSURE | Flag.SATURATED
    with pytest.raises(RefusedError, match="UNSAFE"):
        client.arm()


@pytest.mark.parametrize(
    ("noise", "flag"), [(0.0, Flag.SENSOR_STUCK), (2.0, Flag.SENSOR_NOISY)], ids=["stuck", "noisy"]
)
@pytest.mark.parametrize("healthy", [0.05, 0.1, 0.5])
def test_stuck_and_noisy_readings_are_found(
    device: LoopbackDevice, bench: Bench, healthy: float, noise: float, flag: Flag
) -> None:
    bench.noise, bench.identity = healthy, replace(bench.identity, noisy=True)
    client = Client(device, device.clock)
    client.hello()
    for phase in range(10):
        bench.noise = healthy
        device.clock.advance(0.5 + 1e-3 * phase)
        assert _run(client, device, 30).mode is Mode.RUNNING  # a second of health is no fault
        begun, bench.noise = device.clock.now(), noise
        with contextlib.suppress(RefusedError):  # once it has vented
            for _ in range(20):
                client.command(10.0, 0)
                device.clock.advance(0.028)
        assert flag in client.heartbeat().flags
        vents = [time for time, _, u_out in bench.valves if time > begun and u_out == 1]
        assert min(vents) - begun <= 0.30
        with pytest.raises(RefusedError, match="UNSAFE"):
            client.arm()


def test_a_lost_sensor_vents(client: Client, device: LoopbackDevice, bench: Bench) -> None:
    _run(client, device, 1)
    bench.pressure = float("nan")
    client.command(10.0, 0)
    device.clock.advance(SENSOR_TIMEOUT + 2 * PERIOD)
    assert _vented(bench)
    assert Flag.SENSOR_LOST in client.heartbeat().flags


@pytest.mark.parametrize(("u_in", "u_out"), [(100.01, 0), (655.0, 1), (10.0, 2), (10.0, 255)])
def test_a_command_out_of_range_vents(
    client: Client, device: LoopbackDevice, bench: Bench, u_in: float, u_out: int
) -> None:
    _run(client, device)
    with pytest.raises(RefusedError, match="OUT_OF_RANGE"):
        client.command(u_in, u_out)
    assert _vented(bench)


def test_a_command_that_waited_in_a_buffer_is_refused(
    client: Client, device: LoopbackDevice, bench: Bench
) -> None:
    """A laptop that sleeps: the port's buffer holds frames of before."""
    client.arm()
    client.command(20.0, 0)
    assert client.reading is not None
    late = Command(50.0, 0, round(client.reading.time * 1000))
    device.clock.advance(OLDEST_SEEN + 0.01)
    client.arm()
    before = len(bench.valves)
    session = device.service.state.session
    assert session is not None
    device.write(encode(Packet(session, 1000, late)))
    device.clock.advance(0.05)
    assert all(valves[1:] == (0.0, 1) for valves in bench.valves[before:])
    assert device.service.state.counters.stale == 1


def test_anybody_may_vent(client: Client, device: LoopbackDevice, bench: Bench) -> None:
    _run(client, device)
    other = Client(device, device.clock)  # without a session
    reading = other.vent()
    assert _vented(bench)
    assert Flag.HOST_VENTED in reading.flags


def test_a_second_host_takes_over_and_the_first_is_refused(
    client: Client, device: LoopbackDevice, bench: Bench
) -> None:
    _run(client, device)
    second = Client(device, device.clock)
    second.hello()
    assert _vented(bench)
    with pytest.raises(RefusedError) as caught:
        client.command(10.0, 0)
    assert caught.value.refusal.reason is Reason.SESSION


def test_a_device_that_was_held_up_vents_before_it_listens(
    client: Client, device: LoopbackDevice
) -> None:
    _run(client, device)
    state = device.service.state
    assert state.session is not None
    seen = round((device.clock.now() + 0.15) * 1000)  # fresh, had the device run
    frame = encode(Packet(state.session, state.sequence + 1, Command(50.0, 0, seen)))
    device.service.step(1e-6 * state.stepped + 0.2, frame)
    after = device.service.state
    assert (after.mode, after.u_in, after.u_out) == (Mode.VENTED, 0.0, 1)
    assert Flag.DEVICE_LATE in after.causes


@pytest.mark.parametrize(
    "kills", [60, pytest.param(1000, marks=pytest.mark.slow)], ids=["some", "a thousand"]
)
def test_hosts_killed_at_any_moment_leave_a_vented_lung(kills: int) -> None:
    """Also in the middle of a frame, and whatever the phases of host, device and line are."""
    rng = np.random.default_rng(0)
    for _ in range(kills):
        bench = Bench()
        device = LoopbackDevice(bench, latency=rng.uniform(0.0, 0.004))
        device.clock.advance(rng.uniform(0.0, PERIOD))
        client = Client(device, device.clock)
        client.hello()
        client.arm()
        for _ in range(rng.integers(1, 5)):
            client.heartbeat()
            device.clock.advance(rng.uniform(0.0, 0.015))
            client.command(rng.uniform(1.0, 100.0), 0)
            device.clock.advance(rng.uniform(0.0, 0.010))
        assert not _vented(bench)
        killed, state = device.clock.now(), device.service.state
        assert state.session is not None
        seen = round(killed * 1000)
        frame = encode(Packet(state.session, state.sequence + 1, Command(99.0, 0, seen)))
        device.write(frame[: rng.integers(0, len(frame))])
        device.clock.advance(0.3)
        vented = next(time for time, u_in, u_out in bench.valves if time > killed and u_out == 1)
        assert vented - killed <= VENTED_WITHIN
        assert _vented(bench)
