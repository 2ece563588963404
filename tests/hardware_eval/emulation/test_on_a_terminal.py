"""The acceptance of a bench over a real pseudo-terminal; every byte goes through kernel and link.

Time is virtual, so that a busy machine can be slow but not late; one test runs in real time, and
holds that a test that a busy machine spoils says so.
"""

from __future__ import annotations

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
from hardware_eval.device.program import DeviceSettings
from hardware_eval.emulation.loopback import LoopbackDevice
from hardware_eval.emulation.simulated import SimulatedHal, simulated_lung
from hardware_eval.results import evaluate
from hardware_eval.results.evaluate import Line
from hardware_eval.wire.client import Client
from hardware_eval.wire.link import Link
from ventbench.board import record
from ventbench.board.hardware import HardwareRecord
from ventbench.cli import app as ventbench

LUNG, OTHER = "R20C50", "R5C20"

#: Patience with a busy machine, s; bytes that do not come by then are lost.
PATIENCE = 60.0


class DeviceOnTerminal(LoopbackDevice):
    """A device whose bytes all pass a pseudo-terminal, while time stands still."""

    def __init__(self, hal: SimulatedHal) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.link = Link(os.ttyname(self._slave))
        self.carried = 0
        super().__init__(hal, DeviceSettings())

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

    def connect(port: str) -> Line:
        client = Client(device, device.clock)
        client.hello()
        return Line(client, device.clock)

    monkeypatch.setattr(evaluate, "connect", connect)
    yield device
    device.end()


def invoke(app: Any, *words: str) -> Any:
    return CliRunner().invoke(app, list(words))


def test_a_run_over_a_terminal(terminal: DeviceOnTerminal, tmp_path: Path) -> None:
    done = invoke(
        cli.app, "run", "pid_best", "--port", "p", "--lung", LUNG, "--pips", "10", "--repeats", "1",
        "--control-every", "0", "--no-dry-run", "--no-selftest", "--no-sandbox", "--rest", "0.5",
        "--yes", "--out", str(tmp_path / "out"),
    )  # fmt: skip
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
        cli.app, "run", "pid_best", "--port", "p", "--lung", LUNG, "--pips", "10,20",
        "--repeats", "2", "--no-sandbox", "--yes", "--out", str(out),
        "--json", str(tmp_path / "done.json"),
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    path = json.loads((tmp_path / "done.json").read_text())["records"]["pid_best"]
    board = tmp_path / "leaderboard"
    shutil.copytree(Path(__file__).parents[3] / "leaderboard", board)
    added = invoke(ventbench, "board", "add", path, "--folder", str(board))
    assert added.exit_code == 0, added.output
    built = invoke(ventbench, "board", "build", "--folder", str(board))
    assert built.exit_code == 0, built.output
    made = record.load(Path(path))
    assert isinstance(made, HardwareRecord)
    page = (board / "version-1.html").read_text()
    assert f"{made.score:.3f}" in page
    assert all(word in page for word in ("hardware", "gap", "emulator"))


@pytest.mark.slow
def test_in_real_time_it_goes_or_says_that_the_machine_is_busy(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hardware_eval"]
    emulator = subprocess.Popen(
        [*command, "emulate", "--lung", LUNG, "--link", str(tmp_path / "lung")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert emulator.stdout is not None
        port = emulator.stdout.readline().strip()
        assert port, emulator.communicate()[1]
        tested = [*command, "selftest", "--port", port, "--lung", LUNG]
        done = subprocess.run(tested, capture_output=True, text=True, timeout=900, check=False)
    finally:
        emulator.terminate()
        emulator.communicate()
    told = done.stdout + done.stderr
    failed = {line.split()[1] for line in told.splitlines() if line.startswith("  NO-GO")}
    # What a machine may lack is time. Nothing may be wrong with the lung or its tubes.
    assert failed <= {"interruptions", "on_time", "latest_step", "round_trip"}, told
    assert done.returncode == (1 if failed else 0) or "did not answer" in told, told
