"""Write ``lungs.npz``: gains of the six lungs, and what a first breath tells of each of them.

    ventbench tune pid --all --beyond --out runs/beyond
    python submissions/pid_scheduled/make.py runs/beyond/best.json

First breaths are simulated on all training rigs with noise and deviations drawn anew, under the
gains that are best for all lungs together.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from controller import estimate

from ventbench.controllers.pid import PID
from ventbench.task import draws, protocol, rollouts
from ventbench.task import environment as env
from ventbench.train.plants import plants_to_train_on

#: Breaths of each lung and PIP.
COPIES = 60


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("best", type=argparse.FileType("rb"), help="best.json of `tune pid`")
    result = json.load(parser.parse_args().best)
    trained_on = plants_to_train_on("frozen")
    gains = np.array([result["lungs"][name]["gains"] for name in trained_on.names])
    single = np.array(result["single"]["gains"])
    members, lungs = jax.tree.leaves(trained_on.plants)[0].shape[:2]
    lung, pip, _ = (x.ravel() for x in np.indices((lungs, len(protocol.PIPS), COPIES)))
    cell_key, member_key = jax.random.split(jax.random.key(0))
    member = np.asarray(jax.random.randint(member_key, lung.shape, 0, members))
    pips = jnp.asarray(np.asarray(protocol.PIPS)[pip], jnp.float32)
    cells = draws.random_scenarios(cell_key, pips)
    plants = jax.tree.map(lambda x: jnp.asarray(x[member, lung], jnp.float32), trained_on.plants)

    @jax.jit
    def breath(plants, cells):
        controller = PID(*jnp.asarray(single, jnp.float32))
        _, _, kept = rollouts.inspiration(
            env.vary(plants, cells, 0),
            cells,
            rollouts.controlled_by(controller),
            controller.init(cells.pip.shape),
            record=lambda before, _, __, applied: (applied, before.signals.reading),
        )
        return kept

    applied, reading = (np.asarray(x, float).T for x in breath(plants, cells))
    reading = reading + np.asarray(cells.noise)[:, 0]
    dt = np.broadcast_to(np.asarray(cells.dt), lung.shape)
    found = estimate(dt[:, None], applied[:, None], reading[:, None])
    centre = np.array([found[lung == k].mean(axis=0) for k in range(lungs)])
    away = found - centre[lung]
    precision = np.linalg.inv(away.T @ away / len(away))
    print(np.exp(centre))
    print("standard deviations", np.sqrt(np.diag(np.linalg.inv(precision))))
    np.savez(
        Path(__file__).parent / "lungs.npz",
        gains=gains,
        single=single,
        centre=centre,
        precision=precision,
    )


if __name__ == "__main__":
    main()
