"""An emulated device: the device's own program over a simulated lung, in this process or apart.

In this process it lives on a virtual clock, without a wire (:class:`LoopbackDevice`). On a real
pseudo-terminal, which is a serial port for any program, ``ventbench-hardware emulate`` runs it in
real time.
"""

from __future__ import annotations

import os
import time
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path

from hardware_eval.device.guard import Guard
from hardware_eval.device.program import PERIOD, DeviceService, Hal
from hardware_eval.emulation.firmware import Firmware
from hardware_eval.realtime import VirtualClock
from hardware_eval.wire.port import Port
from ventbench.base.errors import InputError
from ventbench.task import protocol


class LoopbackDevice:
    """A transport whose other end is a device; time passes only while somebody waits.

    Attributes:
        clock: the clock of host and device.
        start: time at which the device started, s.
        service: program and hardware of the device.
        latency: time that bytes take each way, s; may be changed while it runs.
    """

    def __init__(
        self, hal: Hal, own_limit: float = protocol.SAFETY_PRESSURE, latency: float = 0.001
    ) -> None:
        """Start the device on a clock of its own."""
        self.clock = VirtualClock()
        self.start = self.clock.now()
        self.latency = latency
        self.service = DeviceService(hal, self.start, own_limit)
        self._next = self.start + PERIOD
        self._incoming: deque[tuple[float, bytes]] = deque()  # each with when it arrives, s
        self._outgoing: deque[tuple[float, bytes]] = deque()
        self.clock.carry(self._run_until)

    def write(self, data: bytes) -> None:
        """Send bytes to the device."""
        self._incoming.append((self.clock.now() + self.latency, data))

    def read(self, timeout: float) -> bytes:
        """Wait for bytes from the device; empty if none come within ``timeout``, s."""
        deadline = self.clock.now() + timeout
        while True:
            now = self.clock.now()
            ready = _arrived(self._outgoing, now)
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
        self._outgoing.append((now + self.latency, data))

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
            data = _arrived(self._incoming, now)
            if self._next <= now:
                self._next += PERIOD
            self.turn(now, data)


def _arrived(line: deque[tuple[float, bytes]], now: float) -> bytes:
    """Take what has arrived by now, s, off a line, which keeps the order."""
    data = b""
    while line and line[0][0] <= now:
        data += line.popleft()[1]
    return data


class Emulator(Guard):
    """A device on a pseudo-terminal, stepped in real time.

    Attributes:
        terminal: path that a host opens; of another name after the cable was pulled, unless there
            is a link.
    """

    def __init__(
        self,
        service: DeviceService | Firmware,
        *,
        begun: float,
        link: Path | None = None,
    ) -> None:
        """Open the terminal.

        Args:
            service: program of the device, with simulated hardware.
            begun: zero of the program's clock on ``time.monotonic``, s.
            link: symbolic link to make to the terminal, so that its name stays.

        Raises:
            InputError: if the link cannot be made.
        """
        self._link = link
        self._slave = -1
        check_link(link)
        first = self._open()
        unopened = [first]
        port = Port(lambda: unopened.pop() if unopened else self._open(), self._close_terminal)
        super().__init__(service, port, lambda: time.monotonic() - begun)

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Serve until ``stop()``; then vent and remove terminal and link."""
        try:
            super().run(stop)
        finally:
            self.close()

    def close(self) -> None:
        """Remove terminal and link."""
        self.port.close()

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


def check_link(link: Path | None) -> None:
    """Check where an emulator shall make its link.

    Raises:
        InputError: if another file would be lost, or there is no such folder.
    """
    if link is None:
        return
    if not link.parent.is_dir():
        raise InputError(f"--link {link}: {link.parent} is no folder; make it first")
    if link.exists() and not link.is_symlink():
        raise InputError(f"--link {link}: there is a file of that name; remove it")
