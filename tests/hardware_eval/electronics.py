"""An emulated device whose sensor, valves and supply are a process that outlives its program.

Three processes, as at a ventilator: the device's program, its deadman
(:mod:`hardware_eval.device.deadman`), and the electronics with the lung, which do with the valves
what the pins were last told. A monostable that sees no heartbeat holds the expiratory valve open
through a gate of its own, which vents; without supply nothing can, and the lung stays closed.

SIGUSR1 takes the supply from the electronics; SIGUSR2 blocks the bus of the sensor for a while.

    python -m tests.hardware_eval.electronics --link ./lung --valves valves.csv [--normally-closed]
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any

from hardware_eval import realtime
from hardware_eval.device import deadman
from hardware_eval.device.program import DeviceService, Identity, Sample
from hardware_eval.emulation.emulator import Emulator
from hardware_eval.wire.messages import Flag

#: What the pins are told: inspiratory valve, %, and expiratory valve, 0 or 1.
LINES = struct.Struct("<fB")

#: Longest pause between two looks, s: shorter than what the lung may hold a command.
_LOOK = 0.020

#: Time for which the electronics outlive their last wire, and for which the bus is blocked, s.
_AFTER, BLOCKED = 0.5, 0.3

#: Patience with the start of the process, which compiles the lung, s.
_STARTS = 300.0


@dataclass(frozen=True, slots=True)
class Electronics:
    """What decides what the valves do."""

    normally_open: bool = True  #: whether the expiratory valve is open without current.
    #: time without a heartbeat after which the monostable vents, s; infinite where none is fitted.
    monostable: float = deadman.MONOSTABLE
    #: what the pins were last told: inspiratory valve, %, and expiratory valve, 0 or 1.
    lines: tuple[float, int] = (0.0, 1)
    beat: float = 0.0  #: when the heartbeat pin last moved, s.
    powered: bool = True  #: whether there is a supply.

    def valves(self, now: float) -> tuple[float, int, str]:
        """What the valves do, and what decides it: ``lines``, ``monostable`` or ``supply``."""
        if not self.powered:
            return 0.0, int(self.normally_open), "supply"
        if now - self.beat > self.monostable:
            return 0.0, 1, "monostable"
        return *self.lines, "lines"


class Pins:
    """The pins as the deadman sees them; see :class:`~hardware_eval.device.deadman.Valves`."""

    def __init__(self, descriptor: str) -> None:
        """Take the number of the wire's descriptor."""
        self._wire = socket.socket(fileno=int(descriptor))

    def actuate(self, u_in: float, u_out: int) -> None:
        """Set the pins."""
        self._wire.sendall(LINES.pack(u_in, u_out))

    def close(self) -> None:
        """Vent."""
        with contextlib.suppress(OSError):  # the electronics have gone
            self.actuate(0.0, 1)
        self._wire.close()


class WiredHal:
    """Pins and bus of the electronics, which it starts.

    Attributes:
        identity: of the device.
        pid: process of the electronics.
        pins: what the pins are told goes in here.
    """

    def __init__(self, lung: str, log: Path, begun: float, normally_open: bool = True) -> None:
        """Start the electronics with arguments of :func:`serve`."""
        self._bus, there = Pipe()
        self.pins, wire = socket.socketpair()
        given = [str(x) for x in (there.fileno(), wire.fileno(), lung, log, begun)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.hardware_eval.electronics", *given, str(normally_open)],
            pass_fds=(there.fileno(), wire.fileno()),
            start_new_session=True,
        )
        there.close()
        wire.close()
        self.pid = self._process.pid
        assert self._bus.poll(_STARTS), "the emulated lung did not start"
        self.identity: Identity = self._bus.recv()

    def sample(self, now: float) -> Sample:
        """Ask the sensor."""
        try:
            self._bus.send("sample")
            return self._bus.recv()
        except (OSError, EOFError):
            return Sample(now, math.nan)

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        """Set the pins."""
        self.pins.sendall(LINES.pack(u_in, u_out))

    def close(self) -> None:
        """Hang up; the electronics vent and end."""
        self.pins.close()
        self._bus.close()
        self._process.wait()


