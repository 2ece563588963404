"""What the valves do when nobody orders anything; and deaths of an emulated device's processes."""

from __future__ import annotations

import contextlib
import math
import os
import random
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from hardware_eval.device import deadman
from hardware_eval.device.deadman import MONOSTABLE
from hardware_eval.device.program import Sample
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.wire.client import Client, Link, LinkError, RefusedError
from hardware_eval.wire.messages import Mode
from tests.hardware_eval.electronics import Electronics
from tests.hardware_eval.stand_in import Bench

#: Patience with a busy machine, s.
PATIENCE = 600.0


@pytest.mark.parametrize("normally_open", [True, False])
def test_what_the_valves_do_when_nobody_orders_anything(normally_open: bool) -> None:
    alone = Electronics(normally_open, math.inf, (50.0, 0))
    assert alone.valves(1e6) == (50.0, 0, "lines")  # pins keep their level
    guarded = Electronics(normally_open, MONOSTABLE, (50.0, 0), beat=1.0)
    assert guarded.valves(0.999 + MONOSTABLE) == (50.0, 0, "lines")
    assert guarded.valves(1.001 + MONOSTABLE) == (0.0, 1, "monostable")
    unpowered = Electronics(normally_open, MONOSTABLE, (50.0, 0), beat=1.0, powered=False)
    # Closed without current, nothing can open it.
    assert unpowered.valves(1.0) == (0.0, int(normally_open), "supply")


class Layers(Bench):
    """A sensor, and valves behind a deadman and a monostable, in virtual time."""

    def __init__(self, normally_open: bool) -> None:
        super().__init__()
        self.guard, self.electronics = deadman.Deadman(0.0), Electronics(normally_open)
        self.blocked = math.inf

    def sample(self, now: float) -> Sample:
        return Sample(min(now, self.blocked), 5.0)

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        self.obey(now, struct.pack("<fB", u_in, u_out))

    def obey(self, now: float, orders: bytes = b"") -> None:
        """Let the deadman look at orders, and tell the pins if there is something to tell."""
        before, self.guard = self.guard, deadman.step(self.guard, now, orders)
        if orders or before.valves != self.guard.valves:
            self.electronics = replace(self.electronics, lines=self.guard.valves, beat=now)

    def vented(self, now: float) -> bool:
        return self.electronics.valves(now)[:2] == (0.0, 1)


#: Stated bounds of the documentation's table, s.
BOUNDS = {"host": 0.100, "stopped": deadman.BOUND, "both": 0.100, "bus": 0.070, "supply": 0.010}


@pytest.mark.parametrize("normally_open", [True, False], ids=["open", "closed"])
@pytest.mark.parametrize("death", sorted(BOUNDS))
@pytest.mark.parametrize("deaths", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_deaths_in_inspirations_are_vented_within_their_bounds(
    deaths: int, death: str, normally_open: bool
) -> None:
    draw = random.Random(deaths)
    for _ in range(deaths):
        layers = Layers(normally_open)
        device = LoopbackDevice(layers)
        client = Client(device, device.clock)
        client.hello()
        client.arm()
        end = device.clock.now() + draw.uniform(0.05, 0.12)
        commanded = -1.0
        while (now := device.clock.now()) < end:
            if now - commanded >= 0.03:
                client.command(20.0, 0)
                commanded = now
            device.clock.advance(1e-3 * draw.random())
        died = now
        assert not layers.vented(now)
        if death == "bus":
            layers.blocked = now
        layers.electronics = replace(layers.electronics, powered=death != "supply")
        while not layers.vented(now) and now - died < 0.2:
            now += 0.5e-3
            if death in ("host", "bus"):  # the device lives
                if death == "bus" and now - commanded >= 0.03:
                    commanded = now
                    with contextlib.suppress(RefusedError):
                        client.command(20.0, 0)
                device.clock.sleep_until(now)
                now = device.clock.now()
            elif death == "stopped":  # the deadman lives
                layers.obey(now)
        if death == "supply" and not normally_open:
            assert not layers.vented(now)  # nothing can open it
        else:
            assert now - died <= BOUNDS[death]


def inspire(client: Client, until: Callable[[], bool]) -> None:
    """Keep a lung inspired until something happened."""
    end = time.monotonic() + PATIENCE
    while not until():
        assert time.monotonic() < end
        with contextlib.suppress(LinkError):  # a busy machine was late
            if client.heartbeat().mode is not Mode.RUNNING:
                client.arm()
            client.command(10.0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("normally", [[], ["--normally-closed"]], ids=["open", "closed"])
@pytest.mark.parametrize(
    ("dies", "how", "decides"),
    [
        ("device", signal.SIGKILL, "lines"),
        ("device", signal.SIGSTOP, "lines"),
        ("deadman", signal.SIGKILL, "monostable"),
        ("electronics", signal.SIGUSR1, "supply"),
    ],
)
def test_a_death_in_an_inspiration_vents(
    dies: str, how: int, decides: str, normally: list[str], tmp_path: Path
) -> None:
    link, log = tmp_path / "lung", tmp_path / "valves.csv"
    emulator = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tests.hardware_eval.electronics",
            "--link",
            str(link),
            "--valves",
            str(log),
            "--program",
            str(tmp_path / "program.csv"),
            *normally,
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert emulator.stdout is not None
    ids = dict(re.findall(r"(\w+) (\d+)", emulator.stdout.readline()))

    def rows() -> list[list[str]]:
        return [line.split(",") for line in log.read_text().splitlines()]

    try:
        client = Client(Link(str(link)), timeout=PATIENCE)
        client.hello()
        inspire(client, lambda: rows()[-1][1:3] == ["10", "0"])
        before = len(rows())
        os.kill(int(ids[dies]), how)
        end = time.monotonic() + PATIENCE
        while len(rows()) == before:
            assert time.monotonic() < end, "nothing vented"
            time.sleep(0.01)
        unvented = dies == "electronics" and bool(normally)
        assert rows()[before][1:] == ["0", "0" if unvented else "1", decides]
        client.transport.close()
    finally:
        os.kill(int(ids["device"]), signal.SIGCONT) if emulator.poll() is None else None
        emulator.terminate()
        emulator.communicate()
