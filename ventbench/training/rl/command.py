"""What ``ventbench train ppo`` and ``ventbench train dqn`` do."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench import files, precision
from ventbench.controllers.pid import PID
from ventbench.lungs import LUNG_IDS
from ventbench.plants import frozen
from ventbench.training.rl import export, features, recipes
from ventbench.training.rl.training import Trained, nominal_error, train

#: Name of the network that does not know the lung.
ALL = "all"

#: Called with what is trained, the share that is done and the best error so far, cmH2O.
Progress = Callable[[str, float, float], None]


@dataclass(frozen=True)
class _Group:
    """Networks that are trained side by side: of ``names``, each on ``lungs`` lungs."""

    names: tuple[str, ...]
    lungs: int


def groups(targets: Sequence[str]) -> list[_Group]:
    """Split networks to train into those of one lung and that of all six."""
    one = tuple(name for name in targets if name != ALL)
    found = [_Group(one, 1)] if one else []
    return [*found, _Group((ALL,), len(LUNG_IDS))] if ALL in targets else found


def run(
    method: str,
    targets: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    *,
    steps: int | None = None,
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """Train networks, keep the best seed of each and write ``weights.npz`` and ``training.json``.

    The best seed is the one with the lowest error on freshly drawn cells; the published draws have
    no part in it. Checkpoints lie in ``out`` until all is done.

    Args:
        method: ``"ppo"`` or ``"dqn"``.
        targets: ids of lungs, and :data:`ALL`.
        seeds: of the trainings of each network.
        out: folder.
        steps: control steps of experience of each training; the recipe's if not given.
        progress: see :data:`Progress`.

    Returns:
        The content of ``training.json``.

    Raises:
        InputError: if there are too few steps, or a checkpoint in ``out`` is of another training.
    """
    began = time.perf_counter()
    simulators = frozen.load()
    policies, networks, checkpoints, used = {}, {}, [], {}
    for group in groups(targets):
        recipe = recipes.recipe(method, group.lungs, steps)
        label = ALL if group.lungs > 1 else ", ".join(group.names)
        checkpoint = out / f".{method}-{'all' if group.lungs > 1 else 'one'}.npz"
        checkpoints.append(checkpoint)
        plants = _plants(simulators.plants, group, len(seeds))
        trained = train(
            recipe,
            plants,
            [seed for _ in group.names for seed in seeds],
            chunk=recipes.CHUNKS[method],
            about=f"{group.names} {simulators.manifest_sha256}",
            file=checkpoint,
            progress=lambda share, best, label=label: progress(label, share, float(best.mean())),
        )
        pids = _pid_errors(plants)
        used["all" if group.lungs > 1 else "one"] = asdict(recipe)
        for i, name in enumerate(group.names):
            networks[name], best = _judge(trained, i, seeds)
            networks[name]["error_pid"] = pids[i * len(seeds)]
            policies[name] = export.pick(trained.policies, best)
    about = {
        "method": method,
        "recipes": used,
        "networks": networks,
        "simulators": simulators.about(),
        "jax": jax.__version__,
        "seconds": round(time.perf_counter() - began, 1),
    }
    export.write(out / "weights.npz", policies)
    files.write_json(out / "training.json", about)
    for checkpoint in checkpoints:
        checkpoint.unlink(missing_ok=True)
    return about


def _plants(plants: Any, group: _Group, seeds: int) -> Any:
    """Leaves ``(R, lungs, ...)``: the seeds of a network in a row."""
    if group.lungs > 1:
        return jax.tree.map(lambda leaf: np.repeat(leaf[None], seeds, axis=0), plants)
    index = np.repeat([LUNG_IDS.index(name) for name in group.names], seeds)
    return jax.tree.map(lambda leaf: leaf[index][:, None], plants)


def _pid_errors(plants: Any) -> list[float]:
    """Nominal error of the PID that is corrected, on the lungs of each run, cmH2O."""
    with precision.float32():
        plants = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), plants)
        found = jax.jit(jax.vmap(lambda plant: nominal_error(plant, PID(*features.GAINS))))(plants)
        return [float(error) for error in found]


def _judge(trained: Trained, network: int, seeds: Sequence[int]) -> tuple[dict[str, Any], int]:
    first = network * len(seeds)
    rows = slice(first, first + len(seeds))
    best = first + int(np.argmin(trained.validation[rows]))
    about = {
        "seed": int(seeds[best - first]),
        "error_fresh": [float(value) for value in trained.validation[rows]],
        "error_nominal_at_end": [float(value) for value in trained.curves[rows, -1]],
        "breaths": int(trained.episodes[-1]),
        "training_seconds": round(float(trained.seconds[-1]), 1),
    }
    return about, best
