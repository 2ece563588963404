"""A firmware image as an emulated device: its UART, and the bus to the emulated electronics.

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
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cobs import cobs

from hardware_eval.device.program import Sample
from hardware_eval.emulation import electronics
from hardware_eval.emulation.electronics import Fault
from hardware_eval.wire.messages import (
    FLOW_STEPS,
    PRESSURE_STEPS,
    U_IN_STEPS,
    Flag,
    checked,
    fixed_point,
    to_frame,
    with_crc,
)
from ventbench.base.errors import InputError

#: Pause after which the thread of the sensors looks whether it is to end, s.
_LOOK = 0.1

_EMULATOR = "qemu-system-arm"

#: Largest pressure that the bus can tell, and what says that the sensor has no end, 0.01 cmH2O.
_ENDLESS = 0x7FFFFFFF

_ORDER = struct.Struct("<cQHB")  # device time, us; u_in, 0.01 %; u_out
_SAMPLE = struct.Struct("<chhBI")  # pressure, 0.01 cmH2O; flow, mL/s; 1 saturated; a count
_IDENTITY = struct.Struct("<c8s32sHiB")  # as in Identity, highest in 0.01 cmH2O


@dataclass(frozen=True, slots=True)
class Order:
    """Last order of the firmware: device time, s, u_in, %, and u_out; it does not tell causes."""

    time: float = 0.0
    u_in: float = 0.0
    u_out: int = 1
    causes: Flag = Flag.NONE


class Firmware:
    """An image that runs, in place of the program and of its hardware.

    Attributes:
        state: last order.
        lost: whether it has ended.
        told: what the electronics are.
    """

    def __init__(self, image: Path, given: dict[str, Any], begun: float) -> None:
        """Start the electronics for an image; ``given`` and ``begun`` as of `EmulatedHal`.

        Raises:
            InputError: if the image or its emulator is not there, or the lung cannot be as asked.
        """
        self._command = _command(image)
        self.state, self.lost = Order(), False
        self._faults: tuple[Fault, ...] = tuple(given["faults"])
        self._answers: deque[bytes] = deque()
        self._image: subprocess.Popen[bytes] | None = None
        self._ended, self._asking = threading.Event(), threading.Lock()
        self._threads: list[threading.Thread] = []
        self._uart, self._bus = socket.socketpair(), socket.socketpair()
        self._electronics, self._sensors, self._pins = electronics.switch_on(
            {**given, "begun": begun}
        )
        try:
            identity, self.told = electronics.introduced(self._sensors)
        except InputError:
            self.close()
            raise
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
        self._image = subprocess.Popen(
            [part.format(host=host, bus=bus) for part in self._command],
            stdin=host,
            stdout=host,
            pass_fds=(host, bus),
            start_new_session=True,
            env={**os.environ, "VENTILATOR_BUS": str(bus)},
        )
        for line in (self._uart, self._bus):
            line[1].close()
        for work in (lambda: self._listen(wake), self._order, self._measure):
            self._threads.append(threading.Thread(target=work, daemon=True))
            self._threads[-1].start()

    @property
    def processes(self) -> dict[str, int]:
        """Process ids: what a test kills, and what must live on."""
        image = {} if self._image is None else {"device": self._image.pid}
        return {**image, "electronics": self._electronics.pid}

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

    @property
    def hal(self) -> Firmware:
        """Where faults are put."""
        return self

    @property
    def faults(self) -> tuple[Fault, ...]:
        """What goes wrong with the lung."""
        return self._faults

    @faults.setter
    def faults(self, faults: Sequence[Fault]) -> None:
        self._faults = tuple(faults)
        with self._asking:
            self._sensors.send(self._faults)

    def close(self) -> None:
        """End the image and the electronics."""
        self._ended.set()
        if self._image is not None:
            self._image.kill()  # SIGTERM makes QEMU complain
            self._image.wait()
        for thread in self._threads:
            thread.join()
        for line in (*self._uart, *self._bus, self._sensors, self._pins):
            line.close()
        self._electronics.wait()

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
        """Give each order to the pins, and ask the sensors."""
        rest = b""
        with contextlib.suppress(OSError):
            while data := self._bus[0].recv(4096):
                *frames, rest = (rest + data).split(b"\0")
                for frame in frames:
                    order = _content(frame)
                    if order is not None and len(order) == _ORDER.size:
                        kind, time, u_in, u_out = _ORDER.unpack(order)
                        if kind == b"?":
                            self._send(self._identity)
                        self.state = Order(time / 1e6, u_in / U_IN_STEPS, u_out)
                        self._pins.sendall(electronics.LINES.pack(self.state.u_in, u_out))
                        with self._asking:
                            self._sensors.send("sample")
        self.lost = not self._ended.is_set()

    def _measure(self) -> None:
        """Give samples to the image."""
        count = 0
        with contextlib.suppress(OSError, EOFError):
            while not self._ended.is_set():
                if self._sensors.poll(_LOOK):
                    sample: Sample = self._sensors.recv()
                    count = (count + 1) & 0xFFFFFFFF
                    pressure = fixed_point(sample.pressure, PRESSURE_STEPS)
                    flow = fixed_point(sample.flow, FLOW_STEPS)
                    self._send(_SAMPLE.pack(b"S", pressure, flow, sample.saturated, count))


def _content(frame: bytes) -> bytes | None:
    """What is in the bytes between two zeros; None if it is no frame."""
    try:
        return checked(cobs.decode(frame)) if frame else None
    except cobs.DecodeError:
        return None


def _command(image: Path) -> list[str]:
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
    lines = [
        part
        for line in ("host", "bus")
        for part in (
            "-chardev",
            f"socket,id={line},fd={{{line}}}",
            "-serial",
            f"chardev:{line}",
        )
    ]
    machine = ["-M", "mps2-an385", "-icount", "shift=5", "-display", "none", "-monitor", "none"]
    return [_EMULATOR, *machine, *lines, "-kernel", str(image)]
