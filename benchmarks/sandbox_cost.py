"""Cost of the sandbox: start of cells, one step and end, compared with the same process.

Usage:

    python benchmarks/sandbox_cost.py [--cells 756] [--entry pid_best]
"""

from __future__ import annotations

import os
import time

import numpy as np
import typer

from ventbench.entries.cells import InProcessRunner, Runner
from ventbench.entries.folder import open_submission
from ventbench.sandbox.child.cell import ROW
from ventbench.sandbox.runner import SandboxRunner
from ventbench.task import protocol
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNG_IDS


def measure(runner: Runner, entry: str, cells: int) -> dict[str, float]:
    tasks = [
        Task("performance", LUNG_IDS[k % len(LUNG_IDS)], protocol.DT, protocol.INSPIRATION_STEPS)
        for k in range(cells)
    ]
    steps = protocol.BREATHS * protocol.INSPIRATION_STEPS
    rows = np.random.default_rng(0).uniform(5.0, 35.0, (steps, cells, ROW))
    rows[:: protocol.INSPIRATION_STEPS, :, 0] = 0.0  # a breath starts
    times = [time.perf_counter()]
    session = runner.start(open_submission(entry), tasks)
    times.append(time.perf_counter())
    for row in rows:
        session.act(row)
    times.append(time.perf_counter())
    if session.failures:
        raise SystemExit(f"the entry failed: {next(iter(session.failures.values()))}")
    session.close()
    times.append(time.perf_counter())
    start, act, close = np.diff(times)
    return {
        "start, s": start,
        "a cell's start, ms": 1e3 * start / cells,
        "a step of a cell, us": 1e6 * act / steps / cells,
        "all steps, s": act,
        "close, s": close,
    }


def main(cells: int = 756, entry: str = "pid_best") -> None:
    """Cost of the sandbox: start of cells, one step and end, compared with the same process."""
    begun = time.perf_counter()
    sandbox = SandboxRunner()
    probe = time.perf_counter() - begun
    print(f"{cells} cells of {entry} on {os.cpu_count()} cores")
    print(f"layers: {', '.join(sandbox.sandbox['layers'])}; first cell {probe:.2f} s")
    print(f"{'':24}{'sandbox':>10}{'in process':>12}")
    apart = measure(sandbox, entry, cells)
    plain = measure(InProcessRunner(), entry, cells)
    for name, value in apart.items():
        print(f"{name:24}{value:10.2f}{plain[name]:12.2f}")


if __name__ == "__main__":
    typer.run(main)
