"""Every table and figure of the paper that needs no hardware, made again and set beside ours.

What takes seconds is computed: the PID grid, the bundled entries, an exploration. What takes
minutes or needs recordings is read from ``proofs/paper/stored.json``, where earlier runs of
:func:`reproduce_paper` with ``recordings`` and of the studies (``python -m proofs study ...
--store``) have stored it with its provenance.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs.paper import controller_sections as controllers
from proofs.paper import simulator_sections as simulators
from proofs.paper.report import Reproduction
from proofs.studies.networks import MEASURED
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.board import replay, store
from ventbench.board.canonical import RECORDS
from ventbench.entries.scoring import score
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.train import pid_search

#: File of stored results.
STORED = Path(__file__).with_name("stored.json")

#: The published leaderboard of this checkout.
LEADERBOARD = Path(__file__).parents[2] / "leaderboard"

#: Entry and track by the name that tables have.
ENTRIES = {
    "residual": ("residual_mlp", "performance"),
    "residual, all lungs": ("residual_mlp_all", "robustness"),
    "PPO": ("ppo", "performance"),
    "DQN": ("dqn", "performance"),
}

#: Called with what is done and the share of all that is done.
Progress = Callable[[str, float], None]


def reproduce_paper(
    *,
    recordings: Path | str | None = None,
    workers: int = 0,
    progress: Progress = lambda *_: None,
) -> tuple[Reproduction, dict[str, Any]]:
    """Set the paper's tables, figures and claims beside ours.

    Args:
        recordings: folder of the public recordings: errors by horizon are measured again.
        workers: processes for entries; 0 for this one alone.
        progress: see :data:`Progress`.

    Returns:
        The comparison, and what ``proofs/paper/stored.json`` should hold after this run.

    Raises:
        InputError: if a recording is malformed.
    """
    official = frozen.load()
    kept = load_stored()
    if recordings is not None:
        progress("errors by horizon", 0.0)
        kept["horizon"] = simulators.measure_horizon(Path(recordings) / MEASURED, kept["horizon"])
    progress("PID grid", 0.1)
    gains = pid_search.paper_gains()
    error = pid_search.errors(official.plants, gains)
    grid = pid_search.PIDGrid(LUNG_IDS, protocol.PIPS, gains, error)
    with executor(workers) as pool:
        scored: dict[str, tuple[Floats, Floats]] = {}
        for name, result in results(pool, _scored, ENTRIES):
            scored[name] = result
            progress(f"{name} scored", 0.4 + 0.4 * len(scored) / len(ENTRIES))
    errors = {name: result[0] for name, result in scored.items()}
    progress("exploration and examples", 0.9)
    sections = (
        simulators.simulators(official, kept["horizon"]),
        simulators.by_horizon(kept["horizon"]),
        simulators.architectures(kept["networks"]),
        simulators.boundary(kept["networks"]),
        simulators.exploration(official),
        controllers.best_gains(grid),
        controllers.beyond_the_grid(rigs_of(official)),
        controllers.example(official, grid, scored["residual"][1]),
        controllers.performance(grid, errors["residual"], on_rigs(LEADERBOARD)),
        controllers.robustness(grid, errors["residual"], errors["residual, all lungs"]),
        controllers.regularisation(kept["controllers"]),
        controllers.reinforcement(errors),
        controllers.sample_efficiency(kept["samples"]),
        controllers.stability(kept["samples"]),
    )
    about = {"ventbench": ventbench.__version__, "simulators": official.manifest_sha256[:12]}
    return Reproduction(about, sections), kept


def on_rigs(leaderboard: Path) -> tuple[str, Floats, Floats] | None:
    """Errors of the best PIDs and of the residual network on the rigs of the newest round.

    Returns:
        Its name, and errors of the ranked draws without the first step of an inspiration, cmH2O,
        shape ``(L, P)``; None without one.
    """
    kept = store.load(leaderboard)
    scored = {entry.key: entry for entry in kept.scores}
    name, track = ENTRIES["residual"]
    for held in kept.rounds:
        entry = scored.get((held.name, track, name))
        if entry is not None:
            replayed = replay.derived_of(
                entry, leaderboard / RECORDS, frozen.load(), held, {}, cached=True
            )
            ranked = np.flatnonzero(replayed.ranked) + 1
            pid, error = replayed.pid[ranked], replayed.controllable[ranked]
            return held.name, pid.mean(axis=0), error.mean(axis=0)
    return None


def load_stored(path: Path | None = None) -> dict[str, Any]:
    """Read stored results.

    Raises:
        InputError: if they are missing or not JSON.
    """
    path = path or STORED
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error


def _scored(name: str, track: str) -> tuple[Floats, Floats]:
    """Errors and pressures of a bundled entry without noise, by lung and PIP."""
    result = score(name, track=track, sandbox=False)
    return result.nominal, result.trajectories.pressure
