"""Steps per second through the Gymnasium interface, beside those of the compiled scan alone.

Both run the frozen simulators in float32 on as many cells, in turns, and the best of the rounds
counts, because other work on the machine slows both. Usage:

    python benchmarks/gym_speed.py [--envs 1024] [--rounds 20] [--json FILE]
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import compilation
from ventbench.base.files import write_json
from ventbench.controllers.pid import PID
from ventbench.gym_env import STEPS, VentilatorVector
from ventbench.plants import frozen
from ventbench.plants.stacking import take
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.rollouts import closed_loop


def episode(many: VentilatorVector, actions: np.ndarray) -> None:
    """One episode of all environments: its reset and all its steps."""
    many.reset()
    for _ in range(STEPS):
        many.step(actions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    count = options.envs
    many = VentilatorVector(count)
    many.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 0.0, (count, 1)).astype(np.float32)
    with compilation.float32():
        plant = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), take(frozen.load().plants, 4))
        cells = nominal_scenario(np.resize(protocol.PIPS, count))
        pid = PID(jnp.ones(count), jnp.ones(count))
        jobs = {
            "scan": lambda: jax.block_until_ready(closed_loop(plant, pid, cells)),
            "gymnasium": lambda: episode(many, actions),
        }
        clocks = {"wall": time.perf_counter, "processor": time.process_time}
        best = {(job, clock): np.inf for job in jobs for clock in clocks}
        for job in jobs.values():
            job()
        for _ in range(options.rounds):
            for name, job in jobs.items():
                begun = {clock: read() for clock, read in clocks.items()}
                job()
                for clock, read in clocks.items():
                    best[name, clock] = min(best[name, clock], read() - begun[clock])
    rates = {" ".join(key): count * STEPS / seconds for key, seconds in best.items()}
    print(f"{count} environments, {os.cpu_count()} cores, JAX {jax.__version__}; million steps/s")
    for clock in clocks:
        scan, through = rates[f"scan {clock}"] / 1e6, rates[f"gymnasium {clock}"] / 1e6
        print(f"  by {clock} time: scan {scan:.2f}, Gymnasium {through:.2f} ({through / scan:.2f})")
    if options.json:
        write_json(options.json, rates)


if __name__ == "__main__":
    main()
