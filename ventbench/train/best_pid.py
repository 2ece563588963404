"""The best PID of each lung without a grid's edge: the 100 of normalised scores.

Gains are searched for in their logarithms, which have no upper edge, by Nelder and Mead's simplex
on the mean error over draws: their noise and gains are fixed, so that the error is a function of
the gains alone. The search begins at the best points of a coarse grid that reaches far beyond the
paper's, each a simplex of its own. The optimum is taken for one if the searches end at one error
and no gain lies at the grid's edge.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from ventbench.base.arrays import Bools, Floats
from ventbench.plants.rigs import Rigs
from ventbench.task import draws as draw_tables
from ventbench.task.draws import Draws
from ventbench.train.pid_grid import drawn_errors

#: Where searches may begin, %/cmH2O: P and I, and D.
P_I, D = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0), (0.1, 1.0, 10.0, 100.0)

#: Number of searches of each lung, their evaluations at most, and the first simplex, as a factor.
SEARCHES, EVALUATIONS, FACTOR = 3, 120, 1.5

#: Searches end when no vertex differs by more in a logarithm of a gain, or in error, cmH2O.
TOLERANCE, ERROR_TOLERANCE = 0.01, 1e-4

#: Significant digits of the result.
DIGITS = 3

#: Searches agree if their errors differ by less, cmH2O.
AGREEMENT = 0.02


@dataclass(frozen=True, eq=False)
class BestPIDs:
    """Best PIDs of L lungs; S searches of each.

    Attributes:
        gains: P, I, D, %/cmH2O, shape ``(L, 3)``.
        error: mean over draws and PIPs without the first step, cmH2O, shape ``(L,)``.
        search_gains: where each search ended, shape ``(L, S, 3)``.
        search_errors: their errors, shape ``(L, S)``.
    """

    gains: Floats
    error: Floats
    search_gains: Floats
    search_errors: Floats

    @property
    def agree(self) -> Bools:
        """Whether at least two searches of a lung ended at one error, shape ``(L,)``."""
        ordered = np.sort(self.search_errors, axis=1)
        return ordered[:, 1] - ordered[:, 0] < AGREEMENT


def best_pids(
    rigs: Rigs,
    *,
    draws: int = draw_tables.COUNT,
    searches: int = SEARCHES,
    evaluations: int = EVALUATIONS,
    progress: Callable[[int, int], None] | None = None,
) -> BestPIDs:
    """Find the best PID of each lung on the rigs of the training and the development draws.

    Args:
        rigs: L lungs; what they hold out has no part.
        draws: number of development draws.
        searches: of each lung.
        evaluations: of each search at most.
        progress: called with the number of lungs done, and of all.
    """
    rigs = rigs.of_training
    drawn = rigs.draws(draws)
    report = progress or (lambda done, total: None)
    ends, errors = [], []
    for lung in range(len(rigs.lungs)):
        report(lung, len(rigs.lungs))
        own = [_search(rigs, drawn, lung, start, evaluations) for start in _starts(
            rigs, drawn, lung, searches
        )]  # fmt: skip
        ends.append([gains for gains, _ in own])
        errors.append([error for _, error in own])
    report(len(rigs.lungs), len(rigs.lungs))
    found, least = np.array(ends), np.array(errors)
    best = np.argmin(least, axis=1)
    lungs = np.arange(len(best))
    return BestPIDs(found[lungs, best], least[lungs, best], found, least)


def _starts(rigs: Rigs, drawn: Draws, lung: int, count: int) -> list[Floats]:
    """Best points of the coarse grid, on the first draws, no two of them neighbours."""
    grid = np.array(list(itertools.product(P_I, P_I, D)))
    error = drawn_errors(rigs, drawn.first(min(4, drawn.count)), lung, grid).mean(axis=-1)
    chosen: list[Floats] = []
    for gains in grid[np.argsort(error, kind="stable")]:
        far = [np.count_nonzero(gains != other) > 1 for other in chosen]
        if all(far):
            chosen.append(gains)
        if len(chosen) == count:
            break
    return chosen


def _search(
    rigs: Rigs, drawn: Draws, lung: int, start: Floats, evaluations: int
) -> tuple[Floats, float]:
    """Gains where a search ends, and their error."""

    def error(logarithms: Floats) -> float:
        gains = np.exp(logarithms)[None]
        return float(drawn_errors(rigs, drawn, lung, gains, together=1).mean())

    first = np.log(start)
    simplex = np.vstack([first, first + np.log(FACTOR) * np.eye(3)])
    options = {
        "initial_simplex": simplex,
        "maxfev": evaluations,
        "xatol": TOLERANCE,
        "fatol": ERROR_TOLERANCE,
    }
    found = minimize(error, first, method="Nelder-Mead", options=options).x
    gains = np.array([float(f"{gain:.{DIGITS - 1}e}") for gain in np.exp(found)])
    return gains, error(np.log(gains))
