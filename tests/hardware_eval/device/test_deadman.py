"""The process that outlives the device's program vents when that dies or stands still."""

from __future__ import annotations

import random
import select
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from hardware_eval.device import deadman
from hardware_eval.device.deadman import BOUND, DEADMAN, Deadman, SupervisedHal
from hardware_eval.device.guard import Guard
from hardware_eval.device.program import DeviceService, Identity, Sample
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.wire.client import Client
from hardware_eval.wire.messages import Capability, Flag, Mode
from hardware_eval.wire.port import Port
from tests.hardware_eval.stand_in import Bench

VENTED = (0.0, 1)

#: Patience with a busy machine, s; a healthy one needs a thousandth of it.
PATIENCE = 600.0


def order(u_in: float, u_out: int) -> bytes:
    return struct.pack("<fB", u_in, u_out)


def test_no_schedule_of_orders_keeps_a_silent_program_unvented() -> None:
    draw = random.Random(0)
    for _ in range(40):
        state, now, fed = Deadman(0.0), 0.0, 0.0
        for _ in range(100):
            now += draw.choice((0.001, 0.005, 0.049, 0.051, 0.2))
            told = draw.choice((b"", order(50.0, 0), order(0.0, 1), order(20.0, 1)))
            lapsed = now - fed > DEADMAN and state.valves != VENTED
            state = deadman.step(state, now, told)
            fed = now if told else fed
            if lapsed and told != order(*VENTED):
                assert state.lapsed
                assert state.valves == VENTED
            assert state.valves == VENTED or now - fed <= DEADMAN


def test_only_an_order_to_vent_wakes_it_and_orders_may_come_in_pieces() -> None:
    state = deadman.step(Deadman(0.0), 0.0, order(50.0, 0)[:3])
    assert state.valves == VENTED
    state = deadman.step(state, 0.001, order(50.0, 0)[3:] + order(60.0, 0))
    assert state.valves == (60.0, 0)
    state = deadman.step(state, 0.1, order(60.0, 0))
    assert (state.valves, state.lapsed) == (VENTED, True)
    state = deadman.step(state, 0.105, order(0.0, 1) + order(5.0, 0))
    assert (state.valves, state.lapsed) == ((5.0, 0), False)


@pytest.fixture
def pins() -> Iterator[tuple[socket.socket, socket.socket, int]]:
    """Orders into a deadman, the pins that it moves, and its process."""
    here, there = socket.socketpair()
    opens = "tests.hardware_eval.electronics:Pins"
    process, orders = deadman.start(opens, str(there.fileno()), [there.fileno()])
    there.close()
    assert here.recv(5) == order(*VENTED)
    yield orders, here, process.pid
    orders.close()
    here.close()
    assert process.wait() == 0


def moves(pins: socket.socket, patience: float = PATIENCE) -> tuple[float, bytes]:
    assert select.select([pins], [], [], patience)[0], "the deadman did not vent"
    return time.monotonic(), pins.recv(5)


def test_a_program_that_stands_still_or_dies_is_vented(
    pins: tuple[socket.socket, socket.socket, int],
) -> None:
    orders, valves, _ = pins
    for _ in range(3):
        begun = time.monotonic()
        orders.send(order(50.0, 0))
        assert moves(valves)[1] == order(50.0, 0)
        vented, what = moves(valves)
        assert what == order(*VENTED)
        assert vented - begun > DEADMAN  # however late this machine looks at either
        orders.setblocking(True)
        assert orders.recv(1) == b"x"  # and tells it
        orders.send(order(50.0, 0))
        assert moves(valves)[1] == order(*VENTED)  # not awake yet
        orders.send(order(*VENTED))
        assert moves(valves)[1] == order(*VENTED)
    orders.send(order(50.0, 0))
    assert moves(valves)[1] == order(50.0, 0)
    orders.close()
    assert moves(valves)[1] == order(*VENTED)
    assert DEADMAN < BOUND


class BlockedSensor:
    """Its bus blocks whoever reads it, from a moment on."""

    identity = Identity("bench", b"12345678", bytes(32), Capability.NONE)

    def __init__(self) -> None:
        self.free = threading.Event()
        self.free.set()

    def sample(self, now: float) -> Sample:
        self.free.wait()
        return Sample(now, 5.0)


def test_a_blocked_bus_does_not_block_the_guard() -> None:
    orders, far = socket.socketpair()
    orders.setblocking(False)
    sensor = BlockedSensor()
    hal = SupervisedHal(sensor, orders)
    service = DeviceService(hal, time.monotonic())
    running = replace(service.state, mode=Mode.RUNNING, u_in=50.0, u_out=0)
    # Fed by commands, all the time; a device counts whole microseconds.
    service.state = replace(running, fed=round(1e6 * (time.monotonic() + PATIENCE)))
    port = Port(lambda: None, lambda descriptor: None)
    turns = 0

    def ended() -> bool:
        nonlocal turns
        turns += 1
        sensor.free.clear()
        return turns > 30

    Guard(service, port).run(ended)  # returns, while whoever reads the sensor does not
    assert service.state.causes == Flag.SENSOR_LOST
    assert (service.state.u_in, service.state.u_out) == VENTED
    sent = far.recv(4096)
    assert len(sent) >= 30 * 5  # the deadman was fed all the time
    far.close()
    hal.actuate(0.0, 0.0, 1)
    assert hal.lost
    sensor.free.set()
    hal.close()
    port.close()


def test_a_program_whose_valves_were_vented_says_so_and_vents() -> None:
    bench = Bench()
    device = LoopbackDevice(bench)
    client = Client(device, device.clock)
    client.hello()
    client.arm()
    assert client.command(10.0, 0).mode is Mode.RUNNING
    bench.lapsed = True
    device.clock.advance(0.005)
    bench.lapsed = False
    reading = client.heartbeat()
    assert (reading.mode, reading.flags) == (Mode.VENTED, Flag.DEVICE_LATE)
    assert bench.valves[-1][1:] == VENTED


def test_a_signal_that_outlasts_a_wait_does_not_prolong_it() -> None:
    """A program that was stopped, or a handler, takes longer than the wait had left."""
    port = Port(lambda: None, lambda descriptor: None)
    rescue = threading.Timer(5.0, port.inbox.put, (b"waited for ever",))
    before = signal.signal(signal.SIGALRM, lambda number, frame: time.sleep(0.1))
    rescue.start()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        waited = port.take(0.05)
    finally:
        signal.signal(signal.SIGALRM, before)
        rescue.cancel()
        port.close()
    assert waited == b""
