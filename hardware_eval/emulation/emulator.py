"""An emulated device: the device's own program over a simulated lung, in this process or apart.

In this process it lives on a virtual clock, without a wire (:class:`LoopbackDevice`). On a real
pseudo-terminal, which is a serial port for any program, ``ventbench-hardware emulate`` runs it in
real time. The cable can be pulled, and faults can begin, while it runs: by lines of text on a
socket (``--control``), see :class:`Emulator`.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import math
import os
import socket
import sys
import time
import tty
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from hardware_eval import realtime
from hardware_eval.device.deadman import MONOSTABLE
from hardware_eval.device.port import Guard, Port
from hardware_eval.device.program import PERIOD, DeviceService, DeviceSettings, Hal
from hardware_eval.emulation.electronics import (
    EmulatedHal,
    Fault,
    FaultKind,
    Line,
    LineFaultKind,
    parse,
)
from hardware_eval.emulation.firmware import Firmware
from hardware_eval.realtime import VirtualClock
from hardware_eval.wire.client import DisconnectedError
from hardware_eval.wire.messages import Flag
from ventbench.base.errors import InputError

#: Changes of the valves that are remembered.
_REMEMBERED = 100_000

#: Bytes that are read at once.
_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class Actuation:
    """A change of the valves: device time, s; inspiratory valve, %; expiratory valve, 0 or 1."""

    time: float
    u_in: float
    u_out: int


class LoopbackDevice:
    """A transport whose other end is a device; time passes only while somebody waits.

    Attributes:
        clock: the clock of host and device.
        start: time at which the device started, s.
        service: program and hardware of the device.
        latency: time that bytes take each way, s; may be changed while it runs.
        line: what the line does to bytes; its faults may be changed while it runs.
        actuations: every change of the valves.
        plugged: whether the cable is in; :meth:`unplug` and :meth:`plug` change it.
    """

    def __init__(
        self, hal: Hal, settings: DeviceSettings | None = None, latency: float = 0.001
    ) -> None:
        """Start the device on a clock of its own."""
        self.line, self.clock = Line(), VirtualClock()
        self.start = self.clock.now()
        self.latency = latency
        self.service = DeviceService(hal, settings or DeviceSettings(), self.start)
        self.actuations = [Actuation(self.start, 0.0, 1)]
        self.plugged = True
        self._next = self.start + PERIOD
        self._order = count()
        self._incoming: list[tuple[float, int, bytes]] = []
        self._outgoing: list[tuple[float, int, bytes]] = []
        self.clock.carry(self._run_until)

    def write(self, data: bytes) -> None:
        """Send bytes to the device; DisconnectedError if the cable is out."""
        self._require_cable()
        arrival = self.clock.now() + self.latency
        data = self.line.to_device(self.clock.now() - self.start, data)
        if data:
            heapq.heappush(self._incoming, (arrival, next(self._order), data))

    def read(self, timeout: float) -> bytes:
        """Wait for bytes from the device; empty if none come within ``timeout``, s."""
        deadline = self.clock.now() + timeout
        while True:
            self._require_cable()
            now, ready = self.clock.now(), b""
            while self._outgoing and self._outgoing[0][0] <= now:
                ready += heapq.heappop(self._outgoing)[2]
            if ready or now >= deadline:
                return ready
            coming = [self._next, deadline]
            coming += [queue[0][0] for queue in (self._incoming, self._outgoing) if queue]
            self.clock.sleep_until(max(min(coming), now + 1e-6))

    def close(self) -> None:
        """Nothing to release; the device goes on."""

    def reopen(self) -> None:
        """Connect again; DisconnectedError if the cable is still out."""
        self._require_cable()

    def raise_lines(self) -> bool:
        """There are none."""
        return False

    def unplug(self) -> None:
        """Pull the cable; what is on the way is lost."""
        self.plugged = False
        self._incoming.clear()
        self._outgoing.clear()

    def plug(self) -> None:
        """Put the cable back."""
        self.plugged = True

    def _require_cable(self) -> None:
        if not self.plugged:
            raise DisconnectedError("the cable to the device is out")

    def _run_until(self, instant: float) -> None:
        while True:
            arrival = self._incoming[0][0] if self._incoming else float("inf")
            now = min(self._next, arrival)
            if now > instant:
                return
            data = b""
            while self._incoming and self._incoming[0][0] <= now:
                data += heapq.heappop(self._incoming)[2]
            if self._next <= now:
                self._next += PERIOD
            answers = self.service.step(now, data)
            if answers and self.plugged:
                due, answers = self.line.to_host(now - self.start, answers)
                due += self.start + self.latency
                heapq.heappush(self._outgoing, (due, next(self._order), answers))
            state, last = self.service.state, self.actuations[-1]
            if (state.u_in, state.u_out) != (last.u_in, last.u_out):
                self.actuations.append(Actuation(now, state.u_in, state.u_out))


class Emulator(Guard):
    """A device on a pseudo-terminal, stepped in real time.

    Lines of text on the control socket: a fault as in ``--fault`` with times from now on
    (``leak@0-3:0.1``), ``clear`` to end all faults, ``unplug SECONDS`` to pull the cable.

    Attributes:
        terminal: path that a host opens; of another name after the cable was pulled, unless there
            is a link.
        actuations: the last changes of the valves; their times are those of ``time.monotonic``,
            which all processes of a machine share.
        line: what the line does to bytes.
    """

    def __init__(
        self,
        service: DeviceService | Firmware,
        *,
        link: Path | None = None,
        control: Path | None = None,
        line_faults: Sequence[Fault] = (),
        log: Path | None = None,
        begun: float | None = None,
    ) -> None:
        """Open the terminal.

        Args:
            service: program of the device, with simulated hardware.
            link: symbolic link to make to the terminal, so that its name stays.
            control: path of the control socket to make.
            line_faults: what goes wrong on the line.
            log: file to which each change of the valves is written as it happens: time of
                ``time.monotonic``, s, u_in, %, u_out, flags.
            begun: zero of the program's clock on ``time.monotonic``, s, if it is not now.

        Raises:
            InputError: if the link or the socket cannot be made.
        """
        now = time.monotonic()
        begun = now if begun is None else begun
        self.actuations = deque([Actuation(now, 0.0, 1)], maxlen=_REMEMBERED)
        self.line = Line(line_faults)
        self._outgoing: list[tuple[float, int, bytes]] = []
        self._order = count()
        self._log = log.open("w", buffering=1) if log else None
        self._link, self._control_path = link, control
        self._slave = -1
        if link is not None and link.exists() and not link.is_symlink():
            raise InputError(f"--link {link}: there is a file of that name; remove it")
        first = self._open()
        self._control = self._open_control() if control else None
        unopened = [first]
        port = Port(lambda: unopened.pop() if unopened else self._open(), self._close_terminal)
        self._device = service
        super().__init__(service, port, lambda: time.monotonic() - begun)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Serve until ``stop()``; then vent and remove link and socket."""
        try:
            super().run(stop)
        finally:
            self.close()

    def close(self) -> None:
        """Remove terminal, link and socket."""
        self.port.close()
        if self._control is not None and self._control_path is not None:
            self._control.close()
            self._control_path.unlink(missing_ok=True)
            self._control = None
        if self._log:
            self._log.close()
            self._log = None

    def wanted(self) -> float:
        """Time at which an answer is due that a fault delays, s."""
        return self._outgoing[0][0] if self._outgoing else float("inf")

    def turn(self, now: float, data: bytes) -> None:
        """Step the program; answer as the line's faults allow, and do what the control says."""
        answers = self.service.step(now, self.line.to_device(now, data) if data else b"")
        state, last = self._device.state, self.actuations[-1]
        if (state.u_in, state.u_out) != (last.u_in, last.u_out):
            done = Actuation(time.monotonic(), state.u_in, state.u_out)
            self.actuations.append(done)
            if self._log:
                causes = Flag(state.causes).name
                self._log.write(f"{done.time:.6f},{done.u_in:g},{done.u_out},{causes}\n")
        if answers:
            due, answers = self.line.to_host(now, answers)
            heapq.heappush(self._outgoing, (due, next(self._order), answers))
        while self._outgoing and self._outgoing[0][0] <= now:
            self.port.send(heapq.heappop(self._outgoing)[2])
        if self._control is not None:
            with contextlib.suppress(BlockingIOError):
                self._obey(self._control.recv(_CHUNK).decode(errors="replace"))

    def _obey(self, text: str) -> None:
        """Do what lines of the control socket say; a wrong one is named on stderr."""
        hal: Any = self._device.hal
        for line in text.splitlines():
            word, _, argument = line.strip().partition(" ")
            try:
                if word == "clear":
                    hal.faults, self.line.faults = (), ()
                elif word == "unplug":
                    self.port.hang_up(float(argument or 1.0))
                    self._outgoing.clear()
                elif word:
                    self.add_fault(parse(line, self._clock()))
            except ValueError as error:
                print(f"control: {error}", file=sys.stderr, flush=True)

    def add_fault(self, fault: Fault) -> None:
        """Add a fault of the lung or of the line; times on the device's clock."""
        if isinstance(fault.kind, FaultKind):
            hal: Any = self._device.hal
            hal.faults = (*hal.faults, fault)
        else:
            self.line.faults = (*self.line.faults, fault)

    def _open(self) -> int:
        master, self._slave = os.openpty()  # ours keeps it open between hosts
        tty.setraw(self._slave)
        os.set_blocking(master, False)
        self.terminal = os.ttyname(self._slave)
        if self._link is not None:
            try:
                self._link.parent.mkdir(parents=True, exist_ok=True)
                self._link.unlink(missing_ok=True)
                self._link.symlink_to(self.terminal)
            except OSError as error:
                os.close(master)
                os.close(self._slave)
                raise InputError(f"--link {self._link} cannot be made: {error}") from error
            self.terminal = str(self._link)
        return master

    def _close_terminal(self, master: int) -> None:
        os.close(master)
        os.close(self._slave)
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()

    def _open_control(self) -> socket.socket:
        assert self._control_path is not None
        self._control_path.unlink(missing_ok=True)
        control = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            control.bind(str(self._control_path))
        except OSError as error:
            control.close()
            raise InputError(
                f"--control {self._control_path} cannot be made: {error}; a short path helps"
            ) from error
        control.setblocking(False)
        return control


