"""Print the best gains for all lungs together that pass the safety gate on rigs drawn anew.

    python submissions/pid_robust/make.py

Draws and rigs follow from the seed of tuning, so that no development draw and no round has a part.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import compilation
from ventbench.controllers.pid import PID
from ventbench.plants.rigs import load_rigs
from ventbench.task import protocol, rollouts
from ventbench.task.draws import FIRST_DRAWN
from ventbench.task.metrics.score import controllable_error, passes_safety_gate
from ventbench.train.pid_search import TUNING, TUNING_SEED
from ventbench.train.plants import plants_to_train_on

#: P, I and D that are tried, %/cmH2O.
GRID = (2, 3, 4, 5, 6, 7, 8, 10), (2, 4, 6, 8), (0, 0.3, 2, 9)

#: Gains that are run together.
TOGETHER = 16


@jax.jit
def breaths(plant, gains, cell):
    def run(gains):
        phases = rollouts.closed_loop(plant, PID(*gains), cell, whole=True)
        return jnp.concatenate([phase.pressure for phase in phases], axis=-1)

    return jax.vmap(run)(gains)


def main():
    rigs, gains = load_rigs(), np.array(list(itertools.product(*GRID)), float)
    drawn = rigs.draws(20, seed=TUNING_SEED, name=TUNING)
    drawn = drawn.only(np.flatnonzero((drawn.rig >= FIRST_DRAWN).all(axis=0)))
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    weights = np.asarray(plants_to_train_on("frozen").weights)
    score, unsafe = np.zeros(len(gains)), np.zeros(len(gains), int)
    for lung, weight in enumerate(weights):
        with compilation.float64():
            plant, cell = jax.tree.map(lambda x: jnp.asarray(x[lung, 1:]), (plants, cells))  # noqa: B023
            some = [
                breaths(plant, jnp.asarray(g), cell)
                for g in np.split(gains, len(gains) // TOGETHER)
            ]
        pressure, pip, dt = np.concatenate(some), np.asarray(cell.pip), np.asarray(cell.dt)
        unsafe += (~passes_safety_gate(pressure, pip[..., None], dt[..., None])).sum(axis=(1, 2, 3))
        inspired = pressure[..., : protocol.INSPIRATION_STEPS]
        score += controllable_error(inspired, pip[..., None, None]).mean(axis=1) @ weight
    for at in np.argsort(np.where(unsafe, np.inf, score))[:5]:
        print(gains[at].tolist(), f"weighted error {score[at]:.2f}")
    at = np.argmin(score)
    print(f"without the gate {gains[at].tolist()}: {score[at]:.2f}, {unsafe[at]} breaths unsafe")


if __name__ == "__main__":
    main()
