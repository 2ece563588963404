"""What a controller must miss because it has to learn the rig: a second bound, by lung.

The attainable bound knows the plant from the first step. Here a breath is planned over several
plants that look alike until step k, when a referee reveals which one it is: the first k commands
are the same for all, those after it each plant's own, and the mean error is the least that this
allows. The search is that of :mod:`ventbench.task.attainable`, a linear program a step, with the
commands of all plants in one program.

Two questions, on reference rigs and without noise:

- *gain*: the lung is known, as it can be from breath 1, which is not scored; the gain of the valve
  in this breath is not. Plants: five quantiles of the gain's scatter from breath to breath.
- *lung*: nothing is known, as in breath 1. Plants: the six lungs.

Usage:

    python benchmarks/learning_bound.py
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.entries.reference import published
from ventbench.plants.rigs import load_rigs
from ventbench.task import attainable, protocol
from ventbench.task.attainable import COMMANDS
from ventbench.task.draws import GAIN_QUANTILES
from ventbench.task.metrics.score import normalised

#: Shares of the gain's distribution that stand for it.
QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)

#: PIPs, cmH2O, and numbers of shared steps, in rising order.
PIPS, STEPS = (15.0, 30.0), (0, 1, 2, 3, 5)

#: Most linear programs of a start, the first trust region, %, and that at which a start ends.
ITERATIONS, FIRST, LAST = 30, 20.0, 0.02


def change(miss: Floats, slopes: Floats, u_in: Floats, shared: int, radius: float) -> Floats:
    """Best change of the commands of m plants within a trust region, %, shape ``(m, COMMANDS)``.

    Args:
        miss: PIP minus pressures, cmH2O, shape ``(m, COMMANDS)``.
        slopes: derivatives of pressures by commands, shape ``(m, COMMANDS, COMMANDS)``.
        u_in: %, shape ``(m, COMMANDS)``; the first ``shared`` are the same for all plants.
        shared: number of them.
        radius: most that a command may change by, %.
    """
    m, own = len(miss), COMMANDS - shared
    errors = m * COMMANDS
    first = np.concatenate(slopes[:, :, :shared])
    rest = sparse.block_diag(slopes[:, :, shared:])
    equal = sparse.hstack([first, rest, sparse.eye(errors), -sparse.eye(errors)], format="csc")
    now = np.concatenate([u_in[0, :shared], u_in[:, shared:].ravel()])
    low, high = np.maximum(-radius, -now), np.minimum(radius, protocol.U_MAX - now)
    bounds = np.vstack([np.column_stack([low, high]), np.tile([0.0, np.inf], (2 * errors, 1))])
    cost = np.concatenate([np.zeros(len(now)), np.ones(2 * errors)])
    solved = linprog(cost, A_eq=equal, b_eq=miss.ravel(), bounds=bounds, method="highs-ds")
    if solved.status != 0:
        return np.zeros_like(u_in)
    moved = solved.x[: len(now)]
    return np.hstack([np.tile(moved[:shared], (m, 1)), moved[shared:].reshape(m, own)])


def planned(plants: Any, cells: Any, start: Floats, shared: int) -> tuple[Floats, Floats]:
    """Least mean error over plants whose first commands are shared.

    Args:
        plants: m of them, on the leading axis of each leaf.
        cells: batch shape ``(m,)``.
        start: commands, %, shape ``(m, COMMANDS)``.
        shared: number of commands that are the same.

    Returns:
        Errors of the plants, cmH2O, shape ``(m,)``, and commands, %.
    """
    u_in = start.copy()
    u_in[:, :shared] = u_in[:, :shared].mean(axis=0)
    pip, radius = np.asarray(cells.pip)[:, None], FIRST
    miss = pip - attainable.pressures(plants, cells, u_in)
    slopes = None
    for _ in range(ITERATIONS):
        if slopes is None:
            slopes = np.asarray(attainable.all_slopes(plants, cells, u_in))
        fresh = np.clip(u_in + change(miss, slopes, u_in, shared, radius), 0.0, protocol.U_MAX)
        missed = pip - attainable.pressures(plants, cells, fresh)
        if np.abs(missed).mean() < np.abs(miss).mean() - 1e-9:
            u_in, miss, slopes = fresh, missed, None
        else:
            radius *= 0.3
        if radius < LAST:
            break
    return np.abs(miss).mean(axis=1), u_in


def bound(plants: Any, cells: Any, start: Floats) -> list[Floats]:
    """Errors of the plants for each of :data:`STEPS`, cmH2O."""
    found, before = [], start
    for shared in STEPS:
        tries = [planned(plants, cells, begun, shared) for begun in (start, before)]
        errors, before = min(tries, key=lambda x: x[0].mean())
        found.append(errors)
    return found


def main() -> None:
    """What a controller must miss because it has to learn the rig: a second bound, by lung."""
    compilation.keep()
    rigs, reference = load_rigs(), published()
    names = [lung.id for lung in rigs.lungs]
    columns = [protocol.PIPS.index(pip) for pip in PIPS]
    scatter = np.exp(np.interp(QUANTILES, np.linspace(0, 1, len(GAIN_QUANTILES)), GAIN_QUANTILES))
    points: dict[str, list[Floats]] = {"gain": [], "lung": []}
    with compilation.float64():
        plants, cells = rigs.cells(None, protocol.PIPS)
        plants = jax.tree.map(lambda leaf: np.asarray(leaf, float)[:, 0, 0], plants)
        cells = cells.replace(noise=np.zeros((*np.shape(cells.pip), 1, 1)))  # type: ignore[attr-defined]

        def some(lungs: list[int], column: int, gains: Floats) -> tuple[Any, Any, Floats]:
            own = jax.tree.map(lambda leaf: leaf[lungs], plants)
            cell = jax.tree.map(lambda leaf: np.asarray(leaf)[lungs, 0, column], cells)
            cell = cell.replace(gain=np.tile(gains[:, None], (1, protocol.BREATHS)))
            return own, cell, reference.commands[lungs, 0, column, 0]

        def scored(lungs: list[int], column: int, errors: list[Floats]) -> Floats:
            best, pid = (x[lungs, 0, column] for x in (reference.attainable, reference.pid))
            return np.array([normalised(error, best, pid) for error in errors])

        for column in columns:
            for lung in range(len(names)):
                chosen = [lung] * len(scatter)
                errors = bound(*some(chosen, column, scatter))
                points["gain"].append(scored(chosen, column, errors).mean(axis=1))
            every = list(range(len(names)))
            errors = bound(*some(every, column, np.ones(len(names))))
            points["lung"] += list(scored(every, column, errors).T)
    print("points of the normalised score above the attainable error of a known plant, by lung")
    print(f"reference rigs, PIP {PIPS} cmH2O, revealed after {STEPS} steps")
    for question, rows in points.items():
        values = np.array(rows).reshape(len(columns), len(names), len(STEPS)).mean(axis=0)
        values -= values[:, :1]
        for name, row in [*zip(names, values, strict=True), ("mean", values.mean(axis=0))]:
            print(f"{question} {name:7}" + "".join(f"{value:8.1f}" for value in row))


if __name__ == "__main__":
    main()