def tell(control: Path, text: str) -> None:
    """Send a line, see :class:`Emulator`, to the control socket of a running emulator.

    Raises:
        InputError: if no emulator listens there.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        try:
            sender.sendto(text.encode(), str(control))
        except OSError as error:
            raise InputError(f"--control {control}: no emulator listens there: {error}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an emulated device until it is interrupted; returns the exit code."""
    parser = argparse.ArgumentParser(
        "ventbench-hardware emulate",
        description="Emulate a ventilator with a lung on a pseudo-terminal.",
        epilog="Example: ventbench-hardware emulate --lung R20C50 --link ./lung --fault "
        "leak@10-13:0.1",
    )
    add = parser.add_argument
    add("--lung", default="R20C50", help="lung on the ventilator")
    add("--plant", default="frozen", help="simulator: a name, a file or module:function")
    add(
        "--conceal",
        metavar="WORDS",
        dest="words",
        help="a lung with physics that the simulator lacks; the words determine it",
    )
    add("--seal", type=Path, help="where the sealed answer of --conceal goes (JSON)")
    add("--link", type=Path, help="symbolic link to make to the terminal")
    add("--control", type=Path, help="control socket to make")
    add("--log", type=Path, help="CSV of every order of the program to the valves")
    add("--electronics", type=Path, help="CSV of everything that the valves do, and why")
    add(
        "--normally-closed",
        action="store_true",
        help="the expiratory valve is closed without current, as PVP's own",
    )
    add("--no-monostable", action="store_true", help="no monostable on the heartbeat pin")
    add("--fault", action="append", default=[], help="KIND@START[-END][:STRENGTH], repeatedly")
    add("--noise", type=float, default=0.0, help="sensor noise, cmH2O (SD)")
    add("--quantum", type=float, default=0.0, help="step of the sensor's converter, cmH2O")
    add("--highest", type=float, default=math.inf, help="end of the sensor's range, cmH2O")
    add(
        "--realtime",
        action="store_true",
        help="refuse to run without real-time scheduling, which is taken where it is granted",
    )
    add(
        "--firmware",
        type=Path,
        metavar="FILE",
        help="a program of hardware_eval/firmware as the device: .elf runs under QEMU",
    )
    add("--pressure-limit", type=float, help="device's own limit, cmH2O")
    given = parser.parse_args(arguments)
    try:
        return _emulate(given)
    except InputError as error:
        print(f"ventbench-hardware emulate: {error}", file=sys.stderr)
        return 2


