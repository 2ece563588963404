"""How many breaths each way of learning needs: one lung, several seeds, one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from ventbench import files
from ventbench.lungs import LUNG_IDS, Lung
from ventbench.plants import frozen
from ventbench.training import pid_grid
from ventbench.training.curves import Curve, Study
from ventbench.training.rl import recipes
from ventbench.training.rl.policy_gradient import PolicyGradient
from ventbench.training.rl.training import Trained, train

#: Iterations between two points of a curve, by method.
CHUNKS = {"policy-gradient": 1, "policy-gradient-short": 1, "ppo": 2, "dqn": 8}

#: Called with the method, the share of it that is done, the lowest mean error so far, cmH2O.
Progress = Callable[[str, float, float], None]


def methods(share: float = 1.0) -> dict[str, recipes.Recipe]:
    """Recipes of the study; ``share`` below 1 shortens all trainings."""
    found = {name: recipes.recipe(name, 1) for name in recipes.METHODS}
    # The same, but told to be done after 96 breaths: faster, and falling to zero within them.
    long = found["policy-gradient"]
    assert isinstance(long, PolicyGradient)
    found = {
        "policy-gradient-short": replace(long, iterations=96 // long.breaths, learning_rate=1e-2),
        **found,
    }
    return {
        name: replace(recipe, iterations=max(int(share * recipe.iterations), 1))
        for name, recipe in found.items()
    }


def samples(
    lung: Lung,
    seeds: Sequence[int],
    out: Path,
    *,
    share: float = 1.0,
    progress: Progress = lambda *_: None,
) -> Study:
    """Train by every method with every seed; what is done already is read from ``out``.

    All methods correct the same PID with the same features, see cells drawn from the same
    distributions and are judged by the score without noise.

    Args:
        lung: one of the six.
        seeds: of the trainings.
        out: folder of the checkpoints, ``samples.csv`` and ``summary.csv``.
        share: of the full length of each training.
        progress: see :data:`Progress`.

    Raises:
        InputError: if ``out`` holds another study.
    """
    simulators = frozen.load()
    at = LUNG_IDS.index(lung.id)
    one = jax.tree.map(lambda leaf: leaf[at : at + 1], simulators.plants)
    plants = jax.tree.map(lambda leaf: np.repeat(leaf[None], len(seeds), axis=0), one)
    curves = []
    for name, recipe in methods(share).items():
        trained = train(
            recipe,
            plants,
            seeds,
            chunk=min(CHUNKS[name], recipe.iterations),
            about=f"study {lung.id} {simulators.manifest_sha256}",
            file=out / f"{name}.npz",
            progress=lambda done, error, name=name: progress(name, done, float(error.mean())),
        )
        curves.append(_curve(name, trained))
    grid = pid_grid.errors(one, pid_grid.gains())[0].mean(axis=-1)
    study = Study(lung.id, tuple(curves), float(curves[0].scores[0, 0]), float(grid.min()))
    files.write_text(out / "samples.csv", study.points().to_csv(index=False))
    files.write_text(out / "summary.csv", study.summary().to_csv(index=False))
    return study


def _curve(name: str, trained: Trained) -> Curve:
    scores = trained.curves.astype(float)
    return Curve(name, trained.episodes, trained.seconds, trained.compile_seconds, scores)
