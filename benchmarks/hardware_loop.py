"""Timing of a 30 ms loop on an emulated device: lateness of steps, round trips, losses.

The loop's own lateness hardly depends on what else the machine does, if the host may take real-time
priority; answers of the device do, as the kernel moves the bytes of a pseudo-terminal in threads of
ordinary priority.

Usage:

    python benchmarks/hardware_loop.py [--minutes 30] [--lung R20C50] [--plant frozen]
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time

import numpy as np
import typer

from hardware_eval import realtime
from hardware_eval.bench.loop import ON_TIME_S, answer_by
from hardware_eval.wire.client import Client, Link, NoAnswerError, RefusedError
from ventbench.task import protocol, waveform

#: Late steps that are shown.
_SHOWN = 20

#: Steps between two looks at the machine's load.
_LOAD_EVERY = 1000


def main(minutes: float = 0.1, lung: str = "R20C50", plant: str = "frozen") -> None:
    """Timing of a 30 ms loop on an emulated device: lateness of steps, round trips, losses."""
    command = f"-m hardware_eval emulate --lung {lung} --plant {plant}".split()
    emulator = subprocess.Popen(
        [sys.executable, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert emulator.stdout is not None
    client = Client(Link(emulator.stdout.readline().strip()))
    client.hello()
    steps = round(minutes * 60.0 / protocol.DT)
    target = 5.0 + 15.0 * waveform.shape(np.arange(protocol.BREATH_STEPS))
    bias = waveform.expiratory_command(np.arange(protocol.BREATH_STEPS))
    # What each step did: how late it began, how long reading and command took, s.
    late, read, sent = np.zeros(steps), np.zeros(steps), np.zeros(steps)
    lost = vented = 0
    loads: list[float] = []
    gc.collect()
    gc.freeze()
    granted = realtime.take_priority()
    client.arm()
    start = time.monotonic()
    for k in range(steps):
        due, step = start + k * protocol.DT, k % protocol.BREATH_STEPS
        while (left := due - time.monotonic()) > 0.0:
            time.sleep(left)
        began = time.monotonic()
        late[k] = began - due
        if k % _LOAD_EVERY == 0:
            loads.append(os.getloadavg()[0])
        try:
            reading = client.heartbeat()
            read[k] = time.monotonic() - began
            left = answer_by(due, time.monotonic())
            if step < protocol.INSPIRATION_STEPS:
                u_in = min(max(2.0 * (target[step] - reading.pressure), 0.0), 100.0)
                client.command(u_in, 0, left)
            else:
                client.command(float(bias[step]), 1, left)
        except NoAnswerError:
            lost += 1
        except RefusedError:
            vented += 1
            while True:
                try:
                    client.arm()
                    break
                except NoAnswerError:
                    continue
            start = time.monotonic() - k * protocol.DT  # a new run, as in a session
        sent[k] = time.monotonic() - began - read[k]
    (median, longest), counters = client.round_trips(), client.counters()
    client.close()
    emulator.terminate()
    _, told = emulator.communicate()
    loads.append(os.getloadavg()[0])
    print(f"{steps} steps of {1e3 * protocol.DT:.0f} ms ({minutes:g} minutes)")
    print(
        f"begun within {1e3 * ON_TIME_S:.0f} ms of their deadline: "
        f"{100 * np.mean(late <= ON_TIME_S):.3f} %, {np.sum(late > protocol.DT)} lost"
    )
    print(f"latest {1e3 * late.max():.3f} ms, 99.9 % {1e3 * np.percentile(late, 99.9):.3f} ms")
    print(f"round trip: median {1e3 * median:.3f} ms, longest {1e3 * longest:.3f} ms")
    print(f"steps without an answer: {lost}; vented by the watchdog: {vented}")
    for k in np.flatnonzero(late > ON_TIME_S)[:_SHOWN]:
        before = max(k - 1, 0)
        print(
            f"  step {k}: {1e3 * late[k]:.1f} ms late; the step before waited "
            f"{1e3 * read[before]:.1f} ms for its reading, {1e3 * sent[before]:.1f} ms for its "
            "command"
        )
    print(f"device: {counters}")
    print(f"emulator: {told.strip().splitlines()[-1]}")
    print(
        f"load of the machine, least to most: {min(loads):.1f} to {max(loads):.1f} "
        f"on {os.cpu_count()} processors; real-time priority: {granted}"
    )


if __name__ == "__main__":
    typer.run(main)