def serve(
    bus: Connection, wire: socket.socket, lung: str, log: Path, begun: float, normally_open: bool
) -> None:
    """Be the electronics until program and deadman have hung up.

    Args:
        bus: from the program: ``"sample"`` is answered.
        wire: from the deadman: what the pins are told.
        lung: label of a textbook lung.
        log: file for every change of what the valves do: time of ``time.monotonic``, s, u_in, %,
            u_out, and what decided it.
        begun: zero of the device's clock on ``time.monotonic``, s.
        normally_open: see :class:`Electronics`.
    """
    from hardware_eval.emulation.simulated import simulated_lung

    written = log.open("w", buffering=1)
    hal = simulated_lung(lung, "single_compartment")
    realtime.prefer()  # not while it compiles: nobody else would get on
    powered, blocked = True, -math.inf

    def fail(number: int, frame: object) -> None:
        nonlocal powered, blocked
        powered &= number != signal.SIGUSR1
        blocked = time.monotonic() + BLOCKED if number == signal.SIGUSR2 else blocked

    for number in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, fail)
    bus.send(hal.identity)
    state = Electronics(normally_open, beat=time.monotonic())
    last: tuple[float, int, str] | None = None
    sources: list[Any] = [bus, wire]
    asked, left, rest = False, float("inf"), b""
    while (now := time.monotonic()) < left:
        lapses = state.beat + state.monostable - now
        ready = wait(sources, min(max(lapses, 0.0) + 1e-4, _LOOK) if lapses > 0.0 else _LOOK)
        now = time.monotonic()
        for source in ready:
            try:
                if source is wire:
                    data = wire.recv(4096)
                    if not data:
                        raise EOFError
                    rest += data
                    whole = len(rest) - len(rest) % LINES.size
                    *_, lines = (state.lines, *LINES.iter_unpack(rest[:whole]))
                    rest = rest[whole:]
                    state = Electronics(normally_open, lines=lines, beat=now)
                else:
                    asked = bus.recv() == "sample"
            except (EOFError, OSError):
                sources.remove(source)
                left = left if sources else now + _AFTER
        if not powered:
            state = Electronics(normally_open, state.monostable, state.lines, state.beat, False)
        does = state.valves(now)
        hal.actuate(now - begun, *does[:2])
        if does != last:
            written.write(f"{now:.6f},{does[0]:g},{does[1]},{does[2]}\n")
        last = does
        if asked and bus in sources and now >= blocked:
            asked = False
            try:
                bus.send(hal.sample(now - begun))
            except OSError:
                sources.remove(bus)
                left = left if sources else now + _AFTER


class LoggedEmulator(Emulator):
    """Writes each change that its program orders: ``time.monotonic``, s, u_in, %, u_out, flags."""

    def __init__(self, service: DeviceService, log: Path, **settings: Any) -> None:
        self._written = log.open("w", buffering=1)
        self.ordered = (0.0, 1)
        super().__init__(service, **settings)

    def turn(self, now: float, data: bytes) -> None:
        """Log, too."""
        super().turn(now, data)
        service: Any = self.service
        state = service.state
        if (state.u_in, state.u_out) != self.ordered:
            self.ordered = state.u_in, state.u_out
            causes = Flag(state.causes).name
            row = f"{time.monotonic():.6f},{state.u_in:g},{state.u_out},{causes}\n"
            self._written.write(row)

    def close(self) -> None:
        """Close the log, too."""
        super().close()
        self._written.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Be the device's program, with deadman and electronics, until told to end."""
    parser = argparse.ArgumentParser()
    for name in ("--link", "--valves", "--program"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--normally-closed", action="store_true")
    parser.add_argument("--realtime", action="store_true")
    given = parser.parse_args(arguments)
    begun = time.monotonic()
    clock: Callable[[], float] = lambda: time.monotonic() - begun  # noqa: E731
    wired = WiredHal("R20C50", given.valves, begun, not given.normally_closed)
    opens = f"tests.hardware_eval.electronics:{Pins.__name__}"
    guard, orders = deadman.start(opens, str(wired.pins.fileno()), [wired.pins.fileno()])
    wired.pins.close()
    hal = deadman.SupervisedHal(wired, orders, clock)
    try:
        service = DeviceService(hal, clock())
        emulator = LoggedEmulator(service, given.program, link=given.link, begun=begun)
        reason = realtime.prefer()
        if given.realtime and reason:
            raise SystemExit(reason)
        ended = realtime.told_to_end()
        ids = {"device": os.getpid(), "deadman": guard.pid, "electronics": wired.pid}
        print(*(f"{name} {number}" for name, number in ids.items()), sep=", ", flush=True)
        emulator.run(lambda: ended() or hal.lost)
    finally:
        hal.close()
        guard.wait()
        wired.close()
    sys.exit(int(hal.lost))


if __name__ == "__main__":
    if len(sys.argv) == 7 and sys.argv[1].isdigit():
        bus, wire, lung, log, begun, normally_open = sys.argv[1:]
        with Connection(int(bus)) as there, socket.socket(fileno=int(wire)) as pins:
            serve(there, pins, lung, Path(log), float(begun), normally_open == "True")
    else:
        main()
