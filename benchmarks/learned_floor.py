"""What a network attains that is told more than readings: an upper bound of the floor.

The network of ``submissions/recurrent`` is trained on from its published weights, by its own
program, but on no runs far beyond. Its encoder reads further numbers, whose weights begin at 0:

- *nothing*: zeros, the control, which comes first;
- *rig*: resistance, elastance, valve and all else of the rig, with the deviations of the run;
- *gain*: these, and the gain of the valve in the breath to come; PEEP, the pressure at the start
  and noise stay unknown.

Runs are on rigs of the population that the rigs of rounds are drawn from, and on the entry's
recorded rigs. The entry itself may not know that population, which holds rigs that are held out of
every training: this is a bound, not an entry.

It prints normalised scores as of the board after each 200 updates, on the development draws, where
no breath has a gain of its own, and on the ranked draws of the last round; at the end with 95 %,
and how far below the control's they are. ``runs/floor`` keeps what an interrupted training goes on
from.

Usage:

    python benchmarks/learned_floor.py [--told rig]
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jax import Array

from ventbench.base import compilation, files
from ventbench.board import rounds
from ventbench.entries.reference import published
from ventbench.plants.rigs import load_rigs
from ventbench.task.draws import COUNT, Draws
from ventbench.task.metrics.bootstrap import limits, resampled_scores
from ventbench.task.metrics.score import normalised

ENTRY = Path(__file__).parents[1] / "submissions/recurrent"
sys.path.append(str(ENTRY))

from submissions.recurrent import train  # noqa: E402  # it imports its neighbour `network`

#: What a network is told, each with all of those before it.
TOLD = ("nothing", "rig", "gain")

#: Parameters of a rig that may be zero or negative; of the others the logarithm is told.
SIGNED = ("stiffening", "offset", "direction")

#: Commands at which the flow of the valve is told as well, %.
VALVE_AT = (5.0, 10.0, 20.0, 40.0)

# As they are in the entry; below, others take their place.
_features, _loss, _save = train.network.features, train.loss, train.save

#: Draws runs of the two kinds of the entry's training that are not far beyond.
draw = partial(train.draw, times=train.DRAWN + train.RECORDED)


def population() -> Any:
    """What runs are drawn from: the population of rounds, and the entry's recorded rigs."""
    rigs: Any = train.rigs_to_train_on()
    drawn: Any = load_rigs().population
    # One covariance for all lungs, as the entry has it.
    factor = np.linalg.cholesky((drawn.factor @ drawn.factor.swapaxes(1, 2)).mean(0))
    rigs = rigs.replace(mean=jnp.asarray(drawn.mean), factor=jnp.asarray(factor))
    return rigs.replace(weight=train._weights(rigs))


def parameters(runs: Any) -> Array:
    """Parameters of the rigs of n runs, with the runs' deviations, ``(n, p)``."""
    cells = runs.cells
    rig = runs.rigs.vary(cells.r_scale, cells.c_scale)
    columns = [x if name in SIGNED else jnp.log(x) for name, x in vars(rig).items()]
    columns += [jnp.log(rig.valve(jnp.full_like(rig.R, u_in))) for u_in in VALVE_AT]
    return jnp.concatenate([x.reshape(len(cells.pip), -1) for x in (*columns, cells.delay)], 1)


def informed(runs: Any, knowledge: Any) -> Any:
    """Context in which the encoder is told something about n runs.

    Args:
        runs: n of them.
        knowledge: an index of :data:`TOLD`, mean and standard deviation of :func:`parameters`.
    """
    told, mean, deviation = knowledge
    rig = (told > 0) * jnp.clip((parameters(runs) - mean) / deviation, -4.0, 4.0)
    gain = (told > 1) * jnp.log(runs.cells.gain) / 0.1

    def features(*given: Any) -> Array:
        # The fourth says which breaths are done.
        breath = given[3][0].sum().astype(int)
        return jnp.concatenate([_features(*given), rig, gain[:, breath, None]], -1)

    return patch.object(train.network, "features", features)


@jax.jit
def errors(weights: Any, runs: Any, knowledge: Any) -> Array:
    """Errors of n runs over steps 2 to 34 of the scored breaths, cmH2O, ``(n,)``."""
    with informed(runs, knowledge):
        pressure = train.roll(weights, runs)[0]
    return jnp.abs(pressure - runs.cells.pip)[1:].mean((0, 1))


def runs_of(draws: Draws) -> Any:
    """Runs of draws as the entry's training has them, n = L K P."""
    shape = draws.cells.pip.shape

    def flat(leaf: Any) -> Array:
        leaf = np.broadcast_to(leaf, (*shape, *leaf.shape[3:]))
        return jnp.asarray(leaf.reshape(-1, *leaf.shape[3:]))

    plants, cells = jax.tree.map(flat, (load_rigs().plants_of(draws), draws.cells))
    zeros = jnp.zeros_like(cells.gain)
    altered: Any = dict.fromkeys(("leak", "dead", "wear", "effort", "onset"), zeros)
    return train.Runs(plants, cells, altered, jnp.ones((2, *zeros.shape)), cells.pip, cells.pip)


def main(told: str = "nothing", updates: int = 1500, seed: int = 0) -> None:
    """What a network attains that is told more than readings: an upper bound of the floor."""
    compilation.keep()
    rigs, last = load_rigs(), rounds.load_all(files.leaderboard_folder())[0]
    sets = (rigs.draws(COUNT), published()), (last.draws(rigs), last.bounds())
    sampled, level = population(), TOLD.index(told)
    table = parameters(draw(sampled, jax.random.key(1)))
    scale = table.mean(0), table.std(0) + 1e-6
    folder = f"runs/floor/{{}}-{updates}-{seed}"

    def scores(weights: Any, level: int) -> list[Any]:
        """Normalised scores of each lung and ranked draw, ``(L, k)``, in each set of draws."""
        found = []
        for draws, bounds in sets:
            error = errors(weights, runs_of(draws), (level, *scale))
            best, pid = bounds.attainable[:, 1:], bounds.pid[:, 1:]
            score = normalised(error.reshape(pid.shape), best, pid)
            found.append(score.mean(axis=2)[:, draws.ranked])
        return found

    def save(weights: Any, path: Path) -> None:
        _save(weights, path)
        print("scores:", *(f"{values.mean():.2f}" for values in scores(weights, level)))

    def loss(weights: Any, runs: Any) -> Any:
        with informed(runs, (level, *scale)):
            return _loss(weights, runs)

    weights = dict(np.load(ENTRY / "weights.npz"))
    weights["in"] = np.pad(weights["in"], ((0, table.shape[1] + 1), (0, 0)))
    out = folder.format(told)
    _save(weights, Path(out) / "start.npz")
    argv = (
        f"train.py --start {out}/start.npz --checkpoint {out}/state.npz --out {out} "
        f"--seed {seed} --updates {updates} --rate 2e-3"
    ).split()
    replaced: Any = {"rigs_to_train_on": lambda: sampled, "draw": draw, "loss": loss, "save": save}
    with patch.multiple(train, **replaced), patch.object(sys, "argv", argv):
        train.main()
    ends = (scores(dict(np.load(f"{folder.format(TOLD[k])}/weights.npz")), k) for k in (0, level))
    for (draws, _), before, values in zip(sets, *ends, strict=True):
        print(f"{draws.name} draws, told {told}: score, and below the control")
        for some in (values, before - values):
            places = (x[:, draws.ranked] for x in (draws.rig, draws.member))
            print(f"{some.mean():8.1f}", np.round(limits(resampled_scores(some, *places)), 1))


if __name__ == "__main__":
    typer.run(main)
