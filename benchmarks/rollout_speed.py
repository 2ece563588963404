"""Speed of closed-loop rollouts of a PID on the plants, and of steps through Gymnasium.

Prints environment steps/s in float32. Usage:

    python benchmarks/rollout_speed.py [--batch 8192] [--cpu-time]

With ``--cpu-time`` the clock counts the processor seconds of this process over all threads, so that
figures also hold on a busy machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import typer

from ventbench.controllers.pid import PID
from ventbench.gym_env import STEPS, VentilatorVector
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import take
from ventbench.plants.two_balloon import two_balloon
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS
from ventbench.task.rollouts import closed_loop

#: Plants that are run; add a line for each new kind.
PLANTS: dict[str, Callable[[], Plant]] = {
    "single_compartment": lambda: single_compartment(LUNGS[4]),
    "two_balloon": lambda: two_balloon(LUNGS[4]),
    "frozen hybrid": lambda: take(frozen.load().plants, 4),
}

#: Numbers of Gymnasium's environments side by side.
ENVIRONMENTS = (64, 1024, 8192)

#: Runs of each, of which the fastest counts.
ROUNDS = 10


def through_gymnasium(count: int) -> Callable[[], None]:
    """One episode of all environments: its reset and all its steps."""
    many = VentilatorVector(count)
    many.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 0.0, (count, 1)).astype(np.float32)

    def episode() -> None:
        many.reset()
        for _ in range(STEPS):
            many.step(actions)

    return episode


def main(batch: int = 8192, cpu_time: bool = False) -> None:
    """Speed of closed-loop rollouts of a PID on the plants, and of steps through Gymnasium."""
    clock = time.process_time if cpu_time else time.perf_counter
    device = jax.devices()[0]
    print(f"{device.platform} {device.device_kind}, {os.cpu_count()} cores, JAX {jax.__version__}")
    print(f"\nclosed-loop PID, float32, batch {batch}, and Gymnasium: steps/s")
    rng = np.random.default_rng(0)
    pid = PID(*(jnp.asarray(rng.uniform(0, 5, batch), jnp.float32) for _ in range(2)))
    scenario = nominal_scenario(np.resize(protocol.PIPS, batch))

    def rollout(plant: Plant) -> Callable[[], object]:
        return lambda: jax.block_until_ready(closed_loop(plant, pid, scenario))

    jobs = {name: (batch, rollout(build())) for name, build in PLANTS.items()}
    jobs |= {f"Gymnasium, {n}": (n, through_gymnasium(n)) for n in ENVIRONMENTS}
    for name, (count, job) in jobs.items():
        job()
        seconds = []
        for _ in range(ROUNDS):
            started = clock()
            job()
            seconds.append(clock() - started)
        print(f"  {name:24} {count * STEPS / min(seconds):12.0f}", flush=True)


if __name__ == "__main__":
    typer.run(main)
