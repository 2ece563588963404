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
import json
import multiprocessing
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from hardware_eval import realtime
from hardware_eval.wire.client import Client, Link, LinkError
from hardware_eval.wire.messages import Mode
from ventbench.base import files

#: The lung must be vented within this time of a death, s: watchdog, deadman, monostable, age of the
#: readings, each with what their processes need to wake up.
LIMITS = {
    "host": 0.100,
    "device": 0.060,
    "stopped": 0.060,
    "deadman": 0.100,
    "both": 0.100,
    "bus": 0.070,
    "supply": 0.010,
}

#: What the table calls them.
TITLES = {
    "host": "host killed",
    "device": "program killed",
    "stopped": "program stopped",
    "deadman": "deadman killed",
    "both": "both stopped",
    "bus": "sensor's bus blocked",
    "supply": "supply lost",
}

#: A host runs for a random time in this range before it is killed, s.
LIFE = (0.05, 0.5)

#: Patience with the whole of one kill, s.
PATIENCE = 5.0


def host(port: str, started: int) -> None:
    """Breathe until killed; tells the pipe ``started`` when the first command was obeyed."""
    realtime.take_priority()
    client = Client(Link(port))
    while True:
        try:
            client.hello()
            client.arm()
            due, told = time.monotonic(), False
            while True:
                client.heartbeat()
                reading = client.command(5.0 + 5.0 * random.random(), 0)
                if reading.mode is Mode.RUNNING and not told:
                    os.write(started, b"x")
                    told = True
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
        extra: further options of the emulator.
    """

    def __init__(self, folder: Path, extra: list[str]) -> None:
        folder.mkdir()
        self.link = folder / "lung"
        self.valves, self.program = folder / "valves.csv", folder / "program.csv"
        self._command = [
            sys.executable,
            "-m",
            "tests.hardware_eval.electronics",
            "--link",
            str(self.link),
            "--valves",
            str(self.valves),
            "--program",
            str(self.program),
            *extra,
        ]
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        told = self._process.stdout.readline()
        assert told, "the emulator did not start"
        self._ids = {name: int(number) for name, number in re.findall(r"(\w+) (\d+)", told)}

    def die(self, death: str) -> None:
        """Bring a death about."""
        match death:
            case "device":
                os.kill(self._ids["device"], signal.SIGKILL)
            case "stopped":
                os.kill(self._ids["device"], signal.SIGSTOP)
            case "deadman":
                os.kill(self._ids["deadman"], signal.SIGKILL)
            case "both":
                os.kill(self._ids["deadman"], signal.SIGSTOP)
                os.kill(self._ids["device"], signal.SIGSTOP)
            case "bus":
                os.kill(self._ids["electronics"], signal.SIGUSR2)
            case "supply":
                os.kill(self._ids["electronics"], signal.SIGUSR1)

    def live(self, death: str) -> None:
        """Undo it."""
        if death in ("stopped", "both"):
            os.kill(self._ids["deadman"], signal.SIGCONT)
            os.kill(self._ids["device"], signal.SIGCONT)
            time.sleep(0.1)
        if death in ("device", "deadman", "supply"):
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

    def does(self) -> tuple[float, list[str]]:
        """Time of the last change of the valves, s, and what they do since."""
        row = self.valves.read_text().splitlines()[-1].split(",")
        return float(row[0]), row[1:]


def kill_one(
    device: EmulatedDevice, death: str, unvented: bool = False
) -> tuple[float, bool] | None:
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
    readable, writable = os.pipe()
    pid = os.fork()
    if pid == 0:
        signal.alarm(round(2 * PATIENCE))  # it does not outlive a benchmark that was killed
        try:
            host(str(device.link), writable)
        finally:
            os._exit(1)
    os.close(writable)
    struck = 0.0
    try:
        if not os.read(readable, 1):
            raise SystemExit("the host ended by itself")
        time.sleep(random.uniform(*LIFE))
        _, valves = device.does()
        struck = time.monotonic()
        if valves[:2] == ["0", "1"]:
            return None
        if death != "host":
            device.die(death)
            end = struck + PATIENCE
            while time.monotonic() < end and device.does()[0] <= struck:
                time.sleep(0.005)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(readable)
    end = time.monotonic() + PATIENCE
    delay, ends = float("inf"), ["0", "0" if unvented else "1"]
    while time.monotonic() < end:
        rows = [line.split(",") for line in device.valves.read_text().splitlines()[-50:]]
        after = [float(row[0]) for row in rows if float(row[0]) > struck and row[1:3] == ends]
        if after:
            delay = after[0] - struck
            break
        time.sleep(0.005)
    late = (
        "DEVICE_LATE" in device.program.read_text().splitlines()[-1] if death == "host" else False
    )
    device.live(death)
    return delay, late


def work(
    kills: int, folder: Path, extra: list[str], death: str, unvented: bool
) -> tuple[list[tuple[float, bool]], int]:
    """Let things die at one emulator until there are enough delays."""
    device = EmulatedDevice(folder, extra)
    delays: list[tuple[float, bool]] = []
    late = 0
    while len(delays) < kills:
        done = kill_one(device, death, unvented)
        if done is None:
            late += 1
        else:
            delays.append(done)
    device.end()
    return delays, late


def deaths(
    death: str, normally_open: bool, kills: int, emulators: int, folder: Path, extra: list[str]
) -> dict[str, Any]:
    """Let one thing die again and again: a row of the table."""
    if not normally_open:
        extra = [*extra, "--normally-closed"]
    unvented = death == "supply" and not normally_open
    shares = [len(range(k, kills, emulators)) for k in range(emulators)]
    # Processes and no threads: each forks its hosts.
    with multiprocessing.get_context("fork").Pool(emulators) as pool:
        parts = pool.starmap(
            work,
            [
                (share, folder / f"{death}-{normally_open}-{k}", extra, death, unvented)
                for k, share in enumerate(shares)
            ],
            chunksize=1,
        )
    delays = [each for part, _ in parts for each in part]
    late = sum(part for _, part in parts)
    milliseconds = 1e3 * np.array([delay for delay, _ in delays])
    return {
        "death": death,
        "valve": "open" if normally_open else "closed",
        "kills": kills,
        "vents": not unvented,
        "bound_ms": 1e3 * LIMITS[death],
        "within": int(np.sum(milliseconds <= 1e3 * LIMITS[death])),
        "median_ms": float(np.median(milliseconds)),
        "worst_ms": float(milliseconds.max()),
        "held_up": int(sum(held for _, held in delays)),
        "not_counted": late,
        "delays_ms": sorted(milliseconds.round(2).tolist()),
    }


def main(
    death: list[str] | None = None,
    valve: str | None = None,
    kills: int = 100,
    emulators: int = 2,
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
    extra = ["--realtime"] * urgent
    # Not what it starts: an emulator that compiles would hold up everything else.
    if urgent and not realtime.take_priority():
        raise SystemExit("no real-time scheduling: it wants root, or a limit rtprio")
    # In memory: a disk that others write to holds up whoever writes a line.
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    rows: list[dict[str, Any]] = []
    for name in death or LIMITS:
        for position in [valve] if valve else ["open", "closed"]:
            kept = out / f"{name}-{position}-{kills}.json"
            if not kept.exists():
                with tempfile.TemporaryDirectory(dir=memory) as folder:
                    row = deaths(name, position == "open", kills, emulators, Path(folder), extra)
                files.write_json(kept, {**row, "load": round(os.getloadavg()[0], 1)})
            rows.append(json.loads(kept.read_text()))
    print("| death | within bound | ms: bound, larger median, longest |\n|---|---|---|")
    for kind, vents in dict.fromkeys((row["death"], row["vents"]) for row in rows):
        own = [row for row in rows if (row["death"], row["vents"]) == (kind, vents)]
        count, within = (sum(row[name] for row in own) for name in ("kills", "within"))
        longest = [max(row[name] for row in own) for name in ("bound_ms", "median_ms", "worst_ms")]
        title = TITLES[kind] + ("" if vents else ", closed without current: nothing flows")
        print(f"| {title} | {within}/{count} | {', '.join(f'{ms:.0f}' for ms in longest)} |")
    loads = [row["load"] for row in rows]
    print(f"load {min(loads)} to {max(loads)} on {os.cpu_count()} processors")
    print(f"held up by the machine for over 40 ms: {sum(row['held_up'] for row in rows)}")
    missed = sum(row["not_counted"] for row in rows)
    print(f"not counted, as the lung was vented before the death by a late host: {missed}")
    if strict and any(row["within"] < row["kills"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    typer.run(main)
