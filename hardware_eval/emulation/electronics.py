"""What an emulated ventilator is besides its computer: lung, sensor, valves, supply, monostable.

It runs in a process of its own and so outlives the device's program and its deadman, as real
electronics do. Pins keep what they were last told. What the valves then do depends on their kind:

- *open without current*: the monostable and a lost supply cut the current; both vent.
- *closed without current* (PVP's own): the monostable holds the expiratory valve open through a
  gate of its own, which vents; without supply nothing can, and the lung stays closed.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hardware_eval import realtime
from hardware_eval.device import deadman
from hardware_eval.device.program import Hal, Identity, Sample
from hardware_eval.emulation.faults import Fault, FaultKind, active
from ventbench.base.errors import InputError

if TYPE_CHECKING:
    from hardware_eval.emulation.simulated import SimulatedHal

#: What the pins are told: inspiratory valve, %, and expiratory valve, 0 or 1.
LINES = struct.Struct("<fB")

#: Longest pause between two looks, s: shorter than what the lung may hold a command.
_LOOK = 0.020

#: Time for which the electronics outlive their last wire, s.
_AFTER = 0.5

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


def switch_on(given: dict[str, Any]) -> tuple[subprocess.Popen[bytes], Connection, socket.socket]:
    """Start the electronics with arguments of :func:`serve` and :func:`emulated_lung`.

    Returns:
        The process, the sensor's bus, and the pins, see :func:`serve`.
    """
    here, there = Pipe()
    pins, wire = socket.socketpair()
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(there.fileno()), str(wire.fileno())],
        pass_fds=(there.fileno(), wire.fileno()), start_new_session=True,
    )  # fmt: skip
    there.close()
    wire.close()
    here.send(given)
    return process, here, pins


def introduced(bus: Connection) -> tuple[Identity, str]:
    """What the electronics say that they are, once the lung has been compiled.

    Raises:
        InputError: if they cannot be as asked.
    """
    try:
        answer = bus.recv() if bus.poll(_STARTS) else "the emulated lung did not start"
    except EOFError:
        answer = "the emulated lung did not start"
    if isinstance(answer, str):
        raise InputError(answer)
    return answer


class EmulatedHal(deadman.SupervisedHal):
    """Deadman and electronics as processes, as the device's program sees them."""

    def __init__(self, given: dict[str, Any], clock: Callable[[], float], begun: float) -> None:
        """Start both, with arguments of :func:`serve` and :func:`emulated_lung`.

        ``clock`` is the program's, s, and ``begun`` its zero on ``time.monotonic``, s.

        Raises:
            InputError: if the electronics cannot be as asked.
        """
        self._process, here, pins = switch_on({**given, "begun": begun})
        opens = f"{Pins.__module__}:{Pins.__name__}"
        self._deadman, orders = deadman.start(opens, str(pins.fileno()), [pins.fileno()])
        pins.close()
        try:
            identity, self.told = introduced(here)
        except InputError:
            orders.close()
            here.close()
            self._end()
            raise
        self._faults: tuple[Fault, ...] = tuple(given["faults"])
        self._bus = _Bus(here, identity)
        super().__init__(self._bus, orders, clock)

    @property
    def processes(self) -> dict[str, int]:
        """Process ids: what a test kills, and what must live on."""
        mine = {"device": os.getpid(), "deadman": self._deadman.pid}
        return {**mine, "electronics": self._process.pid}

    @property
    def faults(self) -> tuple[Fault, ...]:
        """What goes wrong; a fault that the lung cannot have is told on stderr."""
        return self._faults

    @faults.setter
    def faults(self, faults: Sequence[Fault]) -> None:
        self._faults = tuple(faults)
        self._bus.send(self._faults)

    def close(self) -> None:
        """Hang up; deadman and electronics vent and end."""
        super().close()
        self._bus.close()
        self._end()

    def _end(self) -> None:
        self._deadman.wait()
        self._process.wait()


class _Bus:
    """The sensor's bus; one thread samples, any may send."""

    def __init__(self, connection: Connection, identity: Identity) -> None:
        self.identity = identity
        self._connection, self._writing = connection, threading.Lock()

    def send(self, message: object) -> None:
        with self._writing:
            self._connection.send(message)

    def sample(self, now: float) -> Sample:
        try:
            self.send("sample")
            return self._connection.recv()
        except (OSError, EOFError):
            return Sample(now, float("nan"))

    def close(self) -> None:
        self._connection.close()


def serve(
    bus: Connection, wire: socket.socket, make: Callable[[], Hal], *, begun: float,
    normally_open: bool, monostable: float, log: Path | None,
) -> None:  # fmt: skip
    """Be the electronics until program and deadman have hung up.

    Args:
        bus: from the program: ``"sample"`` is answered, faults are taken.
        wire: from the deadman: what the pins are told.
        make: makes the lung.
        begun: zero of the device's clock on ``time.monotonic``, s.
        normally_open: see :class:`Electronics`.
        monostable: see :class:`Electronics`.
        log: file for every change of what the valves do: time of ``time.monotonic``, s, u_in, %,
            u_out, and what decided it.
    """
    written = log.open("w", buffering=1) if log else None
    hal: Any = make()
    realtime.prefer()  # not while it compiles: nobody else would get on
    powered = True

    def fail(number: int, frame: object) -> None:
        nonlocal powered
        powered = False

    signal.signal(signal.SIGUSR1, fail)
    bus.send((hal.identity, getattr(hal, "told", hal.identity.name)))
    state = Electronics(normally_open, monostable, beat=time.monotonic())
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
                    state = Electronics(normally_open, monostable, lines, now)
                elif (message := bus.recv()) == "sample":
                    asked = True
                else:
                    hal.faults = message
            except InputError as error:
                print(f"control: {error}", file=sys.stderr, flush=True)
            except (EOFError, OSError):
                sources.remove(source)
                left = left if sources else now + _AFTER
        if not powered:
            state = Electronics(normally_open, monostable, state.lines, state.beat, False)
        does = state.valves(now)
        hal.actuate(now - begun, *does[:2])
        if does != last and written:
            written.write(f"{now:.6f},{does[0]:g},{does[1]},{does[2]}\n")
        last = does
        blocked = FaultKind.BUS_BLOCKED in active(hal.faults, now - begun)
        if asked and bus in sources and not blocked:
            asked = False
            try:
                bus.send(hal.sample(now - begun))
            except OSError:
                sources.remove(bus)
                left = left if sources else now + _AFTER


def emulated_lung(
    lung: str, plant: str, conceal: str | None, seal: Path | None, **sensor: Any
) -> SimulatedHal:
    """Make the lung that ``emulate`` is asked for.

    Raises:
        InputError: if there is none.
    """
    from hardware_eval.emulation import simulated

    if conceal is None:
        return simulated.simulated_lung(lung, plant, **sensor)
    concealed = simulated.conceal(conceal, plant)
    hal = simulated.SimulatedHal(concealed.plant, name=f"emulated {concealed.lung}", **sensor)
    hal.told = f"{hal.identity.name}, with physics {concealed.seal['commitment'][:16]}..."
    if seal:
        concealed.write(seal)
    return hal


def _main() -> None:
    with Connection(int(sys.argv[1])) as bus, socket.socket(fileno=int(sys.argv[2])) as wire:
        given = bus.recv()
        about = {name: given.pop(name) for name in ("begun", "normally_open", "monostable", "log")}
        try:
            serve(bus, wire, lambda: emulated_lung(**given), **about)
        except (InputError, OSError) as error:  # of the lung, of --log or --seal
            bus.send(str(error))


if __name__ == "__main__":
    _main()
