"""The best PID of each lung over its rigs, for protocol version 2: the 100 of normalised scores.

Every PID of the paper's grid runs on every scored rig of the lung without noise; the best of them
run on the development draws, whose noise a high gain amplifies, and the least mean error wins.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import precision, protocol, rollouts
from ventbench.controllers.pid import PID
from ventbench.environment import Scenario
from ventbench.interfaces import Plant
from ventbench.metrics.normalised import controllable_error
from ventbench.submissions.rig_scoring import Rigs
from ventbench.training import pid_grid

#: How many PIDs of each lung run on the draws.
FINALISTS = 100

#: Finalists that are run together: bounds memory.
BATCH = 20

Floats = NDArray[np.float64]


@jax.jit
def _pressures(plant: Plant, gains: Array, cells: Scenario) -> Array:
    def run(gains: Array) -> Array:
        return rollouts.closed_loop(plant, PID(*gains), cells, airway=True)[0].pressure

    return jax.vmap(run)(gains)


def best_pids(
    rigs: Rigs,
    *,
    gains: Floats | None = None,
    draws: int = 20,
    progress: Callable[[int, int], None] | None = None,
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
    plants, cells = rigs.cells(rigs.draws(draws), protocol.PIPS)
    # Without the nominal cells.
    noisy = jax.tree.map(lambda x: np.asarray(x)[:, 1:], cells)
    chosen, least = [], []
    for lung in range(len(rigs.lungs)):
        if rigs.sessions is None:
            own = jax.tree.map(lambda x, i=lung: np.asarray(x)[i : i + 1], rigs.plants)
            drawn = jax.tree.map(lambda x, i=lung: np.asarray(x)[i], plants)
        else:
            sessions = list(rigs.sessions[lung])
            own = jax.tree.map(lambda x, s=sessions: np.asarray(x)[0, s], rigs.plants)
            drawn = jax.tree.map(lambda x, i=lung: np.asarray(x)[i, 1:], plants)
        nominal = pid_grid.errors(own, grid, airway=True).mean(axis=(0, 2), dtype=np.float64)
        finalists = grid[np.argsort(nominal, kind="stable")[:FINALISTS]]
        cell = jax.tree.map(lambda x, i=lung: x[i], noisy)
        errors = []
        for first in range(0, len(finalists), BATCH):
            # The last batch is padded, so that all compile once.
            index = np.minimum(np.arange(first, first + BATCH), len(finalists) - 1)
            with precision.float64():
                arrays = jax.tree.map(jnp.asarray, (drawn, finalists[index], cell))
                pressure = np.asarray(_pressures(*arrays))
            error = controllable_error(pressure, cell.pip[..., None, None]).mean(axis=(1, 2))
            errors.append(error[: len(finalists) - first])
        joined = np.concatenate(errors)
        chosen.append(finalists[np.argmin(joined)])
        least.append(joined.min())
        if progress is not None:
            progress(lung + 1, len(rigs.lungs))
    return np.array(chosen), np.array(least)
