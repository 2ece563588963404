"""Steps per second through the Gymnasium interface, beside a compiled scan.

Both run as many cells, in turns, and the best of the rounds counts, because other work on the
machine slows both. Usage:

    python benchmarks/gym_speed.py [--rounds 20]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

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


def episode(many: VentilatorVector, actions: np.ndarray) -> None:
    """One episode of all environments: its reset and all its steps."""
    many.reset()
    for _ in range(STEPS):
        many.step(actions)


def rates(count: int, rounds: int) -> dict[str, float]:
    """Steps per second by job and clock."""
    many = VentilatorVector(count)
    many.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 0.0, (count, 1)).astype(np.float32)
    with compilation.float32():
        plant = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), take(frozen.load().plants, 4))
        cells = nominal_scenario(np.resize(protocol.PIPS, count))
        pid = PID(jnp.ones(count), jnp.ones(count))
        jobs: dict[str, Callable[[], object]] = {
            "scan": lambda: jax.block_until_ready(closed_loop(plant, pid, cells)),
            "gymnasium": lambda: episode(many, actions),
        }
        clocks = {"wall": time.perf_counter, "processor": time.process_time}
        best = {(job, clock): np.inf for job in jobs for clock in clocks}
        for job in jobs.values():
            job()
        for _ in range(rounds):
            for name, job in jobs.items():
                begun = {clock: read() for clock, read in clocks.items()}
                job()
                for clock, read in clocks.items():
                    best[name, clock] = min(best[name, clock], read() - begun[clock])
    return {" ".join(key): count * STEPS / seconds for key, seconds in best.items()}


def main(rounds: int = 20) -> None:
    """Steps per second through the Gymnasium interface, beside a compiled scan."""
    print(f"{os.cpu_count()} cores, JAX {jax.__version__}; million steps/s")
    for count in ENVIRONMENTS:
        made = rates(count, rounds)
        for clock in ("wall", "processor"):
            scan, through = (made[f"{job} {clock}"] / 1e6 for job in ("scan", "gymnasium"))
            print(
                f"  {count} environments by {clock} time: scan {scan:.2f}, Gymnasium {through:.2f} "
                f"({through / scan:.2f} of it)",
                flush=True,
            )


if __name__ == "__main__":
    typer.run(main)
