"""The line between host and device in a thread of its own, so that nothing on it holds up a loop.

Reading and writing a terminal can take long on a busy system, even where neither has to wait: the
kernel moves the bytes in threads of ordinary priority. The loop of host or device takes bytes from
a queue and leaves bytes in one; that takes microseconds.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from queue import Empty, Queue

from ventbench.base.errors import InputError

_CHUNK = 4096

#: While there is no line: how often it is asked for, s, and the pause after an error of that.
_AGAIN, _RETRY = 0.005, 1.0


class Port:
    """A line that is opened again when it breaks.

    Attributes:
        inbox: what arrived, in order.
        broken: whether a line has broken.
    """

    def __init__(
        self,
        open_line: Callable[[], int | None],
        close_line: Callable[[int], None],
        begin: Callable[[], object] = lambda: None,
    ) -> None:
        """Start the thread.

        Args:
            open_line: opens the line and returns its descriptor, non-blocking; None while there
                is none. It is asked again every 5 ms.
            close_line: closes a descriptor.
            begin: called in the thread when it begins.
        """
        # A signal whose handler outlasts the timeout would let SimpleQueue wait for ever.
        self.inbox: Queue[bytes] = Queue()
        self.broken = False
        self._outbox: deque[bytes] = deque()
        self._open_line, self._close_line, self._begin = open_line, close_line, begin
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        self._absent_until = 0.0
        self._ended = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, data: bytes) -> None:
        """Leave bytes to be written; what the line does not take is lost, as on a wire."""
        if not self._ended:
            self._outbox.append(data)
            self._nudge()

    def take(self, timeout: float) -> bytes:
        """What arrived; waits ``timeout``, s, if nothing has."""
        try:
            data = self.inbox.get(timeout=max(timeout, 0.0))
            while not self.inbox.empty():
                data += self.inbox.get_nowait()
        except Empty:
            return b""
        return data

    def close(self) -> None:
        """Write what is left, end the thread, and close the line."""
        if self._ended:
            return
        self._ended = True
        self._nudge()
        self._thread.join()
        for descriptor in (self._woken, self._wake):
            os.close(descriptor)

    def _nudge(self) -> None:
        with contextlib.suppress(BlockingIOError):  # full of nudges already
            os.write(self._wake, b"x")

    def _run(self) -> None:
        self._begin()
        line: int | None = None
        while not self._ended:
            if line is None and time.monotonic() >= self._absent_until:
                line = self._opened()
            sources = [self._woken] if line is None else [self._woken, line]
            ready, _, _ = select.select(sources, [], [], _AGAIN if line is None else None)
            if self._woken in ready:
                os.read(self._woken, _CHUNK)
            if line is not None and line in ready and not self._read(line):
                self._close_line(line)  # the other end hung up; the watchdog vents
                line = None
                self.broken = True
                self.inbox.put(b"")  # wakes who waits
            self._write(line)
        self._write(line)
        if line is not None:
            self._close_line(line)

    def _write(self, line: int | None) -> None:
        """Write what is to be sent; without a line it is lost."""
        while self._outbox:
            data = self._outbox.popleft()
            if line is not None:
                with contextlib.suppress(OSError):
                    os.write(line, data)

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
