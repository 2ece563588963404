"""An emulated device: the device's own program over a simulated lung, in this process or apart.

In this process it lives on a virtual clock, without a wire (:class:`LoopbackDevice`). On a real
pseudo-terminal, which is a serial port for any program, ``ventbench-hardware emulate`` runs it in
real time. The tube can be disturbed while it runs: by lines of text on a socket (``--control``).
"""

from __future__ import annotations

import contextlib
import heapq
import os
import socket
import sys
import time
import tty
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

from hardware_eval.device.port import Guard, Port
from hardware_eval.device.program import PERIOD, DeviceService, DeviceSettings, Hal
from hardware_eval.emulation.firmware import Firmware
from hardware_eval.realtime import VirtualClock
from ventbench.base.errors import InputError

#: Bytes that are read at once.
_CHUNK = 4096


class LoopbackDevice:
    """A transport whose other end is a device; time passes only while somebody waits.

    Attributes:
        clock: the clock of host and device.
        start: time at which the device started, s.
        service: program and hardware of the device.
        latency: time that bytes take each way, s; may be changed while it runs.
    """

    def __init__(
        self, hal: Hal, settings: DeviceSettings | None = None, latency: float = 0.001
    ) -> None:
        """Start the device on a clock of its own."""
        self.clock = VirtualClock()
        self.start = self.clock.now()
        self.latency = latency
        self.service = DeviceService(hal, settings or DeviceSettings(), self.start)
        self._next = self.start + PERIOD
        self._order = count()
        self._incoming: list[tuple[float, int, bytes]] = []
        self._outgoing: list[tuple[float, int, bytes]] = []
        self.clock.carry(self._run_until)

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""
        arrival = self.clock.now() + self.latency
        heapq.heappush(self._incoming, (arrival, next(self._order), data))

    def read(self, timeout: float) -> bytes:
        """Wait for bytes from the device; empty if none come within ``timeout``, s."""
        deadline = self.clock.now() + timeout
        while True:
            now, ready = self.clock.now(), b""
            while self._outgoing and self._outgoing[0][0] <= now:
                ready += heapq.heappop(self._outgoing)[2]
            if ready or now >= deadline:
                return ready
            coming = [self._next, deadline]
            coming += [queue[0][0] for queue in (self._incoming, self._outgoing) if queue]
            self.clock.sleep_until(max(min(coming), now + 1e-6))

    def turn(self, now: float, data: bytes) -> None:
        """Step the device's program, and answer."""
        if answers := self.service.step(now, data):
            self.answer(now, answers)

    def answer(self, now: float, data: bytes) -> None:
        """Put bytes of the device on the way to the host."""
        heapq.heappush(self._outgoing, (now + self.latency, next(self._order), data))

    def close(self) -> None:
        """Nothing to release; the device goes on."""

    def reopen(self) -> None:
        """Nothing to connect."""

    def raise_lines(self) -> bool:
        """There are none."""
        return False

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
            self.turn(now, data)


class Emulator(Guard):
    """A device on a pseudo-terminal, stepped in real time.

    Lines of text on the control socket: ``leak`` or ``pinch`` to disturb the tube, ``clear`` to
    mend it.

    Attributes:
        terminal: path that a host opens; of another name after the cable was pulled, unless there
            is a link.
    """

    def __init__(
        self,
        service: DeviceService | Firmware,
        *,
        link: Path | None = None,
        control: Path | None = None,
        begun: float | None = None,
    ) -> None:
        """Open the terminal.

        Args:
            service: program of the device, with simulated hardware.
            link: symbolic link to make to the terminal, so that its name stays.
            control: path of the control socket to make.
            begun: zero of the program's clock on ``time.monotonic``, s, if it is not now.

        Raises:
            InputError: if the link or the socket cannot be made.
        """
        begun = time.monotonic() if begun is None else begun
        self._link, self._control_path = link, control
        self._slave = -1
        check_paths(link, control)
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

    def turn(self, now: float, data: bytes) -> None:
        """Step the program and answer, and do what the control says."""
        super().turn(now, data)
        if self._control is not None:
            with contextlib.suppress(BlockingIOError):
                self._obey(self._control.recv(_CHUNK).decode(errors="replace"))

    def _obey(self, text: str) -> None:
        """Do what lines of the control socket say; a wrong one is named on stderr."""
        hal: Any = self._device.hal
        for word in text.split():
            try:
                hal.disturb("" if word == "clear" else word)
            except InputError as error:
                print(f"control: {error}", file=sys.stderr, flush=True)

    def _open(self) -> int:
        master, self._slave = os.openpty()  # ours keeps it open between hosts
        tty.setraw(self._slave)
        os.set_blocking(master, False)
        self.terminal = os.ttyname(self._slave)
        if self._link is not None:
            try:
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


def check_paths(link: Path | None, control: Path | None) -> None:
    """Check where an emulator shall make its link and its control socket.

    Raises:
        InputError: if another file would be lost, or there is no such folder.
    """
    for option, path, is_ours in (
        ("--link", link, Path.is_symlink),
        ("--control", control, Path.is_socket),
    ):
        if path is None:
            continue
        if not path.parent.is_dir():
            raise InputError(f"{option} {path}: {path.parent} is no folder; make it first")
        if path.exists() and not is_ours(path):
            raise InputError(f"{option} {path}: there is a file of that name; remove it")
