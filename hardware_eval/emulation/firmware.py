"""A firmware image as an emulated device: its UART, and the bus to its sensors and valves.

An ``.elf`` runs under QEMU on an emulated MPS2 board with a Cortex-M3; any other file is a program
of this computer. Both are made by ``make`` in ``hardware_eval/firmware``; its ``main.c`` specifies
the bus. Where the computer is too busy for it, the emulated board's watchdog resets it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from hardware_eval.device.program import Hal
from hardware_eval.wire.messages import (
    FLOW_STEPS,
    PRESSURE_STEPS,
    U_IN_STEPS,
    content_of,
    fixed_point,
    to_frame,
    with_crc,
)
from ventbench.base.errors import InputError

_EMULATOR = "qemu-system-arm"

#: Largest pressure that the bus can tell, and what says that the sensor has no end, 0.01 cmH2O.
_ENDLESS = 0x7FFFFFFF

_ORDER = struct.Struct("<cQHB")  # device time, us; u_in, 0.01 %; u_out
_SAMPLE = struct.Struct("<chhBI")  # pressure, 0.01 cmH2O; flow, mL/s; 1 saturated; a count
_IDENTITY = struct.Struct("<c8s32sHiB")  # as in Identity, highest in 0.01 cmH2O


@dataclass(frozen=True, slots=True)
class Order:
    """Last order of the firmware: device time, s, u_in, %, and u_out."""

    time: float = 0.0
    u_in: float = 0.0
    u_out: int = 1


class Firmware:
    """An image that runs, in place of the program and of its hardware.

    Attributes:
        hal: sensors and valves.
        state: last order.
        lost: whether it has ended.
        image: process that runs the image; None before it starts.
    """

    def __init__(self, command: Sequence[str], hal: Hal, begun: float) -> None:
        """Prepare an image.

        Args:
            command: what runs it, of :func:`command_of`.
            hal: sensors and valves.
            begun: zero of their clock on ``time.monotonic``, s.
        """
        self._command = command
        self.hal, self._begun = hal, begun
        self.state, self.lost = Order(), False
        self._answers: deque[bytes] = deque()
        self.image: subprocess.Popen[bytes] | None = None
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        self._uart, self._bus = socket.socketpair(), socket.socketpair()
        identity = hal.identity
        endless = identity.highest > 327.0
        self._identity = _IDENTITY.pack(
            b"I",
            identity.device_id,
            identity.calibration,
            identity.capabilities,
            _ENDLESS if endless else round(PRESSURE_STEPS * identity.highest),
            identity.noisy,
        )

    def start(self, wake: Callable[[], None]) -> None:
        """Start the image, which has the priority of the caller.

        Args:
            wake: called when the image has answered its host.
        """
        host, bus = self._uart[1].fileno(), self._bus[1].fileno()
        self.image = subprocess.Popen(
            [part.format(host=host, bus=bus) for part in self._command],
            stdin=host,
            stdout=host,
            pass_fds=(host, bus),
            start_new_session=True,
            env={**os.environ, "VENTILATOR_BUS": str(bus)},
        )
        for line in (self._uart, self._bus):
            line[1].close()
        for work in (lambda: self._listen(wake), self._order):
            self._threads.append(threading.Thread(target=work, daemon=True))
            self._threads[-1].start()

    def step(self, now: float, data: bytes = b"") -> bytes:
        """Send bytes to the image; returns what it has answered since."""
        with contextlib.suppress(OSError):
            self._uart[0].sendall(data)
        answers = b""
        while self._answers:
            answers += self._answers.popleft()
        return answers

    def vent(self, now: float) -> None:
        """The image hangs up; see :meth:`close`."""

    def close(self) -> None:
        """End the image."""
        self._ended.set()
        if self.image is not None:
            self.image.kill()  # SIGTERM makes QEMU complain
            self.image.wait()
        for thread in self._threads:
            thread.join()
        for line in (*self._uart, *self._bus):
            line.close()

    def _send(self, content: bytes) -> None:
        with contextlib.suppress(OSError):
            self._bus[0].sendall(to_frame(with_crc(content)))

    def _listen(self, wake: Callable[[], None]) -> None:
        with contextlib.suppress(OSError):
            while data := self._uart[0].recv(4096):
                self._answers.append(data)
                wake()
        self.lost = not self._ended.is_set()

    def _order(self) -> None:
        """Give each order to the valves, and a sample to the image."""
        rest, count = b"", 0
        with contextlib.suppress(OSError):
            while data := self._bus[0].recv(4096):
                *frames, rest = (rest + data).split(b"\0")
                for frame in frames:
                    order = content_of(frame)
                    if isinstance(order, bytes) and len(order) == _ORDER.size:
                        kind, time_us, u_in, u_out = _ORDER.unpack(order)
                        if kind == b"?":
                            self._send(self._identity)
                        self.state = Order(time_us / 1e6, u_in / U_IN_STEPS, u_out)
                        now, count = time.monotonic() - self._begun, (count + 1) & 0xFFFFFFFF
                        self.hal.actuate(now, self.state.u_in, u_out)
                        sample = self.hal.sample(now)
                        pressure = fixed_point(sample.pressure, PRESSURE_STEPS)
                        flow = fixed_point(sample.flow, FLOW_STEPS)
                        self._send(_SAMPLE.pack(b"S", pressure, flow, sample.saturated, count))
        self.lost = not self._ended.is_set()


def command_of(image: Path) -> list[str]:
    """What runs an image, with places for the descriptors of host and bus.

    Raises:
        InputError: if it cannot run.
    """
    if not image.is_file():
        raise InputError(
            f"--firmware {image}: there is no such file; make it with `make` in "
            "hardware_eval/firmware"
        )
    if image.suffix != ".elf":
        return [str(image.resolve())]
    if shutil.which(_EMULATOR) is None:
        raise InputError(
            f"--firmware {image}: {_EMULATOR} is not installed (Debian: apt install {_EMULATOR})"
        )
    lines: list[str] = []
    for line in ("host", "bus"):
        lines += ["-chardev", f"socket,id={line},fd={{{line}}}", "-serial", f"chardev:{line}"]
    machine = ["-M", "mps2-an385", "-display", "none", "-monitor", "none"]
    return [_EMULATOR, *machine, *lines, "-kernel", str(image)]
