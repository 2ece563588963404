"""What an emulated ventilator is besides its computer and its lung, and what can go wrong with it.

Sensor, valves, supply and monostable run with the lung in a process of its own, which outlives the
device's program and its deadman, as real electronics do. Pins keep what they were last told. What
the valves then do depends on their kind:

- *open without current*: the monostable and a lost supply cut the current; both vent.
- *closed without current* (PVP's own): the monostable holds the expiratory valve open through a
  gate of its own, which vents; without supply nothing can, and the lung stays closed.

Faults are those of lung, valves and sensor, and of the line to the host.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval import realtime
from hardware_eval.device import deadman
from hardware_eval.device.program import Hal, Identity, Sample
from ventbench.base.errors import InputError

#: What the pins are told: inspiratory valve, %, and expiratory valve, 0 or 1.
LINES = struct.Struct("<fB")

#: Longest pause between two looks, s: shorter than what the lung may hold a command.
_LOOK = 0.020

#: Time for which the electronics outlive their last wire, s.
_AFTER = 0.5

#: Module of the process, and patience with its start, which compiles the lung, s.
_PROCESS, _STARTS = "hardware_eval.emulation.simulated", 300.0


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
    #: Each sample is lost with probability ``strength``.
    SENSOR_DROPOUTS = "sensor_dropouts"
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


_TEXT = re.compile(
    r"(?P<kind>\w+)@(?P<start>[\d.]+)(?:-(?P<end>[\d.]+))?(?::(?P<strength>[-\d.]+))?"
)


def parse(text: str, now: float = 0.0) -> Fault:
    """Read a fault as people write it: ``KIND@START[-END][:STRENGTH]``, seconds from ``now`` on.

    Raises:
        InputError: if it says nothing of the kind.
    """
    kinds = {kind.value: kind for kind in (*FaultKind, *LineFaultKind)}
    match = _TEXT.fullmatch(text.strip())
    kind = kinds.get(match["kind"]) if match else None
    try:
        if match is None or kind is None:
            raise ValueError
        start, end = float(match["start"]), float(match["end"] or "inf")
        strength = float(match["strength"] or 1.0)
        if not start < end:
            raise ValueError
    except ValueError:
        raise InputError(
            f"fault {text!r}: write KIND@START[-END][:STRENGTH], times in s, such as "
            f"leak@10-13:0.1; kinds: {', '.join(kinds)}"
        ) from None
    return Fault(kind, now + start, now + end, strength)


def active(faults: Iterable[Fault], now: float) -> dict[object, float]:
    """Strengths of what acts at ``now``, s, by kind; of two of one kind the later one's."""
    return {fault.kind: fault.strength for fault in faults if fault.start <= now < fault.end}


class Line:
    """What a line with faults makes of written bytes.

    Attributes:
        faults: what goes wrong; may be replaced while it runs.
    """

    def __init__(self, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        """Start with faults; ``seed`` is that of losses, flips and delays."""
        self.faults = tuple(faults)
        self._random = np.random.default_rng(seed)
        self._latest = -math.inf

    def to_device(self, now: float, data: bytes) -> bytes:
        """What arrives at the device of what the host wrote at ``now``, s."""
        if not self.faults:
            return data
        return self._damaged(active(self.faults, now), data)

    def to_host(self, now: float, data: bytes) -> tuple[float, bytes]:
        """When, s, and what leaves towards the host of what the device wrote at ``now``, s."""
        if not self.faults and self._latest <= now:
            return now, data
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
    """Start the electronics with arguments of :func:`serve`, and with those of their lung.

    Returns:
        The process, the sensor's bus, and the pins, see :func:`serve`.
    """
    here, there = Pipe()
    pins, wire = socket.socketpair()
    process = subprocess.Popen(
        [sys.executable, "-m", _PROCESS, str(there.fileno()), str(wire.fileno())],
        pass_fds=(there.fileno(), wire.fileno()),
        start_new_session=True,
    )
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
        """Start both, with arguments as of :func:`switch_on`.

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
    bus: Connection,
    wire: socket.socket,
    make: Callable[[], Hal],
    *,
    begun: float,
    normally_open: bool,
    monostable: float,
    log: Path | None,
) -> None:
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
