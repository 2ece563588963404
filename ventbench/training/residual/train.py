"""Residual networks for the lungs: PID gains from the grid, training, weights and a report."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import files, precision, protocol, rollouts
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import save_weights
from ventbench.environment import nominal_scenario
from ventbench.interfaces import Controller, Plant
from ventbench.metrics.score import run_error
from ventbench.plants.catalog import Given
from ventbench.plants.stacking import take
from ventbench.training.pid_grid import search
from ventbench.training.residual.fit import ResidualConfig, fit
from ventbench.training.rig_pid import tune_on_rigs
from ventbench.training.rig_plants import TrainingPlants, plants_to_train_on
from ventbench.training.trained import ALL, TrainedControllers, check_names

#: Files that are written.
WEIGHTS, RESULT, PARTS = "weights.npz", "training.json", "parts"

#: Called with the name of the step, and its progress: updates done, updates in all, loss in cmH2O.
Progress = Callable[[str, tuple[int, int, float] | None], None]


def train_residual(
    networks: Sequence[str] | None = None,
    out: Path | str = "runs/residual",
    *,
    config: ResidualConfig | None = None,
    seed: int = 0,
    gains: NDArray[np.float64] | None = None,
    simulator: Given = "frozen",
    progress: Progress | None = None,
) -> TrainedControllers:
    """Train corrections of the best PIDs by differentiating through simulators.

    Writes ``weights.npz``, as ``submissions/residual_mlp`` reads it, and ``training.json``. An
    interrupted training continues where it was; a finished one is repeated, to the same bytes.

    Example::

        trained = ventbench.train_residual(["R20C50"], "runs/mine")
        trained.report["networks"]["R20C50"]["error"]  # cmH2O, by lung

    Args:
        networks: ids of lungs, a network each, or ``"all"`` for one network that serves all; a
            network for each lung of the simulators if not given.
        out: folder.
        config: settings of the training; its ``protocol`` says for which version of the protocol,
            see :func:`ventbench.training.rig_plants.plants_to_train_on`.
        seed: seed of the weights and the random deviations, common to all networks.
        gains: grid of P, I, D, %/cmH2O, shape ``(G, 3)``, of which each network corrects the best
            PID; the paper's grid if not given.
        simulator: simulators with plants to train through, see :func:`ventbench.load_simulators`;
            all members of the ensemble if there is one.
        progress: see :data:`Progress`.

    Returns:
        The controllers, float32, and the report.

    Raises:
        InputError: if a network's name or a simulator is unknown, or ``out`` holds an unfinished
            training with other settings.
        FloatingPointError: if a training diverges.
    """
    config, progress = config or ResidualConfig(), progress or (lambda what, how_far: None)
    trained_on, out = plants_to_train_on(simulator, config.protocol), Path(out)
    names, known = check_names(networks, trained_on), list(trained_on.names)
    progress("PID grid", None)
    official = trained_on.nominal
    lungs = {name: take(official, index) for index, name in enumerate(known)}
    wanted = lungs if ALL in names else {name: lungs[name] for name in names}
    best_gains = _best_gains(simulator, trained_on, wanted, names, config, gains)
    controllers, about = {}, {}
    for name in names:
        best = best_gains[name]
        where = list(range(len(known))) if name == ALL else [known.index(name)]
        plants = jax.tree.map(
            lambda leaf, where=where: np.asarray(leaf)[:, where], trained_on.plants
        )
        started = time.perf_counter()
        with precision.float32():
            controllers[name] = fit(
                plants,
                best,
                config=config,
                seed=seed,
                checkpoint=_checkpoint(out, name),
                progress=lambda *how_far, name=name: progress(f"network {name}", how_far),
                keep=True,
                weights=trained_on.weights[where],
            )
        about[name] = {
            "gains": list(best),
            "seconds": round(time.perf_counter() - started, 1),
            "error_pid": _errors(PID(*best), lungs, where, config.protocol),
            "error": _errors(controllers[name], lungs, where, config.protocol),
        }
    save_weights(out / WEIGHTS, controllers)
    report = {
        "networks": about,
        "recipe": dataclasses.asdict(config),
        "seed": seed,
        "simulators": dict(trained_on.about),
        "weights_sha256": files.sha256(out / WEIGHTS),
    }
    files.write_json(out / RESULT, report)
    for name in names:
        _checkpoint(out, name).unlink(missing_ok=True)
    return TrainedControllers(controllers, report, out)


def _best_gains(
    simulator: Given, trained_on: TrainingPlants, lungs: Mapping[str, Plant], names: Sequence[str],
    config: ResidualConfig, gains: NDArray[np.float64] | None,
) -> dict[str, tuple[float, float, float]]:  # fmt: skip
    """Gains of the PID that each network corrects, %/cmH2O."""
    if config.protocol == 1:
        grid = search(lungs, settings=trained_on.about, gains=gains)
        return {name: grid.best(None if name == ALL else name)[0] for name in names}
    tuned = tune_on_rigs(simulator, gains=gains)
    each = dict(zip(tuned.lungs, tuned.gains.tolist(), strict=True))
    each[ALL] = tuned.single.tolist()
    return {name: (each[name][0], each[name][1], each[name][2]) for name in names}


def _checkpoint(out: Path, name: str) -> Path:
    return out / PARTS / f"{name}.npz"


def _errors(
    controller: Controller, lungs: Mapping[str, Plant], where: list[int], version: int
) -> dict[str, float]:
    """Nominal score on each lung by a version of the protocol, float64, cmH2O."""
    errors = {}
    with precision.float64():
        cells = nominal_scenario(np.array(protocol.PIPS))
        wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
        for name in [list(lungs)[index] for index in where]:
            plant = jax.tree.map(jnp.asarray, lungs[name])
            inspirations, _ = rollouts.closed_loop(plant, wide, cells, airway=version == 2)
            error = run_error(inspirations.pressure, np.asarray(cells.pip)[:, None, None])
            errors[name] = round(float(error.mean()), 6)
    return errors
