"""Timing of a 30 ms loop on an emulated device: lateness of steps, round trips, losses.

The loop is that of a session (:mod:`hardware_eval.bench.drive`), begun again where a check ends it.
Its own lateness hardly depends on what else the machine does, if the host may take real-time
priority; answers of the device do, as the kernel moves the bytes of a pseudo-terminal in threads of
ordinary priority.

Usage:

    python benchmarks/hardware_loop.py [--minutes 30] [--lung R20C50] [--simulator frozen]
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter

import numpy as np
import typer

from hardware_eval import realtime
from hardware_eval.bench.drive import Driven, Program, drive
from hardware_eval.bench.loop import ON_TIME_S, Bench, Operator
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.wire.client import Client, Link
from ventbench.task import protocol, waveform

#: Pressure of the breaths, cmH2O, and their gain, %/cmH2O.
PIP, GAIN = 20.0, 2.0


def breathing(step: int, pressure: float) -> tuple[float, int]:
    """A proportional controller, breath after breath."""
    step %= protocol.BREATH_STEPS
    if step >= protocol.INSPIRATION_STEPS:
        return float(waveform.expiratory_command(step)), 1
    return max(GAIN * (float(waveform.target(step, PIP)) - pressure), 0.0), 0


def main(minutes: float = 0.1, lung: str = "R20C50", simulator: str = "frozen") -> None:
    """Timing of a 30 ms loop on an emulated device: lateness of steps, round trips, losses."""
    command = f"-m hardware_eval emulate --lung {lung} --simulator {simulator}".split()
    emulator = subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert emulator.stdout is not None
    client = Client(Link(emulator.stdout.readline().strip()))
    client.hello()
    bench = Bench(client, realtime.RealClock(), DEFAULT, Operator(), rest=0.5)
    steps, parts = round(minutes * 60.0 / protocol.DT), list[Driven]()
    while (left := steps - sum(len(x.late) for x in parts)) > 0:
        parts.append(drive(bench, lung, Program(breathing, left, PIP)))
    (median, longest), counters = client.round_trips(), client.counters()
    client.close()
    emulator.terminate()
    _, told = emulator.communicate()
    late = np.concatenate([x.late for x in parts])
    on_time = 100 * np.mean(late <= ON_TIME_S)
    print(f"{steps} steps of {1e3 * protocol.DT:.0f} ms ({minutes:g} minutes), begun within")
    print(f"{1e3 * ON_TIME_S:.0f} ms: {on_time:.3f} %, {np.sum(late > protocol.DT)} lost")
    print(f"latest {1e3 * late.max():.3f} ms, 99.9 % {1e3 * np.percentile(late, 99.9):.3f} ms")
    print(f"round trip: median {1e3 * median:.3f} ms, longest {1e3 * longest:.3f} ms")
    print(f"answers that were missing: {sum(x.missed for x in parts)}")
    ends = Counter(trip.partition(":")[0] for x in parts for trip in x.trips)
    print(f"vents: {', '.join(f'{name} {count}' for name, count in ends.items()) or 'none'}")
    print(f"device: {counters}")
    print(f"emulator: {told.strip().splitlines()[-1]}")
    with realtime.priority() as granted:
        print(f"real-time priority: {granted}")


if __name__ == "__main__":
    typer.run(main)
