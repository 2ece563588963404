"""Images of the firmware, on this computer and on a Cortex-M3 under QEMU, with an emulated lung.

They run in real time, on clocks of their own: bounds are those of the device's clock, so that a
busy machine can be slow but not late.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hardware_eval import cli, realtime
from hardware_eval.emulation.emulator import Emulator
from hardware_eval.emulation.firmware import Firmware, Order, command_of
from hardware_eval.wire.client import Client, Link, NoAnswerError, RefusedError
from hardware_eval.wire.conformance import conformance
from hardware_eval.wire.messages import Flag, Mode, Reason
from tests.hardware_eval.electronics import WiredHal
from tests.hardware_eval.firmware.core import FIRMWARE, tool

IMAGES = {"linux": "ventilator-linux", "mps2": "ventilator-mps2.elf"}

#: Patience with a busy machine, s; a healthy one needs a hundredth of it.
PATIENCE = 600.0

#: Time after which breaths that were judged are enough, s.
ENOUGH = 60.0

#: Time from order to order of a program that runs, s.
STEP = 0.005

LUNG = "R20C50"


def _made(board: str, folder: Path, firmware: Path = FIRMWARE) -> Path:
    tool({"linux": "cc", "mps2": "arm-none-eabi-gcc"}[board])
    subprocess.run(["make", "-s", "-C", str(firmware), f"OUT={folder}", board], check=True)
    return folder / IMAGES[board]


class Logged(Firmware):
    """Remembers all orders."""

    orders: list[Order]

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "state":
            self.__dict__.setdefault("orders", []).append(value)
        super().__setattr__(name, value)


@pytest.fixture(params=list(IMAGES))
def device(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Logged, Path]]:
    with _running(_made(request.param, tmp_path), tmp_path) as firmware:
        yield firmware, tmp_path


@contextlib.contextmanager
def _running(image: Path, tmp_path: Path) -> Iterator[Logged]:
    if image.suffix == ".elf":
        tool("qemu-system-arm")
    begun = time.monotonic()
    wired = WiredHal(LUNG, tmp_path / "electronics.csv", begun)
    firmware = Logged(command_of(image), wired, begun)
    emulator = Emulator(firmware, begun=begun, link=tmp_path / "lung")
    firmware.start(lambda: emulator.port.inbox.put(b""))
    # Should it get into a loop, or outlive this test, it does not take the processor with it.
    longest = realtime.LONGEST_RUN_S * 1_000_000
    assert firmware.image is not None
    device = firmware.image.pid
    resource.prlimit(device, resource.RLIMIT_RTTIME, (longest, longest))
    for task in Path(f"/proc/{device}/task").iterdir():
        with contextlib.suppress(OSError):  # where it is granted
            os.sched_setscheduler(
                int(task.name), os.SCHED_FIFO, os.sched_param(realtime.DEVICE_PRIORITY)
            )
    stop = threading.Event()
    thread = threading.Thread(target=emulator.run, args=(stop.is_set,))
    thread.start()
    try:
        yield firmware
    finally:
        stop.set()
        thread.join()
        firmware.close()
        wired.close()


def _until(done: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end
        time.sleep(0.005)


def _inspiring(firmware: Logged, client: Client) -> None:
    """Begin a breath; on a busy machine the link itself may be late, which vents."""
    for _ in range(20):
        firmware.orders.clear()
        with contextlib.suppress(AssertionError, NoAnswerError, RefusedError):
            client.hello()
            client.arm()
            client.heartbeat()
            assert client.command(25.0, 0).mode is Mode.RUNNING
            # It may have vented again before anybody looks.
            _until(lambda: any((x.u_in, x.u_out) == (25.0, 0) for x in list(firmware.orders)))
            return
    pytest.fail("no breath began")


def test_an_image_needs_neither_heap_nor_floating_point(tmp_path: Path) -> None:
    image = _made("mps2", tmp_path)
    names = subprocess.run(
        [tool("arm-none-eabi-nm"), str(image)], check=True, capture_output=True, text=True
    ).stdout
    assert "device_step" in names
    assert not re.search(r"malloc|sbrk|__aeabi_[fd]|__.*[sd]f[23]\b", names)


@pytest.mark.slow
def test_the_watchdog_vents_when_the_host_falls_silent(device: tuple[Logged, Path]) -> None:
    firmware, folder = device
    client = Client(Link(str(folder / "lung")), timeout=10.0)
    _until(lambda: firmware.orders[-1].time > 0.0)
    judged, start = 0, time.monotonic()
    # A dozen breaths in a minute; on a busy machine one, however long it takes.
    while judged < 12 and time.monotonic() - start < (ENOUGH if judged else PATIENCE):
        _inspiring(firmware, client)
        _until(lambda: firmware.state.u_out == 1)
        orders = list(firmware.orders)
        opened = next((k for k, order in enumerate(orders) if order.u_in == 25.0), None)
        if opened is None:
            continue
        vented = next(k for k in range(opened, len(orders)) if orders[k].u_out == 1)
        steps = np.diff([order.time for order in orders[opened : vented + 1]])
        assert orders[vented].u_in == 0.0
        # On a busy machine the program itself is held up, which may reset its board, or the
        # sensor's emulation, whose guard vents first: such breaths say nothing.
        try:
            flags = client.heartbeat().flags & ~Flag.DEVICE_LATE
        except (NoAnswerError, RefusedError):
            continue
        if steps.max() <= 2 * STEP and Flag.SENSOR_LOST not in flags:
            assert flags == Flag.COMMANDS_STOPPED
            assert steps.sum() <= 0.1
            judged += 1
    client.close()
    assert judged, "no breath was timed"


class DeviceClock(realtime.RealClock):
    """The device's own clock, by its orders every 5 ms."""

    def __init__(self, firmware: Logged) -> None:
        self._firmware = firmware
        self._seen = (firmware.state, time.monotonic())

    def now(self) -> float:
        """Time of the last order, and what has passed since, s."""
        order = self._firmware.state
        if order is not self._seen[0]:
            self._seen = order, time.monotonic()
        return order.time + min(time.monotonic() - self._seen[1], 0.005)

    def sleep_until(self, instant: float) -> None:
        """Wait for an order of that time, s."""
        while self.now() < instant:
            time.sleep(0.001)


