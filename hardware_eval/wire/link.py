"""A serial line to a device: anything that pyserial opens, with errors that say what to do."""

from __future__ import annotations

import errno
import time
from dataclasses import dataclass
from typing import cast

import serial

from hardware_eval.wire.errors import (
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

#: A wait for bytes ends this late at most, s.
READ_SLICE = 0.002


@dataclass(frozen=True, slots=True)
class ReconnectPolicy:
    """How to try again when a port has gone.

    Attributes:
        first: pause before the second attempt, s.
        factor: by which each pause exceeds the one before.
        longest: longest pause, s.
        patience: time after which to give up, s.
    """

    first: float = 0.1
    factor: float = 1.5
    longest: float = 2.0
    patience: float = 60.0


class Link:
    """An open port.

    Attributes:
        url: a device such as ``/dev/ttyACM0``, ``socket://host:port`` or ``loop://``.
    """

    def __init__(
        self, url: str, baud_rate: int = BAUD_RATE, policy: ReconnectPolicy | None = None
    ) -> None:
        """Open a port.

        Args:
            url: whatever :func:`serial.serial_for_url` takes.
            baud_rate: bits per second.
            policy: of :meth:`reopen`.

        Raises:
            PortMissingError: if there is no such port.
            PortBusyError: if another program has it.
            PortForbiddenError: if the user may not open it.
            LinkError: if it cannot be opened for another reason.
        """
        self.url = url
        self._baud_rate = baud_rate
        self._policy = policy or ReconnectPolicy()
        self._port = self._open()

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            DisconnectedError: if the port has gone.
        """
        try:
            self._port.write(data)
        except (OSError, serial.SerialException) as error:
            raise self._disconnected(error) from error

    def read(self, timeout: float) -> bytes:
        """Wait for bytes; empty if none come within ``timeout``, s.

        Raises:
            DisconnectedError: if the port has gone.
        """
        end = time.monotonic() + timeout
        try:
            while True:
                if data := self._port.read(1):
                    waiting = self._port.in_waiting
                    return data + self._port.read(waiting) if waiting else data
                if time.monotonic() >= end:
                    return b""
        except (OSError, TypeError, serial.SerialException) as error:
            raise self._disconnected(error) from error

    def close(self) -> None:
        """Release the port."""
        self._port.close()

    def reopen(self) -> None:
        """Open the port again, and try until the policy's patience ends.

        Raises:
            LinkError: the last one, if the port does not come back.
        """
        self.close()
        pause, end = self._policy.first, time.monotonic() + self._policy.patience
        while True:
            try:
                self._port = self._open()
                return
            except LinkError as error:
                if time.monotonic() + pause > end:
                    raise type(error)(f"{error} (tried for {self._policy.patience:g} s)") from error
            time.sleep(pause)
            pause = min(pause * self._policy.factor, self._policy.longest)

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
