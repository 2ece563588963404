"""The line to a host in a thread of its own, so that nothing on it can hold up the guard.

Reading and writing a terminal can take long on a busy system, even where neither has to wait: the
kernel moves the bytes in threads of ordinary priority. The program of the device takes bytes from
a queue and leaves bytes in one; that takes microseconds.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from queue import Empty, Queue
from typing import Protocol

from hardware_eval.device.program import PERIOD
from ventbench.base.errors import InputError

_CHUNK = 4096

#: Pause after a line could not be opened, s.
_RETRY = 1.0


class Port:
    """A line that is opened again when it breaks.

    Attributes:
        inbox: what arrived, in order.
    """

    def __init__(self, open_line: Callable[[], int | None], close_line: Callable[[int], None]):
        """Start the thread.

        Args:
            open_line: opens the line and returns its descriptor, non-blocking; None while there
                is none. It is asked again every :data:`~hardware_eval.device.program.PERIOD`.
            close_line: closes a descriptor.
        """
        # A signal whose handler outlasts the timeout would let SimpleQueue wait for ever.
        self.inbox: Queue[bytes] = Queue()
        self._outbox: deque[bytes] = deque()
        self._open_line, self._close_line = open_line, close_line
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        self._absent_until = 0.0
        self._ended = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, data: bytes) -> None:
        """Leave bytes to be written; what the line does not take is lost, as on a wire."""
        self._outbox.append(data)
        self._nudge()

    def close(self) -> None:
        """End the thread and close the line."""
        self._ended = True
        self._nudge()
        self._thread.join()
        for descriptor in (self._woken, self._wake):
            os.close(descriptor)

    def _nudge(self) -> None:
        with contextlib.suppress(BlockingIOError):  # full of nudges already
            os.write(self._wake, b"x")

    def _run(self) -> None:
        line: int | None = None
        while not self._ended:
            if line is None and time.monotonic() >= self._absent_until:
                line = self._opened()
            sources = [self._woken] if line is None else [self._woken, line]
            ready, _, _ = select.select(sources, [], [], PERIOD if line is None else None)
            if self._woken in ready:
                os.read(self._woken, _CHUNK)
            if line is not None and line in ready and not self._read(line):
                self._close_line(line)  # the host hung up; the watchdog vents
                line = None
            while self._outbox:
                data = self._outbox.popleft()
                if line is not None:
                    with contextlib.suppress(OSError):
                        os.write(line, data)
        if line is not None:
            self._close_line(line)

    def _opened(self) -> int | None:
        try:
            return self._open_line()
        except (InputError, OSError) as error:
            print(f"the line cannot be opened: {error}", file=sys.stderr, flush=True)
            self._absent_until = time.monotonic() + _RETRY
            return None

    def _read(self, line: int) -> bool:
        """Take what arrived; False if the line is broken."""
        try:
            data = os.read(line, _CHUNK)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if data:
            self.inbox.put(data)
        return bool(data)


class Service(Protocol):
    """A program of a device with its hardware."""

    def step(self, now: float, data: bytes = b"") -> bytes:
        """Guard the lung at ``now``, s, and do what arrived; returns bytes to send."""
        ...

    def vent(self, now: float) -> None:
        """Vent whatever the program says."""
        ...


class Guard:
    """The loop of a device in real time: steps the program every period, and when bytes arrive.

    Attributes:
        service: program and hardware.
        port: line to the host.
        lateness: longest time by which a step came late, s.
    """

    def __init__(
        self, service: Service, port: Port, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Guard with a clock, s, that is the device's own time."""
        self.service = service
        self.port = port
        self.lateness = 0.0
        self._clock = clock

    def run(self, stop: Callable[[], bool]) -> None:
        """Go on until ``stop()``; then vent."""
        gc.collect()
        gc.freeze()  # what is there stays; a collection in the loop would walk over all of it
        due = self._clock() + PERIOD
        try:
            while not stop():
                data = self._wait(due)
                now = self._clock()
                if now >= due:
                    self.lateness = max(self.lateness, now - due)
                    due = max(due + PERIOD, now)
                self.turn(now, data)
        finally:
            self.service.vent(self._clock())

    def turn(self, now: float, data: bytes) -> None:
        """Step the program and answer."""
        if answers := self.service.step(now, data):
            self.port.send(answers)

    def _wait(self, instant: float) -> bytes:
        """Bytes that arrived, or nothing at ``instant``, s."""
        inbox = self.port.inbox
        try:
            data = inbox.get(timeout=max(instant - self._clock(), 0.0))
            while not inbox.empty():
                data += inbox.get_nowait()
        except Empty:
            return b""
        return data
