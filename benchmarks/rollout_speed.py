"""Speed of closed-loop rollouts of a PID on the plants.

Prints environment steps/s of each plant in float32. Usage:

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
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import take
from ventbench.plants.two_balloon import two_balloon
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS
from ventbench.task.rollouts import closed_loop

#: Environment steps of one run, without its expirations.
STEPS = protocol.BREATHS * protocol.INSPIRATION_STEPS

#: Plants that are run; add a line for each new kind.
PLANTS: dict[str, Callable[[], Plant]] = {
    "single_compartment": lambda: single_compartment(LUNGS[4]),
    "two_balloon": lambda: two_balloon(LUNGS[4]),
    "frozen hybrid": lambda: take(frozen.load().plants, 4),
}

#: Runs of a plant, of which the fastest counts.
ROUNDS = 10


def main(batch: int = 8192, cpu_time: bool = False) -> None:
    """Speed of closed-loop rollouts of a PID on the plants."""
    clock = time.process_time if cpu_time else time.perf_counter
    device = jax.devices()[0]
    print(f"{device.platform} {device.device_kind}, {os.cpu_count()} cores, JAX {jax.__version__}")
    print(f"\nclosed-loop PID, float32, batch {batch}: steps/s")
    rng = np.random.default_rng(0)
    pid = PID(*(jnp.asarray(rng.uniform(0, 5, batch), jnp.float32) for _ in range(2)))
    scenario = nominal_scenario(np.resize(protocol.PIPS, batch))
    for name, build in PLANTS.items():
        plant, seconds = build(), []
        jax.block_until_ready(closed_loop(plant, pid, scenario))
        for _ in range(ROUNDS):
            started = clock()
            jax.block_until_ready(closed_loop(plant, pid, scenario))
            seconds.append(clock() - started)
        print(f"  {name:24} {batch * STEPS / min(seconds):12.0f}")


if __name__ == "__main__":
    typer.run(main)
