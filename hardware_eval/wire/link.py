"""A serial line to a device: anything that pyserial opens, with errors that say what to do.

Two threads read and write the port. Even where neither has to wait for the device, both can take
long on a busy machine: the kernel moves the bytes of a terminal in threads of ordinary priority,
and waits for them. The control loop puts bytes into a queue and takes them out of one, so that the
port never holds it up.
"""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections.abc import Iterator
from queue import Empty, SimpleQueue
from typing import cast

import serial

from hardware_eval.realtime import take_priority
from hardware_eval.wire.client import (
    DisconnectedError,
    LinkError,
    PortBusyError,
    PortForbiddenError,
    PortMissingError,
)

#: Bits per second; USB devices ignore it. A control step then takes 9 ms of a real UART.
BAUD_RATE = 115_200

#: Longest time in which the port does not take what is written, s.
WRITE_TIMEOUT = 1.0

#: The reading thread looks this often whether the port is to be closed, s.
READ_SLICE = 0.05


#: When a port has gone: the first pause between two attempts to open it, s, the factor by which
#: each pause exceeds the one before, and the longest, s.
_PAUSE, _FACTOR, _LONGEST_PAUSE = 0.1, 1.5, 2.0


class _Traffic:
    """The threads of an open port.

    Attributes:
        outbox: what is to be sent; None ends the thread.
        broken: what went wrong with the port; None if nothing did.
    """

    def __init__(self, port: serial.Serial) -> None:
        self.outbox: SimpleQueue[bytes | None] = SimpleQueue()
        self.broken: Exception | None = None
        self._inbox: SimpleQueue[bytes] = SimpleQueue()
        self._port, self._ended = port, False
        self._threads = [
            threading.Thread(target=work, name=f"port {work.__name__}", daemon=True)
            for work in (self._receive, self._send)
        ]
        for thread in self._threads:
            thread.start()

    def take(self, timeout: float) -> bytes:
        """What arrived; waits ``timeout``, s, if nothing has."""
        try:
            data = self._inbox.get(timeout=max(timeout, 0.0))
            while not self._inbox.empty():
                data += self._inbox.get_nowait()
        except Empty:
            return b""
        return data

    def end(self) -> None:
        """End both threads, once what is left has been sent."""
        self._ended = True
        self.outbox.put(None)
        for thread in self._threads:
            thread.join()

    def _receive(self) -> None:
        take_priority()
        with self._breaks():
            while not self._ended and self.broken is None:
                if data := self._port.read(1):
                    waiting = self._port.in_waiting
                    self._inbox.put(data + self._port.read(waiting) if waiting else data)

    def _send(self) -> None:
        take_priority()
        with self._breaks():
            while (data := self.outbox.get()) is not None:
                self._port.write(data)

    @contextlib.contextmanager
    def _breaks(self) -> Iterator[None]:
        try:
            yield
        except (OSError, TypeError, serial.SerialException) as error:
            self.broken = self.broken or error
            self._inbox.put(b"")  # wakes whoever waits


class Link:
    """An open port.

    Attributes:
        url: a device such as ``/dev/ttyACM0``, ``socket://host:port`` or ``loop://``.
    """

    def __init__(self, url: str, baud_rate: int = BAUD_RATE, patience: float = 60.0) -> None:
        """Open a port.

        Args:
            url: whatever :func:`serial.serial_for_url` takes.
            baud_rate: bits per second.
            patience: time after which :meth:`reopen` gives up, s.

        Raises:
            LinkError: if it cannot be opened: PortMissingError, PortBusyError and
                PortForbiddenError say why.
        """
        self.url = url
        self._baud_rate, self._patience = baud_rate, patience
        self._port = self._open()
        self._traffic = _Traffic(self._port)

    def write(self, data: bytes) -> None:
        """Send bytes; returns before they are sent. DisconnectedError if the port has gone."""
        if self._traffic.broken is not None:
            raise self._disconnected(self._traffic.broken)
        self._traffic.outbox.put(data)

    def read(self, timeout: float) -> bytes:
        """Wait for bytes; empty if none come within ``timeout``, s, or DisconnectedError."""
        data = self._traffic.take(timeout)
        if not data and self._traffic.broken is not None:
            raise self._disconnected(self._traffic.broken)
        return data

    def close(self) -> None:
        """Send what is left, and release the port."""
        self._traffic.end()
        self._port.close()

    def reopen(self) -> None:
        """Open the port again, and try until the patience ends.

        Raises:
            LinkError: the last one, if the port does not come back.
        """
        self.close()
        pause, end = min(_PAUSE, self._patience), time.monotonic() + self._patience
        while True:
            try:
                self._port = self._open()
                self._traffic = _Traffic(self._port)
                return
            except LinkError as error:
                if time.monotonic() + pause > end:
                    raise type(error)(f"{error} (tried for {self._patience:g} s)") from error
            time.sleep(pause)
            pause = min(pause * _FACTOR, _LONGEST_PAUSE)

    def _open(self) -> serial.Serial:
        try:
            port = serial.serial_for_url(self.url, self._baud_rate, do_not_open=True)
            if isinstance(port, serial.Serial):
                port.exclusive = True  # a second program would steal bytes
            port.write_timeout = WRITE_TIMEOUT
            port.timeout = READ_SLICE  # fixed: pyserial configures the port anew at each change
            port.open()
        except ValueError as error:
            raise PortMissingError(
                f"port {self.url!r}: {error}; write a device such as /dev/ttyACM0, or "
                "socket://HOST:PORT"
            ) from error
        except (OSError, serial.SerialException) as error:
            raise self._not_opened(error) from error
        return cast(serial.Serial, port)  # others, such as sockets, have the same methods

    def _not_opened(self, error: OSError) -> LinkError:
        number = error.errno or getattr(error.__cause__ or error.__context__, "errno", None)
        if number in (errno.EACCES, errno.EPERM):
            return PortForbiddenError(
                f"port {self.url}: you may not open it; join its group (on Debian: sudo usermod "
                "-aG dialout $USER, then log in again)"
            )
        if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "lock" in str(error):
            return PortBusyError(
                f"port {self.url}: another program has it; close that program (fuser {self.url} "
                "names it)"
            )
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ECONNREFUSED):
            return PortMissingError(
                f"port {self.url}: it is not there ({error.strerror or error}); is the cable in "
                "and the device on? `python -m serial.tools.list_ports` lists the ports"
            )
        return LinkError(f"port {self.url} cannot be opened: {error}")

    def _disconnected(self, error: Exception) -> DisconnectedError:
        return DisconnectedError(
            f"port {self.url} went away: {error}; the device vents the lung by itself"
        )
