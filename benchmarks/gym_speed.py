"""Steps per second through the Gymnasium interface, beside a compiled scan and a numpy loop.

All run rigs in single or double precision on as many cells, in turns, and the best of the rounds
counts, because other work on the machine slows all. The numpy loop is the rig of the entry
``identify_plan``, inspirations from rest without observations. Usage:

    python benchmarks/gym_speed.py [--rounds 20]
"""

from __future__ import annotations

import os
import runpy
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import typer

from ventbench.base import compilation
from ventbench.controllers.pid import PID
from ventbench.gym_env import STEPS, VentilatorVector
from ventbench.plants import frozen
from ventbench.plants.stacking import take
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.rollouts import closed_loop

#: Numbers of environments side by side.
ENVIRONMENTS = (64, 1024, 8192)

INSPIRATION = protocol.INSPIRATION_STEPS


def episode(many: VentilatorVector, actions: np.ndarray) -> None:
    """One episode of all environments: its reset and all its steps."""
    many.reset()
    for _ in range(STEPS):
        many.step(actions)


def numpy_loop(count: int) -> Callable[[], object]:
    """One inspiration of as many rigs of ``identify_plan``."""
    folder = Path(__file__).parents[1] / "submissions" / "identify_plan"
    simulate = runpy.run_path(str(folder / "rig.py"))["simulate"]
    with np.load(folder / "rig.npz") as arrays:
        rig = {name: arrays[name] for name in arrays.files}
    lung = np.arange(count) % len(rig["means"])
    commands = np.random.default_rng(0).uniform(0.0, 50.0, (count, INSPIRATION - 1))
    return lambda: simulate(rig, rig["means"][lung], protocol.DT, commands, lung)


def rates(count: int, rounds: int) -> dict[str, float]:
    """Steps per second by job and clock."""
    many = VentilatorVector(count)
    many.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 0.0, (count, 1)).astype(np.float32)
    with compilation.float32():
        plant = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), take(frozen.load().plants, 4))
        cells = nominal_scenario(np.resize(protocol.PIPS, count))
        pid = PID(jnp.ones(count), jnp.ones(count))
        jobs: dict[str, tuple[Callable[[], object], int]] = {
            "scan": (lambda: jax.block_until_ready(closed_loop(plant, pid, cells)), STEPS),
            "gymnasium": (lambda: episode(many, actions), STEPS),
            "numpy": (numpy_loop(count), INSPIRATION - 1),
        }
        clocks = {"wall": time.perf_counter, "processor": time.process_time}
        best = {(job, clock): np.inf for job in jobs for clock in clocks}
        for job, _ in jobs.values():
            job()
        for _ in range(rounds):
            for name, (job, _) in jobs.items():
                begun = {clock: read() for clock, read in clocks.items()}
                job()
                for clock, read in clocks.items():
                    best[name, clock] = min(best[name, clock], read() - begun[clock])
    return {" ".join(key): count * jobs[key[0]][1] / seconds for key, seconds in best.items()}


def main(rounds: int = 20) -> None:
    """Steps per second through the Gymnasium interface, beside a compiled scan and a numpy loop."""
    print(f"{os.cpu_count()} cores, JAX {jax.__version__}; million steps/s")
    for count in ENVIRONMENTS:
        made = rates(count, rounds)
        for clock in ("wall", "processor"):
            scan, through, plain = (
                made[f"{job} {clock}"] / 1e6 for job in ("scan", "gymnasium", "numpy")
            )
            print(
                f"  {count} environments by {clock} time: scan {scan:.2f}, Gymnasium {through:.2f} "
                f"({through / scan:.2f} of it), numpy {plain:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    typer.run(main)
