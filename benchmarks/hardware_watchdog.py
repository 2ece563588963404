"""Hosts that are killed (kill -9) at random moments: how long until the device has vented the lung.

Each host is a process that breathes on an emulated device on a pseudo-terminal; the emulators are
processes too. Their clocks are one (``time.monotonic``), so that the delay from the kill to the
moving valves is exact. A delay holds the lateness of a busy machine too: run it while it is idle.

Usage:

    python benchmarks/hardware_watchdog.py [--kills 1000] [--emulators 2] [--realtime] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from hardware_eval import realtime
from hardware_eval.wire.client import Client
from hardware_eval.wire.errors import LinkError
from hardware_eval.wire.link import Link
from hardware_eval.wire.messages import Mode

#: The lung must be vented within this time of the host's death, s.
LIMIT = 0.100

#: A host runs for a random time in this range before it is killed, s.
LIFE = (0.05, 0.5)

#: Patience with the whole of one kill, s.
PATIENCE = 30.0


def host(port: str, started: int) -> None:
    """Breathe until killed; tells the pipe ``started`` when the first command was obeyed."""
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
            continue  # a busy machine was so slow that the watchdog vented: once more


def kill_one(port: str, log: Path) -> tuple[float, bool] | None:
    """Start a host and kill it.

    Returns:
        Time from its death to the vent, s, and whether the machine held the device's process up;
        None where the lung was vented at the kill already, because host or device were late.
    """
    readable, writable = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            host(port, writable)
        finally:
            os._exit(1)
    os.close(writable)
    try:
        if not os.read(readable, 1):
            raise SystemExit("the host ended by itself")
        time.sleep(random.uniform(*LIFE))
    finally:
        killed = time.monotonic()
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(readable)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        rows = [line.split(",") for line in log.read_text().splitlines()[-20:]]
        if rows and len(rows[-1]) == 4 and rows[-1][1:3] == ["0", "1"]:
            delay = float(rows[-1][0]) - killed
            return (delay, "DEVICE_LATE" in rows[-1][3]) if delay > 0.0 else None
        time.sleep(0.005)
    raise SystemExit(f"{port}: NOT VENTED within {PATIENCE:g} s")


def work(
    index: int,
    kills: int,
    folder: Path,
    extra: list[str],
    delays: list[tuple[float, bool]],
    late: list[int],
) -> None:
    """Kill hosts of one emulator until there are enough delays."""
    link, log = folder / f"lung{index}", folder / f"valves{index}.csv"
    command = [
        sys.executable, "-m", "hardware_eval", "emulate", "--plant", "single_compartment",
        "--link", str(link), "--log", str(log), *extra,
    ]  # fmt: skip
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert emulator.stdout is not None
    emulator.stdout.readline()
    for _ in range(kills):
        while (done := kill_one(str(link), log)) is None:
            late.append(1)
        delays.append(done)
    emulator.terminate()
    _, told = emulator.communicate()
    print(f"emulator {index}: {told.strip().splitlines()[-1]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--emulators", type=int, default=2)
    parser.add_argument("--realtime", action="store_true", help="real-time scheduling of all")
    parser.add_argument("--strict", action="store_true", help="exit 1 if any delay is too long")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    delays: list[tuple[float, bool]] = []
    late: list[int] = []
    extra = ["--realtime"] if arguments.realtime else []
    if arguments.realtime and (reason := realtime.prefer()):
        raise SystemExit(f"no real-time scheduling: {reason}")
    share = -(-arguments.kills // arguments.emulators)
    # In memory: a disk that others write to holds up whoever writes a line.
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        threads = [
            threading.Thread(target=work, args=(k, share, Path(folder), extra, delays, late))
            for k in range(arguments.emulators)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    milliseconds = 1e3 * np.array([delay for delay, _ in delays])
    held_up = np.array([held for _, held in delays])
    within = int(np.sum(milliseconds <= 1e3 * LIMIT))
    shares = {f"{q} %": float(np.percentile(milliseconds, q)) for q in (0, 50, 90, 99, 99.9, 100)}
    print(f"kills {len(delays)}, vented within {1e3 * LIMIT:.0f} ms: {within}")
    print("delay, ms: " + ", ".join(f"{name} {value:.1f}" for name, value in shares.items()))
    print(f"device's process held up by the machine for more than 40 ms: {held_up.sum()} kills")
    if not held_up.all():
        steady = milliseconds[~held_up]
        print(
            f"the others: {int(np.sum(steady <= 1e3 * LIMIT))} of {len(steady)} within the limit, "
            f"longest {steady.max():.1f} ms"
        )
    print(f"not counted, as the watchdog had vented a late host before its kill: {len(late)}")
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    if arguments.json:
        arguments.json.write_text(json.dumps(sorted(milliseconds.round(2).tolist())))
    if arguments.strict and within < len(delays):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
