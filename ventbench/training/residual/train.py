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
from ventbench.training.trained import ALL, TrainedControllers, check_names, simulators_to_train_on

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
        config: settings of the training.
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
    simulators, out = simulators_to_train_on(simulator), Path(out)
    names, known = check_names(networks, simulators), [entry.id for entry in simulators.lungs]
    config, progress = config or ResidualConfig(), progress or (lambda what, how_far: None)
    progress("PID grid", None)
    ensemble = simulators.ensemble
    official = jax.tree.map(lambda leaf: np.asarray(leaf)[0], ensemble)
    lungs = {name: take(official, index) for index, name in enumerate(known)}
    wanted = lungs if ALL in names else {name: lungs[name] for name in names}
    grid = search(wanted, settings=simulators.about, gains=gains)
    controllers, about = {}, {}
    for name in names:
        best, _ = grid.best(None if name == ALL else name)
        where = list(range(len(known))) if name == ALL else [known.index(name)]
        plants = jax.tree.map(lambda leaf, where=where: np.asarray(leaf)[:, where], ensemble)
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
            )
        about[name] = {
            "gains": list(best),
            "seconds": round(time.perf_counter() - started, 1),
            "error_pid": _errors(PID(*best), lungs, where),
            "error": _errors(controllers[name], lungs, where),
        }
    save_weights(out / WEIGHTS, controllers)
    report = {
        "networks": about,
        "recipe": dataclasses.asdict(config),
        "seed": seed,
        "simulators": dict(simulators.about),
        "weights_sha256": files.sha256(out / WEIGHTS),
    }
    files.write_json(out / RESULT, report)
    for name in names:
        _checkpoint(out, name).unlink(missing_ok=True)
    return TrainedControllers(controllers, report, out)


def _checkpoint(out: Path, name: str) -> Path:
    return out / PARTS / f"{name}.npz"


def _errors(
    controller: Controller, lungs: Mapping[str, Plant], where: list[int]
) -> dict[str, float]:
    """Nominal score on each lung, float64, cmH2O."""
    errors = {}
    with precision.float64():
        cells = nominal_scenario(np.array(protocol.PIPS))
        wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
        for name in [list(lungs)[index] for index in where]:
            plant = jax.tree.map(jnp.asarray, lungs[name])
            inspirations, _ = rollouts.closed_loop(plant, wide, cells)
            error = run_error(inspirations.pressure, np.asarray(cells.pip)[:, None, None])
            errors[name] = round(float(error.mean()), 6)
    return errors
