"""A process apart that owns the valves, and vents when the device's program dies or stands still.

The program sends it an order every 5 ms. Without one for :data:`DEADMAN` seconds, or when the
program has ended, the deadman vents, and stays vented until an order to vent tells that the program
is awake again. With each order it also moves a heartbeat pin: a monostable on that pin vents when
the deadman itself is dead (``README.md`` of this folder). The program reads its sensor in a thread,
so that a blocked bus makes readings old, which vents, and does not hold up the program.
"""

from __future__ import annotations

import contextlib
import importlib
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from subprocess import Popen
from typing import Protocol

from hardware_eval import realtime
from hardware_eval.device.program import PERIOD, Sample, Sensor

#: Time without an order after which the valves are vented, s: ten periods of the program.
DEADMAN = 0.050

#: Longest time from the death of the program to vented valves, s: the deadman and its wake-up.
BOUND = 0.060

#: Time without a movement of the heartbeat pin after which the monostable vents, s.
MONOSTABLE = 0.090

#: An order: inspiratory valve, %, and expiratory valve, 0 or 1.
_ORDER = struct.Struct("<fB")

_VENTED = (0.0, 1)


@dataclass(frozen=True, slots=True)
class Deadman:
    """State of the deadman."""

    fed: float  #: when the last order came, s.
    #: what the valves are told: inspiratory, %, and expiratory, 0 or 1.
    valves: tuple[float, int] = _VENTED
    lapsed: bool = False  #: whether orders stopped; only an order to vent is obeyed then.
    rest: bytes = b""  #: bytes of an order that has not come whole.


def step(state: Deadman, now: float, data: bytes) -> Deadman:
    """Look at the time first, and then at orders: one that comes late is too late."""
    if state.valves != _VENTED and now - state.fed > DEADMAN:
        state = replace(state, valves=_VENTED, lapsed=True)
    data = state.rest + data
    whole = len(data) - len(data) % _ORDER.size
    for order in _ORDER.iter_unpack(data[:whole]):
        lapsed = state.lapsed and order != _VENTED
        state = replace(state, fed=now, lapsed=lapsed, valves=_VENTED if lapsed else order)
    return replace(state, rest=data[whole:])


class Valves(Protocol):
    """What the deadman owns."""

    def actuate(self, u_in: float, u_out: int) -> None:
        """Set the valves, and move the heartbeat pin."""
        ...

    def close(self) -> None:
        """Vent and release them."""
        ...


def supervise(orders: socket.socket, valves: Valves) -> None:
    """Obey orders until the other end is closed, whoever closes it; then vent."""
    for number in realtime.ENDING:
        signal.signal(number, signal.SIG_IGN)  # they are the program's, which then hangs up
    realtime.prefer(realtime.DEADMAN_PRIORITY)
    state = Deadman(time.monotonic())
    try:
        valves.actuate(*state.valves)
        while True:
            left = state.fed + DEADMAN - time.monotonic()
            wait = None if state.valves == _VENTED else max(left, 0.0) + 1e-4
            ready = bool(select.select([orders], [], [], wait)[0])
            data = orders.recv(4096) if ready else b""
            if ready and not data:
                return
            before, state = state, step(state, time.monotonic(), data)
            if data or state.valves != before.valves:
                valves.actuate(*state.valves)
            if state.lapsed and not before.lapsed:
                orders.send(b"x")
    except OSError:
        return  # the program has gone
    finally:
        valves.close()


def start(
    valves: str, argument: str, keep: Sequence[int] = ()
) -> tuple[Popen[bytes], socket.socket]:
    """Start a deadman.

    Args:
        valves: what opens the valves in the deadman's process, ``module:name``.
        argument: what it is called with.
        keep: descriptors that the process needs.

    Returns:
        Its process, and the socket that its orders go into.
    """
    near, far = socket.socketpair()
    process = Popen(
        [sys.executable, "-m", __name__, str(far.fileno()), valves, argument],
        pass_fds=(far.fileno(), *keep),
        start_new_session=True,
    )
    far.close()
    near.setblocking(False)
    return process, near


class SupervisedHal:
    """A sensor read in a thread, and valves behind a deadman; neither holds up the program.

    Attributes:
        identity: of the device.
        lost: whether the deadman has gone; then the program must end.
    """

    def __init__(
        self, sensor: Sensor, orders: socket.socket, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin to sample, by the program's clock, s; the sensor may take its time."""
        self.identity = sensor.identity
        self.lost = False
        self._sensor, self._orders, self._clock = sensor, orders, clock
        self._latest = Sample(clock(), float("nan"))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, name="sensor", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while not self._ended.wait(PERIOD):
            self._latest = self._sensor.sample(self._clock())

    def sample(self, now: float) -> Sample:
        """The newest sample, and whether the deadman has vented since the last call."""
        lapsed = False
        with contextlib.suppress(OSError):
            lapsed = bool(self._orders.recv(64))
        return replace(self._latest, lapsed=True) if lapsed else self._latest

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        """Send an order; it feeds the deadman too."""
        try:
            self._orders.send(_ORDER.pack(u_in, u_out))
        except BlockingIOError:
            pass  # it is stopped: the monostable vents
        except OSError:
            self.lost = True

    def close(self) -> None:
        """End the thread, unless the bus blocks it, and hang up: the deadman vents and ends."""
        self._ended.set()
        self._thread.join(10.0 * PERIOD)
        self._orders.close()


def _main() -> None:
    descriptor, valves, argument = sys.argv[1:]
    module, _, name = valves.partition(":")
    opened = getattr(importlib.import_module(module), name)(argument)
    supervise(socket.socket(fileno=int(descriptor)), opened)


if __name__ == "__main__":
    _main()
