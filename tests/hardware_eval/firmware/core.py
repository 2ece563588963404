"""The firmware's core, compiled for this machine, behind a pipe; also on a virtual clock."""

from __future__ import annotations

import contextlib
import math
import shutil
import struct
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from hardware_eval.device.program import Hal, Identity, Sample
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.wire.messages import Mode, microseconds
from ventbench.task import protocol

HERE = Path(__file__).parent
FIRMWARE = HERE.parents[2] / "hardware_eval" / "firmware"

STRICT = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion")
SANITIZED = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")

_REQUEST, _HEAD, _TAIL = struct.Struct("<QQhhBI"), struct.Struct("<I"), struct.Struct("<BBHH")


def tool(*names: str) -> str:
    """Path of the first program that is there; the test is skipped where none is."""
    for name in names:
        if path := shutil.which(name):
            return path
    pytest.skip(f"{' or '.join(names)} is not installed")


def compiled(
    out: Path, main: str, *options: str, firmware: Path = FIRMWARE, warn: bool = True
) -> Path:
    """Compile a program of this folder with the core.

    Args:
        out: program to make.
        main: its file in this folder.
        options: for the compiler.
        firmware: folder of the core.
        warn: whether warnings are errors.
    """
    sources = [HERE / main, firmware / "device.c", firmware / "wire.c"]
    strict = (*STRICT, "-Werror") if warn else ("-std=c11", "-w")
    subprocess.run(
        [tool("cc", "gcc"), *strict, *options, f"-I{firmware}", *map(str, sources), "-o", str(out)],
        check=True,
    )
    return out


def hundredths(value: float) -> int:
    """A pressure as firmware has it, 0.01 cmH2O."""
    return max(-32767, min(32767, round(100.0 * value))) if math.isfinite(value) else -32768


class Core:
    """The core in a process of its own.

    Attributes:
        valves: u_in, 0.01 %, and u_out, after the last step.
        mode: after the last step.
        causes: after the last step.
    """

    def __init__(
        self, program: Path, identity: Identity, begun: float = 0.0, limit: float = 60.0
    ) -> None:
        """Start it, vented, at ``begun``, s, with a pressure limit, cmH2O."""
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        name = identity.name.encode()[:32]
        highest = hundredths(identity.highest) if identity.highest < 327.0 else 0x7FFFFFFF
        self._write(
            struct.pack("<Q", microseconds(begun))
            + identity.device_id
            + identity.calibration
            + struct.pack(
                "<BHHiB",
                identity.noisy,
                identity.capabilities,
                hundredths(limit),
                highest,
                len(name),
            )
            + name
        )
        self.valves, self.mode, self.causes = (0, 1), Mode.CLOSED, 0

    def steps(
        self, steps: Sequence[tuple[int, Sample, bytes]]
    ) -> list[tuple[bytes, int, int, int, int]]:
        """Step at times, us, with samples and bytes.

        Returns:
            For each step: answers, mode, u_out, u_in in 0.01 %, causes.
        """
        for now, sample, data in steps:
            flow = -32768 if math.isnan(sample.flow) else round(sample.flow)
            marks = sample.saturated + 2 * sample.lapsed
            self._write(
                _REQUEST.pack(
                    now,
                    microseconds(sample.time),
                    hundredths(sample.pressure),
                    flow,
                    marks,
                    len(data),
                )
                + data
            )
        assert self._process.stdin is not None
        self._process.stdin.flush()
        return [self._reply() for _ in steps]

    def end(self) -> None:
        """End the process; a sanitizer's complaint is an error."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        assert self._process.wait() == 0

    def _write(self, data: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(data)

    def _reply(self) -> tuple[bytes, int, int, int, int]:
        assert self._process.stdout is not None
        read = self._process.stdout.read
        (length,) = _HEAD.unpack(read(_HEAD.size))
        return read(length), *_TAIL.unpack(read(_TAIL.size))


class CoreService:
    """The core in place of :class:`~hardware_eval.device.program.DeviceService`."""

    def __init__(self, program: Path, hal: Hal, now: float, own_limit: float) -> None:
        self.hal = hal
        self.core = Core(program, hal.identity, now, own_limit)
        self.state = SimpleNamespace(u_in=0.0, u_out=1, mode=Mode.CLOSED, causes=0)
        hal.actuate(now, 0.0, 1)

    def step(self, now: float, data: bytes = b"") -> bytes:
        """Guard the lung and do what arrived."""
        step = (microseconds(now), self.hal.sample(now), data)
        ((answers, mode, u_out, u_in, causes),) = self.core.steps([step])
        self.state = SimpleNamespace(u_in=u_in / 100, u_out=u_out, mode=Mode(mode), causes=causes)
        self.hal.actuate(now, self.state.u_in, u_out)
        return answers


@contextlib.contextmanager
def loopback(
    program: Path, hal: Hal, own_limit: float = protocol.SAFETY_PRESSURE
) -> Iterator[LoopbackDevice]:
    """The core on a virtual clock."""
    device = LoopbackDevice(hal, own_limit)
    service = CoreService(program, hal, device.start, own_limit)
    device.service = service  # type: ignore[assignment]
    try:
        yield device
    finally:
        service.core.end()
