"""The best PIDs over the rigs of each lung, for protocol version 2.

Every PID of a grid runs on every rig of the lung without noise; the best of them run on draws,
whose noise a high gain amplifies, and the least mean error wins. On all scored rigs and the
development draws this gives the 100 of normalised scores; on the rigs and draws that are for
tuning, the gains of the entries ``pid_best`` and ``pid_robust``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import precision, protocol, rig_draws, rollouts
from ventbench.controllers.pid import PID
from ventbench.environment import Scenario
from ventbench.executor import InProcess, executor, in_order
from ventbench.interfaces import Plant
from ventbench.metrics.score import controllable_error
from ventbench.plants.catalog import Given
from ventbench.rig_draws import RigDraws
from ventbench.submissions.rig_scoring import Rigs, load_rigs
from ventbench.training import pid_grid
from ventbench.training.rig_plants import plants_to_train_on

#: How many PIDs of each lung run on the draws.
FINALISTS = 100

#: Finalists that are run together: bounds memory.
BATCH = 20

#: Draws that gains are tuned on; none of them is ever scored.
TUNING = "tuning"
TUNING_SEED = hashlib.sha256(b"ventbench, draws for tuning").digest()

Floats = NDArray[np.float64]

#: Called with the number of lungs done, and of all.
Progress = Callable[[int, int], None]


@jax.jit
def _pressures(plant: Plant, gains: Array, cells: Scenario) -> Array:
    def run(gains: Array) -> Array:
        return rollouts.closed_loop(plant, PID(*gains), cells, airway=True)[0].pressure

    return jax.vmap(run)(gains)


def nominal_errors(
    rigs: Rigs, gains: Floats, progress: Progress | None = None, pool: Executor | None = None
) -> Floats:
    """Mean error of each PID without noise over the scored rigs of each lung, member 0.

    Args:
        rigs: L lungs.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``.
        progress: see :data:`Progress`.
        pool: computes the lungs side by side; this process if not given.

    Returns:
        Of the airway pressure, cmH2O, shape ``(L, G, P)``.
    """
    jobs = [(_nominal_plants(rigs, lung), gains) for lung in range(len(rigs.lungs))]
    return np.stack(in_order(pool or InProcess(), _nominal_errors, jobs, progress))


def _nominal_plants(rigs: Rigs, lung: int) -> Plant:
    """Plants of a lung's scored rigs, member 0."""
    at = slice(lung, lung + 1) if rigs.sessions is None else (0, list(rigs.sessions[lung]))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[at], rigs.plants)


def _nominal_errors(plants: Plant, gains: Floats) -> Floats:
    return pid_grid.errors(plants, gains, airway=True).mean(axis=0, dtype=np.float64)


def drawn_errors(rigs: Rigs, drawn: RigDraws, lung: int, gains: Floats) -> Floats:
    """Error of PIDs on draws of one lung, without the first step.

    Args:
        rigs: that the draws are of.
        drawn: K draws.
        lung: index of the lung.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``.

    Returns:
        Mean over the draws, cmH2O, shape ``(G, P)``.
    """
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    own = jax.tree.map(lambda x: np.asarray(x)[lung], plants)
    if rigs.sessions is not None:  # without the nominal cells
        own = jax.tree.map(lambda x: x[1:], own)
    cell = jax.tree.map(lambda x: np.asarray(x)[lung, 1:], cells)
    errors = []
    for first in range(0, len(gains), BATCH):
        # The last batch is padded, so that all compile once.
        index = np.minimum(np.arange(first, first + BATCH), len(gains) - 1)
        with precision.float64():
            arrays = jax.tree.map(jnp.asarray, (own, gains[index], cell))
            pressure = np.asarray(_pressures(*arrays))
        error = controllable_error(pressure, cell.pip[..., None, None]).mean(axis=1)
        errors.append(error[: len(gains) - first])
    return np.concatenate(errors)


def best_pids(
    rigs: Rigs,
    *,
    gains: Floats | None = None,
    draws: int = 20,
    progress: Progress | None = None,
) -> tuple[Floats, Floats]:
    """Find the best PID of each lung.

    Args:
        rigs: L lungs, all of whose scored rigs count alike.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``; the paper's 8,000 if not given.
        draws: number of development draws that decide among the best.
        progress: called with the number of lungs done, and of all.

    Returns:
        Gains, shape ``(L, 3)``, and their mean errors over the draws without the first step, cmH2O,
        shape ``(L,)``.
    """
    grid = pid_grid.paper_gains() if gains is None else np.asarray(gains, float)
    drawn = rigs.draws(draws)
    nominal = nominal_errors(rigs, grid, progress).mean(axis=-1)
    chosen, least = [], []
    for lung, error in enumerate(nominal):
        finalists = grid[np.argsort(error, kind="stable")[:FINALISTS]]
        on_draws = drawn_errors(rigs, drawn, lung, finalists).mean(axis=-1)
        chosen.append(finalists[np.argmin(on_draws)])
        least.append(on_draws.min())
    return np.array(chosen), np.array(least)


