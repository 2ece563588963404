"""Deaths in inspirations, at random moments: how long until the valves have vented the lung.

Each host is a process that breathes on an emulated device on a pseudo-terminal; device, deadman and
electronics are processes too. What dies: the host (kill -9), the device's program (kill -9, or
stopped), its deadman (kill -9), both (stopped), the sensor's bus (blocked), the supply. Each death
is tried with an expiratory valve that is open, and one that is closed, without current. The delay
from the death to the valves' movement in the log of the electronics is exact, as all clocks are one
(``time.monotonic``). It holds the lateness of a busy machine too: run it while it is idle.

Usage:

    python benchmarks/hardware_deaths.py [--death device ...] [--kills 100] [--realtime] [--out DIR]

Prints the table of ``hardware_eval/README.md``, valves of both kinds together. The folder keeps
what is finished; the same command continues.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from hardware_eval import realtime
from hardware_eval.wire.client import Client, Link, LinkError
from hardware_eval.wire.messages import Mode
from ventbench.base.resume import WorkFolder


@dataclass(frozen=True)
class Death:
    """What dies."""

    title: str  #: what the table calls it.
    #: the lung must be vented within this time, s: watchdog, deadman, monostable, age of the
    #: readings, each with what their processes need to wake up.
    limit: float
    signals: tuple[tuple[str, int], ...] = ()  #: which process gets what; none: the host is killed.


DEATHS = {
    "host": Death("host killed", 0.100),
    "device": Death("program killed", 0.060, (("device", signal.SIGKILL),)),
    "stopped": Death("program stopped", 0.060, (("device", signal.SIGSTOP),)),
    "deadman": Death("deadman killed", 0.100, (("deadman", signal.SIGKILL),)),
    "both": Death("both stopped", 0.100, (("deadman", signal.SIGSTOP), ("device", signal.SIGSTOP))),
    "bus": Death("sensor's bus blocked", 0.070, (("electronics", signal.SIGUSR2),)),
    "supply": Death("supply lost", 0.010, (("electronics", signal.SIGUSR1),)),
}

#: A host runs for a random time in this range before it is killed, s.
LIFE = (0.05, 0.5)

#: Patience with the whole of one kill, s.
PATIENCE = 5.0


def breathe(port: str, started: Event) -> None:
    """Be a host until killed; says that it has ``started`` when the first command was obeyed."""
    signal.alarm(round(2 * PATIENCE))  # it does not outlive a benchmark that was killed
    realtime.take_priority()
    client = Client(Link(port))
    while True:
        try:
            client.hello()
            client.arm()
            due = time.monotonic()
            while True:
                client.heartbeat()
                reading = client.command(5.0 + 5.0 * random.random(), 0)
                if reading.mode is Mode.RUNNING and not started.is_set():
                    started.set()
                due += 0.03
                time.sleep(max(due - time.monotonic(), 0.0))
        except LinkError:
            # A busy machine was so slow that the watchdog vented: once more. Or the port has gone:
            # a host that tries without a pause would, with real-time priority, stop everybody.
            time.sleep(0.02)


class EmulatedDevice:
    """An emulated device that dies and lives again.

    Args:
        folder: for its link and its logs.
        options: of the emulator.
    """

    def __init__(self, folder: Path, options: list[str]) -> None:
        self.link = folder / "lung"
        self.valves, self.program = folder / "valves.csv", folder / "program.csv"
        paths = {"--link": self.link, "--valves": self.valves, "--program": self.program}
        named = [text for option, path in paths.items() for text in (option, str(path))]
        module = [sys.executable, "-m", "tests.hardware_eval.electronics"]
        self._command = [*module, *named, *options]
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        told = self._process.stdout.readline()
        assert told, "the emulator did not start"
        self._ids = {name: int(number) for name, number in re.findall(r"(\w+) (\d+)", told)}

    def die(self, death: Death) -> None:
        """Bring a death about."""
        for process, number in death.signals:
            os.kill(self._ids[process], number)

    def live(self, death: Death) -> None:
        """Undo it; a blocked bus comes back by itself."""
        sent = {number for _, number in death.signals}
        if signal.SIGSTOP in sent:
            for process in ("deadman", "device"):
                os.kill(self._ids[process], signal.SIGCONT)
            time.sleep(0.1)
        if sent & {signal.SIGKILL, signal.SIGUSR1}:
            self.end()
            self._start()

    def end(self) -> None:
        """End it, and wait until its electronics have ended."""
        self._process.terminate()
        try:
            self._process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        end = time.monotonic() + PATIENCE
        with contextlib.suppress(ProcessLookupError):
            while time.monotonic() < end:  # where nobody collects orphans they seem to live on
                os.kill(self._ids["electronics"], 0)
                time.sleep(0.02)

    def moves(self) -> list[tuple[float, list[str]]]:
        """The last changes of the valves: when, s, and what they do since."""
        rows = [line.split(",") for line in self.valves.read_text().splitlines()[-50:]]
        return [(float(row[0]), row[1:3]) for row in rows]


def kill_one(device: EmulatedDevice, death: Death, unvented: bool) -> tuple[float, bool] | None:
    """Start a host, and let something die in its inspiration.

    Args:
        device: what the host breathes on.
        death: what dies.
        unvented: whether nothing can vent; then the time is that until nothing flows in.

    Returns:
        Time from the death to the vent, s, infinite if it does not come within :data:`PATIENCE`,
        and whether the machine held the device's process up; None where the lung was vented
        already, because host or device were late.
    """
    processes = multiprocessing.get_context("fork")
    started = processes.Event()
    host = processes.Process(target=breathe, args=(str(device.link), started), daemon=True)
    host.start()
    try:
        if not started.wait(2 * PATIENCE):
            raise SystemExit("the host ended by itself")
        time.sleep(random.uniform(*LIFE))
        _, valves = device.moves()[-1]
        struck = time.monotonic()
        if valves == ["0", "1"]:
            return None
        if not death.signals:
            host.kill()
        device.die(death)
        delay, ends = float("inf"), ["0", "0" if unvented else "1"]
        while delay == float("inf") and time.monotonic() < struck + PATIENCE:
            time.sleep(0.005)
            after = (at - struck for at, valves in device.moves() if at > struck and valves == ends)
            delay = next(after, delay)
    finally:
        host.kill()
        host.join()
    late = not death.signals and "DEVICE_LATE" in device.program.read_text().splitlines()[-1]
    device.live(death)
    return delay, late


def deaths(death: Death, normally_open: bool, kills: int, options: list[str]) -> dict[str, Any]:
    """Let one thing die again and again at an emulator: a row of the table."""
    unvented = death.title == DEATHS["supply"].title and not normally_open
    delays: list[tuple[float, bool]] = []
    not_counted = 0
    # In memory: a disk that others write to holds up whoever writes a line.
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        closed = ["--normally-closed"] * (not normally_open)
        device = EmulatedDevice(Path(folder), [*options, *closed])
        while len(delays) < kills:
            done = kill_one(device, death, unvented)
            not_counted += done is None
            delays += [] if done is None else [done]
        device.end()
    milliseconds = 1e3 * np.array([delay for delay, _ in delays])
    return {
        "vents": not unvented,
        "within": int(np.sum(milliseconds <= 1e3 * death.limit)),
        "median_ms": float(np.median(milliseconds)),
        "worst_ms": float(milliseconds.max()),
        "held_up": int(sum(held for _, held in delays)),
        "not_counted": not_counted,
        "delays_ms": sorted(milliseconds.round(2).tolist()),
        "load": round(os.getloadavg()[0], 1),
    }


def main(
    death: list[str] | None = None,
    valve: str | None = None,
    kills: int = 100,
    urgent: Annotated[bool, typer.Option("--realtime")] = False,
    strict: bool = False,
    out: Path = Path("runs/deaths"),
) -> None:
    """Deaths in inspirations, at random moments: how long until the valves have vented the lung.

    --death: what dies; repeatable.
    --valve: open or closed without current; both if not.
    --kills: of each death and valve.
    --realtime: real-time scheduling of all.
    --strict: exit 1 if any delay is too long.
    --out: kept here.
    """
    # Not what it starts: an emulator that compiles would hold up everything else.
    if urgent and not realtime.take_priority():
        raise SystemExit("no real-time scheduling: it wants root, or a limit rtprio")
    work, rows = WorkFolder(out, {"kills": kills}), []
    for name in death or DEATHS:
        for position in [valve] if valve else ["open", "closed"]:
            options = ["--realtime"] * urgent
            made = partial(deaths, DEATHS[name], position == "open", kills, options)
            rows.append((DEATHS[name], work.get(f"{name}-{position}", made)))
    print("| death | within bound | ms: bound, larger median, longest |\n|---|---|---|")
    for kind, vents in dict.fromkeys((kind, row["vents"]) for kind, row in rows):
        own = [row for each, row in rows if (each, row["vents"]) == (kind, vents)]
        within = sum(row["within"] for row in own)
        median, worst = (max(row[name] for row in own) for name in ("median_ms", "worst_ms"))
        title = kind.title + ("" if vents else ", closed without current: nothing flows")
        figures = f"{1e3 * kind.limit:.0f}, {median:.0f}, {worst:.0f}"
        print(f"| {title} | {within}/{kills * len(own)} | {figures} |")
    loads, held_up, missed = (
        [row[x] for _, row in rows] for x in ("load", "held_up", "not_counted")
    )
    print(f"load {min(loads)} to {max(loads)} on {os.cpu_count()} processors")
    print(f"held up by the machine for over 40 ms: {sum(held_up)}")
    print(f"not counted, as the lung was vented before the death by a late host: {sum(missed)}")
    if strict and any(row["within"] < kills for _, row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    typer.run(main)
