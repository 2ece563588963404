"""What simulators err by on breaths of their own rigs, and of rigs that no fit has seen.

Every measured breath of a scored rig is simulated by the member that has not seen it. Then the gain
of the valve is fitted to the pressures of each rig, or of each breath, by itself, which no
prediction can do: what remains is not the gain's. ``--unseen`` does the same by fits that have not
seen the rig. Prints what docs/simulators.md quotes.

Usage:

    python benchmarks/own_rig_error.py [--recordings DIR] [--unseen]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import typer

from ventbench.base import compilation
from ventbench.base.arrays import Floats, Ints
from ventbench.plants import frozen
from ventbench.plants.hybrid import Hybrid
from ventbench.recordings import recordings_dir
from ventbench.task.lungs import LUNG_IDS
from ventbench.train.rigs.data import (
    InspirationData,
    RigRecordings,
    groups_of,
    inspirations,
    load_rig_recordings,
)
from ventbench.train.rigs.fit import centre, fit, plants, simulate

#: Gains that are tried, as logarithms of their ratio to the simulator's.
GAINS = np.linspace(-0.4, 0.4, 41)

#: Weights of reconstructed breaths and of breaths of lungs that are not scored, as in the fit.
RECONSTRUCTED, UNLISTED = 0.4, 0.2


@dataclass(frozen=True)
class Judged:
    """Measured breaths of the scored rigs, n of them; arrays ``(n,)``."""

    data: InspirationData
    lung: Ints
    session: Ints
    breath: Ints  #: number among the measured breaths.


@jax.jit
def breath_error(plant: Any, data: InspirationData, gain: Any) -> Any:
    """Mean absolute error of each breath with a gain of its own, cmH2O, ``(n,)``."""
    plant = plant.replace(slopes=plant.slopes * jnp.exp(gain)[:, None])
    error = jnp.abs(simulate(plant, data.start, data) - data.pressure)
    return jnp.sum(data.share * error, axis=1)


def best(plant: Hybrid, data: InspirationData, group: Ints) -> tuple[Floats, Floats]:
    """Errors with the best gain of every group of breaths, and these gains, ``(n,)`` each."""
    errors = [breath_error(plant, data, np.full(len(group), gain)) for gain in GAINS]
    of_groups = [np.bincount(group, np.asarray(error)) for error in errors]
    chosen = np.argmin(of_groups, axis=0)[group]
    return np.choose(chosen, errors), GAINS[chosen]


def judged(recordings: RigRecordings, simulators: frozen.Frozen) -> Judged:
    """Choose the measured breaths of scored rigs."""
    breaths = recordings.measured_breaths
    session = simulators.sessions.assign(breaths)
    lung = np.full(len(breaths), -1)
    for number, own in enumerate(simulators.rigs):
        lung[np.isin(session, own)] = number
    chosen = np.flatnonzero(lung >= 0)
    data = inspirations(breaths.select(chosen), simulators.sessions, recordings.labels)
    return Judged(data, lung[chosen], session[chosen], chosen)


def held_out_plants(recordings: RigRecordings, simulators: frozen.Frozen, chosen: Judged) -> Hybrid:
    """Members that have not seen the chosen breaths."""
    breaths = recordings.measured_breaths.select(chosen.breath)
    member = np.maximum(simulators.training_breaths.folds(breaths), 0)
    at = (member, chosen.session)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[at], float), simulators.members)


def unseen_plants(recordings: RigRecordings, simulators: frozen.Frozen, chosen: Judged) -> Hybrid:
    """Plants of the chosen breaths by fits that have not seen their rigs, nor those that failed."""
    table, labels = simulators.sessions, recordings.labels
    by_lung = {
        label.id: [k for k, about in enumerate(table.table) if about.lung == label.id]
        for label in labels
    }
    turns = max(len(by_lung[name]) for name in LUNG_IDS)
    whole = inspirations(recordings.breaths, table, labels)
    session = np.asarray(whole.groups.session)
    listed = np.isin(recordings.breaths.lung_ids, LUNG_IDS)
    weight = np.where(np.arange(len(session)) < recordings.measured, 1.0, RECONSTRUCTED)
    weight = weight * np.where(listed, 1.0, UNLISTED)
    groups = groups_of(recordings.breaths.select(chosen.breath), table, labels)
    around, out = centre(labels, len(table)), None
    for turn in range(turns):
        left = [k for own in by_lung.values() if len(own) > 1 for k in own[turn::turns]]
        own = np.where(np.isin(session, [*left, *simulators.rejected]), 0.0, weight)
        fitted = fit(whole, jnp.asarray(own, jnp.float32), around)
        now = np.isin(chosen.session, left)

        def choose(new: Any, old: Any, now: Any = now) -> Any:
            return np.where(now.reshape(-1, *(1,) * (np.ndim(new) - 1)), new, old)

        plant = plants(fitted.pooled, groups)
        out = plant if out is None else jax.tree.map(choose, plant, out)
    assert out is not None
    return out


def row(name: str, error: Floats, lung: Ints) -> str:
    """One row of a Markdown table: mean / median by lung, and over all breaths."""
    cells = [f"{error[lung == k].mean():.2f} / {np.median(error[lung == k]):.2f}" for k in range(6)]
    return f"| {name} | {' | '.join(cells)} | {error.mean():.2f} / {np.median(error):.2f} |"


def main(recordings: Path | None = None, unseen: bool = False) -> None:
    """What simulators err by on breaths of their own rigs, and of rigs that no fit has seen.

    --unseen: by fits that have not seen the rig.
    """
    folder = recordings or recordings_dir()
    if folder is None:
        print("no recordings: give --recordings DIR or set VENTBENCH_RECORDINGS")
        return
    compilation.keep()
    measured, simulators = load_rig_recordings(folder, folds=5, seed=0), frozen.load()
    with compilation.float32() if unseen else compilation.float64():
        chosen = judged(measured, simulators)
        plant = (unseen_plants if unseen else held_out_plants)(measured, simulators, chosen)
        data, lung, session = chosen.data, chosen.lung, chosen.session
        plain = np.asarray(breath_error(plant, data, np.zeros(len(lung))))
        of_rig, _ = best(plant, data, session)
        of_breath, gain = best(plant, data, np.arange(len(lung)))
    print(f"| | {' | '.join(LUNG_IDS)} | all |")
    print("|---" * 8 + "|")
    print(row("unseen rig" if unseen else "held out", plain, lung))
    print(row("own gain a rig", of_rig, lung))
    print(row("own gain a breath", of_breath, lung))
    of_session = np.array([np.mean(gain[session == k]) for k in session])
    free = len(gain) - len(np.unique(session))
    spread = np.sqrt(np.sum((gain - of_session) ** 2) / free)
    print(f"\ngain of a breath around the mean of its rig: standard deviation {spread:.3f}")


if __name__ == "__main__":
    typer.run(main)
