"""What a seed is worth: networks of each learning method on one lung, with one budget of breaths.

Residual networks, PPO and DQN correct the same PID, learn on the training rigs of one lung from as
many breaths, and are scored on the ranked draws of a round: rigs that nobody trained on. Prints the
normalised score of each seed, the interquartile mean, its 95 % interval over seeds, and processor
time of the call that ended it. What is finished is kept; the same command continues.

Usage:

    python benchmarks/seeds.py [--lung R20C20] [--seeds 5] [--out runs/seeds] [--only ppo]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from proofs.studies.samples import band, interquartile_mean
from ventbench.base import compilation, files, precision
from ventbench.board import rounds
from ventbench.controllers import rl_policy
from ventbench.plants.rigs import load_rigs
from ventbench.task import protocol, rollouts
from ventbench.task.metrics.score import controllable_error, normalised
from ventbench.train.plants import plants_to_train_on
from ventbench.train.residual import ResidualConfig, fit
from ventbench.train.rl import episodes
from ventbench.train.rl.train import CHUNKS, method_for, train

ROOT = Path(__file__).parents[1]

#: Round whose ranked draws and bounds the scores are of, and breaths that each training sees.
ROUND, BREATHS = "rehearsal-3", 57_600

METHODS = ("residual", "ppo", "dqn")


def trained(method: str, lung: int, seeds: int, out: Path) -> list[Any]:
    """Train a controller with each seed on the training rigs of a lung.

    Args:
        method: one of :data:`METHODS`.
        lung: its index.
        seeds: their number.
        out: folder of checkpoints.
    """
    given = plants_to_train_on()
    plants = jax.tree.map(lambda leaf: np.asarray(leaf)[:, [lung]], given.plants)
    weights = given.weights[[lung]]
    if method == "residual":
        runs = len(protocol.PIPS) * ResidualConfig.copies * protocol.BREATHS
        config = replace(ResidualConfig(), updates=BREATHS // runs)
        with precision.float32():
            return [
                fit(
                    plants, rl_policy.GAINS, config=config, seed=seed, weights=weights, keep=True,
                    checkpoint=out / f"residual-{given.names[lung]}-{seed}.npz",
                )
                for seed in range(seeds)
            ]  # fmt: skip
    settings = method_for(method, 1, BREATHS * episodes.STEPS)
    every = [
        jax.tree.map(lambda leaf: np.stack([leaf] * seeds), part) for part in (plants, weights)
    ]
    found = train(
        settings, episodes.Lungs(*every), range(seeds), chunk=CHUNKS[method],
        about=f"seeds {given.names[lung]}", file=out / f"{method}-{given.names[lung]}.npz",
    )  # fmt: skip
    return [jax.tree.map(lambda leaf, k=k: leaf[k], found.policies) for k in range(seeds)]


def scores(controllers: list[Any], lung: int) -> list[float]:
    """Normalised score of each controller on the ranked draws of a lung."""
    own, rigs = rounds.load(ROOT / "leaderboard", ROUND), load_rigs()
    drawn, bounds = own.draws(rigs), own.bounds()
    at = np.flatnonzero(drawn.ranked)
    with precision.float64():
        parts = jax.tree.map(
            lambda leaf: np.asarray(leaf)[lung, 1 + at], rigs.cells(drawn, protocol.PIPS)
        )
        plants, cells = jax.tree.map(jnp.asarray, parts)
        found = []
        for controller in controllers:
            wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
            pressure = np.asarray(rollouts.closed_loop(plants, wide, cells)[0].pressure)
            error = controllable_error(pressure, np.asarray(cells.pip)[..., None, None])
            best, pid = bounds.attainable[lung, 1 + at], bounds.pid[lung, 1 + at]
            found.append(float(normalised(error, best, pid).mean()))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lung", default="R20C20")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/seeds"))
    parser.add_argument("--only", choices=METHODS)
    given = parser.parse_args()
    compilation.keep()
    given.out.mkdir(parents=True, exist_ok=True)
    lung = plants_to_train_on().names.index(given.lung)
    for method in METHODS if given.only is None else (given.only,):
        table = given.out / f"{method}-{given.lung}.json"
        if not table.is_file():
            began = time.process_time()
            controllers = trained(method, lung, given.seeds, given.out)
            seconds = round(time.process_time() - began, 1)
            found = scores(controllers, lung)
            files.write_json(table, {"scores": found, "seconds": seconds})
        kept = json.loads(table.read_text("utf-8"))
        found = np.array(kept["scores"])
        low, high = band(found[:, None])
        print(
            f"{method:9}{interquartile_mean(found):6.1f} ({low[0]:.1f} to {high[0]:.1f}), seeds "
            f"{', '.join(f'{score:.1f}' for score in found)}; {kept['seconds']:.0f} s of processor "
            f"time, {BREATHS:,} breaths each, {given.lung}"
        )


if __name__ == "__main__":
    main()
