"""Searches from several starts, where one may end in the wrong minimum."""

from __future__ import annotations

from collections.abc import Sequence, Set
from itertools import product

import numpy as np

from ventbench.system_id.data import Floats
from ventbench.system_id.least_squares import Minimum, minimise
from ventbench.system_id.problem import Problem
from ventbench.system_id.unknowns import described

#: Steps of a search before others are tried, rounds of trying, and nats by which another start must
#: be better.
_FEW, _ROUNDS, _BETTER = 8, 3, 1.0


def descend(problem: Problem, x: Floats, iterations: int) -> Minimum:
    """Search from one start."""
    low, high = problem.unknowns.bounds()
    return minimise(problem.cost, problem.normal, x, low, high, iterations=iterations)


def search(problem: Problem, x: Floats, given: Set[str], iterations: int) -> Minimum:
    """Search from ``x``, then try other values of what is to be scanned, with all else as found.

    Where one is better, for all breaths or for a breath of what is its own, the search goes on from
    it.

    Args:
        problem: to be solved.
        x: start, ``(U,)``.
        given: paths whose start was chosen by the caller: they are not scanned.
        iterations: most steps of each search.
    """
    scanned = {p: described(p) for p in problem.unknowns.paths if described(p).scan}
    scanned = {p: item for p, item in scanned.items() if p not in given}
    shared = [p for p, item in scanned.items() if item.scope == "shared"]
    own = [p for p, item in scanned.items() if item.scope == "breath"]
    found = descend(problem, x, _FEW if scanned else iterations)
    for _ in range(_ROUNDS if scanned else 0):
        better = _other_values(problem, found, shared)
        better = _other_breaths(problem, found.x if better is None else better, own, better)
        if better is None:
            break
        found = descend(problem, better, iterations)
    return found if found.converged else descend(problem, found.x, iterations)


def _other_values(problem: Problem, found: Minimum, paths: Sequence[str]) -> Floats | None:
    """A point with another value of one shared parameter and lower cost, or None."""
    best, reached = None, found.cost - _BETTER
    for path in paths:
        for value in described(path).scan:
            trial = found.x.copy()
            trial[problem.unknowns.of(path)] = described(path).coordinate(value)
            cost = problem.cost(trial)
            if cost < reached:
                best, reached = trial, cost
    return best


def _other_breaths(
    problem: Problem, x: Floats, own: Sequence[str], otherwise: Floats | None
) -> Floats | None:
    """A point where some breaths fare better than at ``x``, or ``otherwise``."""
    if not own:
        return otherwise
    layout = problem.unknowns
    columns = [layout.paths.index(path) for path in own]
    best, reached = x.copy(), problem.log_likelihood(x) + _BETTER
    known = reached.copy()
    for values in product(*(described(path).scan for path in own)):
        trial = x.copy()
        for path, value in zip(own, values, strict=True):
            trial[layout.of(path)] = described(path).coordinate(value)
        likelihood = problem.log_likelihood(trial)
        won = np.flatnonzero(likelihood > reached)
        reached[won] = likelihood[won]
        for column in columns:
            index = layout.index[won, column]
            best[index] = trial[index]
    return best if np.any(reached > known) else otherwise