@pytest.mark.slow
def test_an_image_conforms(device: tuple[Logged, Path]) -> None:
    firmware, folder = device
    _until(lambda: firmware.orders[-1].time > 0.0)
    link = Link(str(folder / "lung"))
    failed: list[str] = []
    for _ in range(10):
        firmware.orders.clear()
        clauses = conformance(link, DeviceClock(firmware))
        failed = [str(clause) for clause in clauses if clause.holds is False]
        steps = np.diff([order.time for order in list(firmware.orders)])
        on_time = steps.min() >= 0.0 and steps.max() <= 2 * STEP
        if not failed or (on_time and "the host was too slow" not in str(failed)):
            break  # else a busy machine held host or board up, or its watchdog reset it: again
    link.close()
    assert not failed


@pytest.mark.slow
def test_electronics_vent_when_the_image_stands_still(device: tuple[Logged, Path]) -> None:
    firmware, folder = device
    client = Client(Link(str(folder / "lung")), timeout=2.0)
    _until(lambda: firmware.orders[-1].time > 0.0)
    _inspiring(firmware, client)
    assert firmware.image is not None
    image = firmware.image.pid
    os.kill(image, signal.SIGSTOP)
    log = folder / "electronics.csv"
    _until(lambda: log.read_text().splitlines()[-1].endswith("0,1,monostable"))
    before = len(firmware.orders)
    os.kill(image, signal.SIGCONT)
    # It vents by itself, before anybody asks; what an order began before the pause may come first.
    _until(lambda: any((x.u_in, x.u_out) == (0.0, 1) for x in firmware.orders[before:]))
    _until(lambda: _says_that_it_vented(client))
    client.close()


def _says_that_it_vented(client: Client) -> bool:
    """A board that its watchdog has reset loses what arrives meanwhile, and knows no session."""
    try:
        return client.heartbeat().mode is Mode.VENTED
    except NoAnswerError:
        return False
    except RefusedError as error:
        return error.refusal.reason is Reason.SESSION


@pytest.mark.slow
def test_the_boards_watchdog_vents_and_resets_a_program_that_stands_still(tmp_path: Path) -> None:
    source = tmp_path / "firmware"
    shutil.copytree(FIRMWARE, source)
    loop, order = source / "main.c", "            order(device.u_in, device.u_out);\n"
    hang = f"{order}        while (device.u_in == 2500)\n            ;\n"
    assert loop.read_text().count(order) == 1
    loop.write_text(loop.read_text().replace(order, hang))
    tool("qemu-system-arm")
    with _running(_made("mps2", tmp_path, source), tmp_path) as firmware:
        client = Client(Link(str(tmp_path / "lung")), timeout=10.0)
        _until(lambda: firmware.orders[-1].time > 0.0)
        # A busy machine may hold the link up until the board has vented or lost the session.
        for _ in range(20):
            firmware.orders.clear()
            with contextlib.suppress(NoAnswerError, RefusedError):
                client.hello()
                client.arm()
                client.command(25.0, 0)
            if any(order.u_in == 25.0 for order in firmware.orders):
                break
        at = next(k for k, order in enumerate(firmware.orders) if order.u_in == 25.0)
        _until(lambda: len(firmware.orders) > at + 20)
        opened, vented = firmware.orders[at : at + 2]
        assert (opened.u_out, vented.u_in, vented.u_out) == (0, 0.0, 1)
        assert vented.time - opened.time <= 0.06  # the watchdog is told every 5 ms, and waits 50
        assert min(order.time for order in firmware.orders) < opened.time  # it has started anew
        with pytest.raises(RefusedError, match="SESSION"):
            client.heartbeat()
        client.close()


@pytest.mark.slow
def test_self_test_and_two_runs_on_an_emulated_microcontroller(
    tmp_path: Path, scored_only: Path
) -> None:
    image = _made("mps2", tmp_path)
    tool("qemu-system-arm")
    link, out = tmp_path / "lung", tmp_path / "out"
    emulator = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "hardware_eval",
            "emulate",
            "--firmware",
            str(image),
            "--lung",
            LUNG,
            "--link",
            str(link),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert emulator.stdout is not None
        assert emulator.stdout.readline().strip(), emulator.communicate()[1]
        sheet = CliRunner().invoke(cli.app, ["selftest", "--port", str(link), "--lung", LUNG])
        assert sheet.exit_code == 0, sheet.output
        assert f"self-test of {LUNG}: GO" in sheet.output
        done = CliRunner().invoke(
            cli.app,
            # At higher pressures the entry leaves its envelope, which the host sees to.
            [
                "run",
                "pid_best",
                "--port",
                str(link),
                "--lung",
                LUNG,
                "--pips",
                "10,20",
                "--repeats",
                "1",
                "--plan",
                str(scored_only),
                "--in-process",
                "--yes",
                "--out",
                str(out),
            ],
        )
        assert done.exit_code == 0, done.output
    finally:
        emulator.send_signal(signal.SIGINT)
        emulator.communicate(timeout=PATIENCE)
    assert emulator.returncode == 0