@dataclass(frozen=True, eq=False)
class TunedPIDs:
    """The best PIDs of a grid over rigs.

    Attributes:
        lungs: ids, L of them.
        gains: P, I, D of each lung's best, %/cmH2O, shape ``(L, 3)``.
        errors: on the draws for tuning without the first step, cmH2O, shape ``(L,)``.
        single: gains of the best one for all lungs, shape ``(3,)``.
        single_errors: its errors, cmH2O, shape ``(L,)``.
        nominal: of the whole grid without noise, float32.
        about: version and hashes of the simulators.
    """

    lungs: tuple[str, ...]
    gains: Floats
    errors: Floats
    single: Floats
    single_errors: Floats
    nominal: pid_grid.PIDGrid
    about: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Content of ``best.json``: keys of :meth:`PIDGrid.summary`, and the protocol."""
        each = zip(self.lungs, self.gains.tolist(), self.errors.tolist(), strict=True)
        return {
            "protocol": 2,
            "trajectories": int(self.nominal.error.size),
            "pips": list(self.nominal.pips),
            "lungs": {lung: {"gains": own, "error": error} for lung, own, error in each},
            "single": {
                "gains": self.single.tolist(),
                "error": float(self.single_errors.mean()),
                "lungs": dict(zip(self.lungs, self.single_errors.tolist(), strict=True)),
            },
            "simulators": self.about,
        }


def tune_on_rigs(
    simulator: Given = "frozen",
    *,
    gains: Floats | None = None,
    draws: int = rig_draws.COUNT,
    progress: Progress | None = None,
    workers: int = 0,
    scheduler: str | None = None,
) -> TunedPIDs:
    """Find the best PIDs for protocol version 2, of each lung and of all.

    Neither the development draws nor the rigs that are held out have a part in the choice. What
    decides is the error weighted as in the normalised score: by the inverse of what there is to
    gain at a PIP of a lung.

    Args:
        simulator: see :func:`ventbench.submissions.rig_scoring.load_rigs`.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``; the paper's 8,000 if not given.
        draws: number of draws for tuning that decide among the best.
        progress: see :data:`Progress`.
        workers: processes, a lung each; 0 for this one alone, which uses all cores.
        scheduler: address of a Dask scheduler instead.
    """
    grid = pid_grid.paper_gains() if gains is None else np.asarray(gains, float)
    scored = load_rigs(simulator)
    rigs, seed = scored, TUNING_SEED
    sessions = tuple((0,) for _ in rigs.lungs)
    if scored.sessions is not None:
        pairs = zip(scored.sessions, scored.held_out, strict=True)
        sessions = tuple(tuple(rig for rig in own if rig != apart) for own, apart in pairs)
        rigs = replace(scored, sessions=sessions)
    drawn = rig_draws.build(sessions, rigs.members, seed=seed, season=TUNING, n=draws)
    weights = plants_to_train_on(simulator, version=2).weights
    with executor(workers, scheduler) as pool:
        nominal = nominal_errors(rigs, grid, progress, pool)
        weighted = np.einsum("lgp,lp->lg", nominal, weights)
        single = np.argsort(weighted.sum(axis=0), kind="stable")[:FINALISTS]
        finalists = np.argsort(weighted, axis=1, kind="stable")[:, :FINALISTS]
        jobs = [
            (rigs, drawn, lung, grid[np.concatenate([own, single])])
            for lung, own in enumerate(finalists)
        ]
        every = in_order(pool, drawn_errors, jobs)
    chosen, least, together = [], [], []
    for lung, (own, on_draws) in enumerate(zip(finalists, every, strict=True)):
        best = int(np.argmin(on_draws[: len(own)] @ weights[lung]))
        chosen.append(grid[own[best]])
        least.append(on_draws[best].mean())
        together.append(on_draws[len(own) :])
    on_all = np.einsum("lgp,lp->g", np.stack(together), weights)
    winner = int(np.argmin(on_all))
    names = tuple(lung.id for lung in rigs.lungs)
    table = pid_grid.PIDGrid(names, protocol.PIPS, grid, nominal.astype(np.float32))
    return TunedPIDs(
        names,
        np.array(chosen),
        np.array(least),
        grid[single[winner]],
        np.stack(together)[:, winner].mean(axis=-1),
        table,
        dict(rigs.about),
    )