def _emulate(given: argparse.Namespace) -> int:
    faults = [parse(text) for text in given.fault]
    line_faults = [fault for fault in faults if isinstance(fault.kind, LineFaultKind)]
    limit = given.pressure_limit
    settings = DeviceSettings() if limit is None else DeviceSettings(limit)
    about = {name: getattr(given, name) for name in ("lung", "plant", "words", "seal")}
    sensor = {name: getattr(given, name) for name in ("noise", "quantum", "highest")}
    begun = time.monotonic()
    asked = {
        **about,
        **sensor,
        "faults": [x for x in faults if isinstance(x.kind, FaultKind)],
        "log": given.electronics,
        "normally_open": not given.normally_closed,
        "monostable": float("inf") if given.no_monostable else MONOSTABLE,
    }
    hal: EmulatedHal | Firmware
    if given.firmware is None:
        hal = EmulatedHal(asked, lambda: time.monotonic() - begun, begun)
    elif limit is None:
        hal = Firmware(given.firmware, asked, begun)
    else:
        raise InputError("--pressure-limit: with --firmware, the limit is the firmware's own")
    try:
        if isinstance(hal, Firmware):
            service = hal
        else:
            service = DeviceService(hal, settings, time.monotonic() - begun)
        emulator = Emulator(
            service,
            link=given.link,
            control=given.control,
            line_faults=line_faults,
            log=given.log,
            begun=begun,
        )
        reason = realtime.prefer()
        if given.realtime and reason:
            emulator.close()
            raise InputError(f"--realtime: {reason}; run as root, or without it")
        ended = realtime.told_to_end()
        if isinstance(hal, Firmware):
            hal.start(lambda: emulator.port.inbox.put(b""))
        print(emulator.terminal, flush=True)
        processes = ", ".join(f"{name} {number}" for name, number in hal.processes.items())
        print(f"{hal.told} ({processes}); Ctrl-C ends it", file=sys.stderr, flush=True)
        emulator.run(lambda: ended() or hal.lost)
        print(f"longest lateness of the device: {1e3 * emulator.lateness:.1f} ms", file=sys.stderr)
    finally:
        hal.close()
    return int(hal.lost)
