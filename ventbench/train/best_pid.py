"""The best PID of each lung without a grid's edge: the 100 of normalised scores.

Gains are searched for in their logarithms, which have no upper edge, by Nelder and Mead's simplex
on the mean error over draws: their noise and gains are fixed, so that the error is a function of
the gains alone. The search begins at the best points of a coarse grid that reaches far beyond the
paper's, each a simplex of its own. The optimum is taken for one if the searches end at one error
and no gain lies at the grid's edge.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ventbench.base.arrays import Bools, Floats
from ventbench.plants.catalog import Given
from ventbench.plants.rigs import Rigs, load_rigs
from ventbench.task import draws as draw_tables
from ventbench.task.draws import Draws
from ventbench.train.pid_grid import TUNING, TUNING_SEED, drawn_errors
from ventbench.train.plants import check_names, plants_to_train_on

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
    """Best PIDs of L lungs, and of all together as one more where that was asked; S searches."""

    gains: Floats  #: P, I, D, %/cmH2O, shape ``(L, 3)``.
    #: weighted mean over draws and PIPs without the first step, cmH2O, shape ``(L,)``.
    error: Floats
    search_gains: Floats  #: where each search ended, shape ``(L, S, 3)``.
    search_errors: Floats  #: their errors, shape ``(L, S)``.

    @property
    def agree(self) -> Bools:
        """Whether at least two searches of a lung ended at one error, shape ``(L,)``."""
        ordered = np.sort(self.search_errors, axis=1)
        return ordered[:, 1] - ordered[:, 0] < AGREEMENT


def best_pids(
    rigs: Rigs,
    *,
    drawn: Draws | None = None,
    groups: Sequence[Sequence[int]] | None = None,
    weights: Floats | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BestPIDs:
    """Find the best PID of each lung on the rigs of the training.

    Args:
        rigs: lungs; what they hold out has no part.
        drawn: draws on the rigs of the training; the development draws if not given.
        groups: lungs that share a PID; each has its own if not given.
        weights: of the PIPs of each lung; equal if not given.
        progress: called with the number of groups done, and of all.
    """
    rigs = rigs.of_training
    drawn = rigs.draws(draw_tables.COUNT) if drawn is None else drawn
    groups = [[lung] for lung in range(len(rigs.lungs))] if groups is None else groups
    weight = np.ones(np.shape(drawn.cells.pip)[::2]) if weights is None else weights
    report = progress or (lambda done, total: None)

    def errors(group: Sequence[int], drawn: Draws, gains: Floats, **options: int) -> Floats:
        each = [drawn_errors(rigs, drawn, at, gains, **options) * weight[at] for at in group]
        return np.mean(each, axis=(0, 2))

    few, ends = drawn.first(min(4, drawn.count)), []
    for done, group in enumerate(groups):
        report(done, len(groups))
        starts = _starts(partial(errors, group, few))
        ends.append([_search(partial(errors, group, drawn, together=1), x) for x in starts])
    report(len(groups), len(groups))
    found = np.array([[gains for gains, _ in own] for own in ends])
    error = np.array([[error for _, error in own] for own in ends])
    at = (np.arange(len(groups)), np.argmin(error, axis=1))
    return BestPIDs(found[at], error[at], found, error)


def tune_beyond(
    lungs: Sequence[str] | None = None,
    *,
    draws: int = draw_tables.COUNT,
    each: bool = True,
    single: bool = True,
    simulator: Given = "frozen",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Tune PIDs as :func:`~ventbench.train.pid_grid.tune_pid` does, but without a grid's edge.

    Args:
        lungs: ids; all lungs of the simulators if not given.
        draws: number of draws for tuning, at least 1.
        each: find the best gains of each lung.
        single: find the best gains for all of them together.
        simulator: see :func:`ventbench.load_simulators`.
        progress: called with the number of PIDs found, and of all.

    Returns:
        The content of ``best.json``; errors are weighted.

    Raises:
        InputError: if a lung or a simulator is unknown, or there are no draws.
    """
    trained_on = plants_to_train_on(simulator)
    names = check_names(lungs, trained_on, all_lungs=False)
    rigs = load_rigs(simulator).of_training
    where = [trained_on.names.index(name) for name in names]
    found = best_pids(
        rigs,
        drawn=rigs.draws(draws, seed=TUNING_SEED, name=TUNING),
        groups=[[at] for at in where] * each + [where] * single,
        weights=trained_on.weights,
        progress=progress,
    )
    pairs = zip(found.gains.tolist(), found.error.tolist(), strict=True)
    entries = [{"gains": gains, "error": error} for gains, error in pairs]
    result: dict[str, Any] = {"draws": draws, "simulators": dict(trained_on.about)}
    if each:
        result["lungs"] = dict(zip(names, entries, strict=False))
    return result | ({"single": entries[-1]} if single else {})


def _starts(errors: Callable[[Floats], Floats]) -> list[Floats]:
    """Best points of the coarse grid, no two of them neighbours."""
    grid = np.array(list(itertools.product(P_I, P_I, D)))
    chosen: list[Floats] = []
    for gains in grid[np.argsort(errors(grid), kind="stable")]:
        if all(np.count_nonzero(gains != other) > 1 for other in chosen):
            chosen.append(gains)
    return chosen[:SEARCHES]


def _search(errors: Callable[[Floats], Floats], start: Floats) -> tuple[Floats, float]:
    """Gains where a search ends, and their error."""

    def error(logarithms: Floats) -> float:
        return float(errors(np.exp(logarithms)[None])[0])

    first = np.log(start)
    simplex = np.vstack([first, first + np.log(FACTOR) * np.eye(3)])
    options = {
        "initial_simplex": simplex,
        "maxfev": EVALUATIONS,
        "xatol": TOLERANCE,
        "fatol": ERROR_TOLERANCE,
    }
    found = minimize(error, first, method="Nelder-Mead", options=options).x
    gains = np.array([float(f"{gain:.{DIGITS - 1}e}") for gain in np.exp(found)])
    return gains, error(np.log(gains))
