"""The acceptance of a bench over a real pseudo-terminal; every byte goes through kernel and link.

Time is virtual, so that a busy machine can be slow but not late; one test runs in real time, and
waits for what happens rather than for a time.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hardware_eval import cli
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.emulation.simulated import SimulatedHal, simulated_lung
from hardware_eval.results import evaluate
from hardware_eval.results.evaluate import Line
from hardware_eval.wire.client import Client, Link, RefusedError
from hardware_eval.wire.messages import Capability, Flag, Mode
from ventbench.board import record
from ventbench.board.record import HardwareRecord
from ventbench.cli import app as ventbench

LUNG, OTHER = "R20C50", "R5C20"

#: Patience with a busy machine, s; bytes that do not come by then are lost.
PATIENCE = 600.0


class DeviceOnTerminal(LoopbackDevice):
    """A device whose bytes all pass a pseudo-terminal, while time stands still."""

    def __init__(self, hal: SimulatedHal) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.link = Link(os.ttyname(self._slave))
        self.carried = 0
        super().__init__(hal)

    def write(self, data: bytes) -> None:
        self.link.write(data)
        arrived = b""
        while len(arrived) < len(data):
            assert select.select([self._master], [], [], PATIENCE)[0], "the terminal lost bytes"
            arrived += os.read(self._master, len(data) - len(arrived))
        self.carried += len(arrived)
        super().write(arrived)

    def read(self, timeout: float) -> bytes:
        data, arrived = super().read(timeout), b""
        os.write(self._master, data)
        end = time.monotonic() + PATIENCE
        while len(arrived) < len(data):
            assert time.monotonic() < end, "the terminal lost bytes"
            arrived += self.link.read(PATIENCE)
        return arrived

    def end(self) -> None:
        self.link.close()
        os.close(self._master)
        os.close(self._slave)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[DeviceOnTerminal]:
    device = DeviceOnTerminal(simulated_lung(LUNG))

    def connect(port: str, confirmed: bool = True) -> Line:
        client = Client(device, device.clock)
        client.hello()
        return Line(client, device.clock)

    monkeypatch.setattr(evaluate, "connect", connect)
    yield device
    device.end()


def invoke(app: Any, *words: str) -> Any:
    return CliRunner().invoke(app, list(words))


def test_a_run_over_a_terminal(
    terminal: DeviceOnTerminal, tmp_path: Path, scored_only: Path
) -> None:
    done = invoke(
        cli.app,
        "run",
        "pid_best",
        "--port",
        "p",
        "--lung",
        LUNG,
        "--pips",
        "10",
        "--repeats",
        "1",
        "--plan",
        str(scored_only),
        "--in-process",
        "--yes",
        "--out",
        str(tmp_path / "out"),
    )
    assert done.exit_code == 0, done.output
    assert terminal.carried > 10_000


@pytest.mark.slow
def test_self_test_wrong_lung_run_and_board(terminal: DeviceOnTerminal, tmp_path: Path) -> None:
    sheet = invoke(cli.app, "selftest", "--port", "p", "--lung", LUNG)
    assert sheet.exit_code == 0, sheet.output
    assert f"self-test of {LUNG}: GO" in sheet.output
    wrong = invoke(cli.app, "selftest", "--port", "p", "--lung", OTHER)
    assert wrong.exit_code == 1
    assert f"is the lung set to {LUNG}?" in wrong.output
    out = tmp_path / "out"
    done = invoke(
        cli.app,
        "run",
        "pid_best",
        "--port",
        "p",
        "--lung",
        LUNG,
        "--pips",
        "10",
        "--repeats",
        "1",
        "--in-process",
        "--yes",
        "--out",
        str(out),
        "--json",
        str(tmp_path / "done.json"),
    )
    assert done.exit_code == 0, done.output
    path = json.loads((tmp_path / "done.json").read_text())["records"]["pid_best"]
    board = tmp_path / "leaderboard"
    shutil.copytree(Path(__file__).parents[3] / "leaderboard", board)
    added = invoke(ventbench, "board", "add", path, "--folder", str(board))
    assert added.exit_code == 0, added.output
    built = invoke(
        ventbench, "board", "build", "--folder", str(board), "--out", str(tmp_path / "site")
    )
    assert built.exit_code == 0, built.output
    made = record.load(Path(path))
    assert isinstance(made, HardwareRecord)
    page = (tmp_path / "site" / "index.html").read_text()
    assert f"{made.score:.3f}" in page
    assert all(word in page for word in ("hardware", "gap", "emulator"))


@pytest.mark.slow
def test_an_emulator_of_its_own_vents_when_its_host_falls_silent(tmp_path: Path) -> None:
    """In real time, each step as soon as the last one has happened: nothing must be in time."""
    link = tmp_path / "lung"
    command = [sys.executable, "-m", "hardware_eval", "emulate", "--link", str(link)]
    emulator = subprocess.Popen(
        [*command, "--lung", LUNG, "--simulator", "single_compartment"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert emulator.stdout is not None
        assert emulator.stdout.readline().strip(), emulator.communicate()[1]
        client = Client(Link(str(link)), timeout=PATIENCE)
        welcome = client.hello()
        assert LUNG in welcome.name
        assert Capability.SIMULATED in welcome.capabilities
        end = time.monotonic() + PATIENCE
        # A busy machine may be so slow that the watchdog vents between two messages: once more.
        while not _obeyed(client):
            assert time.monotonic() < end, "the device never ran"
        while (reading := client.heartbeat()).mode is not Mode.VENTED:
            assert time.monotonic() < end, "the watchdog did not vent"
        assert Flag.COMMANDS_STOPPED in reading.flags
        assert (reading.u_in, reading.u_out) == (0.0, 1)
        client.close()
    finally:
        emulator.terminate()
        _, told = emulator.communicate()
    assert emulator.returncode == 0, told
    assert not link.is_symlink()


def _obeyed(client: Client) -> bool:
    """Arm and inspire a little; whether the valves moved before the watchdog vented."""
    client.arm()
    with contextlib.suppress(RefusedError):
        reading = client.command(10.0, 0)
        return reading.mode is Mode.RUNNING and reading.u_in == 10.0
    return False
