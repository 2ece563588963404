"""What ``ventbench train residual`` does: gains from the grid, networks, weights, what came out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import files, precision, protocol, rollouts
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import Residual
from ventbench.interfaces import Controller, Plant
from ventbench.lungs import LUNG_IDS
from ventbench.metrics.waveform import run_error
from ventbench.plants.stacking import take
from ventbench.scenario import nominal
from ventbench.training import pid_grid
from ventbench.training.pid_tuning.grid import tune
from ventbench.training.pid_tuning.table import best_gains
from ventbench.training.residual import weights
from ventbench.training.residual.fit import fit
from ventbench.training.residual.recipe import Progress, Recipe

#: Files that are written.
WEIGHTS, RESULT, PARTS = "weights.npz", "training.json", "parts"

#: Called with what is being done, and how far it is.
Report = Callable[[str, Progress | None], None]


def train(
    ensemble: Plant,
    names: tuple[str, ...],
    out: Path,
    *,
    simulators: Mapping[str, Any],
    recipe: Recipe | None = None,
    seed: int = 0,
    gains: NDArray[np.float64] | None = None,
    report: Report | None = None,
) -> dict[str, Any]:
    """Train networks and write ``weights.npz`` and ``training.json``.

    An interrupted training goes on; a finished one is done anew, to the same bytes.

    Args:
        ensemble: leaves ``(members, 6, ...)``, lungs in the order of ``LUNGS``.
        names: of the networks: ids of lungs, or ``all``.
        out: folder.
        simulators: what is known of them, for the result.
        recipe: of the training.
        seed: of all networks.
        gains: grid of which each PID is the best; the paper's if not given.
        report: see :data:`Report`.

    Returns:
        What ``training.json`` holds.

    Raises:
        InputError: if the folder holds the half of another training.
        FloatingPointError: if a training diverges.
    """
    recipe, report = recipe or Recipe(), report or (lambda what, progress: None)
    report("PID grid", None)
    official = jax.tree.map(lambda leaf: np.asarray(leaf)[0], ensemble)
    lungs = {name: take(official, index) for index, name in enumerate(LUNG_IDS)}
    wanted = lungs if weights.ALL in names else {name: lungs[name] for name in names}
    grid = tune(wanted, identity=simulators, gains=pid_grid.gains() if gains is None else gains)
    controllers, about = {}, {}
    for name in names:
        one = name != weights.ALL
        chosen, _ = best_gains(grid, name if one else None)
        where = [LUNG_IDS.index(name)] if one else list(range(len(LUNG_IDS)))
        plants = jax.tree.map(lambda leaf, where=where: np.asarray(leaf)[:, where], ensemble)
        started = time.perf_counter()
        controllers[name] = _finished(out / PARTS, name, plants, chosen, recipe, seed, report)
        about[name] = {
            "gains": list(chosen),
            "seconds": round(time.perf_counter() - started, 1),
            "error_pid": _errors(PID(*chosen), lungs, where),
            "error": _errors(controllers[name], lungs, where),
        }
    weights.save(out / WEIGHTS, controllers)
    result = {
        "networks": about,
        "recipe": dataclasses.asdict(recipe),
        "seed": seed,
        "simulators": dict(simulators),
        "weights_sha256": files.sha256(out / WEIGHTS),
    }
    files.write_json(out / RESULT, result)
    for name in names:
        (out / PARTS / f"{name}.npz").unlink(missing_ok=True)
    return result


def _finished(
    folder: Path,
    name: str,
    plants: Plant,
    gains: tuple[float, float, float],
    recipe: Recipe,
    seed: int,
    report: Report,
) -> Residual:
    """One network: trained on, or trained."""
    folder.mkdir(parents=True, exist_ok=True)
    with precision.float32():
        return fit(
            plants,
            gains,
            recipe=recipe,
            seed=seed,
            checkpoint=folder / f"{name}.npz",
            progress=lambda progress: report(f"network {name}", progress),
            keep=True,
        )


def _errors(
    controller: Controller, lungs: Mapping[str, Plant], where: list[int]
) -> dict[str, float]:
    """Nominal score on each lung, float64, cmH2O."""
    found = {}
    with precision.float64():
        cells = nominal(np.array(protocol.PIPS))
        wide = jax.tree.map(lambda x: jnp.asarray(x, float), controller)
        for index in where:
            name = LUNG_IDS[index]
            plant = jax.tree.map(jnp.asarray, lungs[name])
            inspirations, _ = rollouts.closed_loop(plant, wide, cells)
            error = run_error(inspirations.pressure, np.asarray(cells.pip)[:, None, None])
            found[name] = round(float(error.mean()), 6)
    return found
