"""Timing of a 30 ms loop on an emulated device: lateness of steps, round trips, losses.

The figures are those of an idle machine only.

Usage:

    python benchmarks/hardware_loop.py [--minutes 30] [--realtime] [--lung R20C50] [--plant frozen]
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
import time

import numpy as np

from hardware_eval import realtime
from hardware_eval.wire.client import Client
from hardware_eval.wire.errors import NoAnswerError, RefusedError
from hardware_eval.wire.link import Link
from ventbench import protocol, waveform

#: A step may begin this late, s.
LIMIT = 0.002


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=0.1)
    parser.add_argument("--lung", default="R20C50")
    parser.add_argument("--plant", default="frozen")
    parser.add_argument("--realtime", action="store_true", help="real-time scheduling of both")
    arguments = parser.parse_args()
    command = [
        sys.executable, "-m", "hardware_eval", "emulate", "--lung", arguments.lung,
        "--plant", arguments.plant, *(["--realtime"] if arguments.realtime else []),
    ]  # fmt: skip
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert emulator.stdout is not None
    client = Client(Link(emulator.stdout.readline().strip()))
    client.hello()
    steps = round(arguments.minutes * 60.0 / protocol.DT)
    target = 5.0 + 15.0 * waveform.shape(np.arange(protocol.BREATH_STEPS))
    bias = waveform.expiratory_command(np.arange(protocol.BREATH_STEPS))
    late, lost, vented = np.zeros(steps), 0, 0
    gc.collect()
    gc.freeze()
    if arguments.realtime and (reason := realtime.prefer()):
        raise SystemExit(f"no real-time scheduling: {reason}")
    client.arm()
    start = time.monotonic()
    for k in range(steps):
        due, step = start + k * protocol.DT, k % protocol.BREATH_STEPS
        while (left := due - time.monotonic()) > 0.0:
            time.sleep(left)
        late[k] = time.monotonic() - due
        try:
            reading = client.heartbeat()
            if step < protocol.INSPIRATION_STEPS:
                u_in = min(max(2.0 * (target[step] - reading.pressure), 0.0), 100.0)
                client.command(u_in, 0)
            else:
                client.command(float(bias[step]), 1)
        except NoAnswerError:
            lost += 1
        except RefusedError:
            vented += 1
            client.arm()
    counted, counters = client.statistics(), client.counters()
    client.close()
    emulator.terminate()
    _, told = emulator.communicate()
    within = float(np.mean(late <= LIMIT))
    print(f"{steps} steps of {1e3 * protocol.DT:.0f} ms ({arguments.minutes:g} minutes)")
    print(f"begun within {1e3 * LIMIT:.0f} ms of their deadline: {100 * within:.3f} %")
    print(f"latest {1e3 * late.max():.2f} ms, 99.9 % {1e3 * np.percentile(late, 99.9):.2f} ms")
    print(
        f"round trip: median {1e3 * counted.round_trip_median:.2f} ms, longest "
        f"{1e3 * counted.round_trip_worst:.2f} ms"
    )
    print(f"steps without an answer: {lost}; vented by the watchdog: {vented}")
    print(f"device: {counters}")
    print(f"emulator: {told.strip().splitlines()[-1]}")
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")


if __name__ == "__main__":
    main()
