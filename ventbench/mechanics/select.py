"""Which effects a recording needs: forward, each gated on breaths that did not choose it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.mechanics.regression import (
    Solution,
    Table,
    covariance,
    effect,
    log_likelihood,
    solve,
)
from ventbench.mechanics.terms import BASE, POSITIVE, TERMS, columns_of

Floats = NDArray[np.float64]

#: Logarithm of the ratio of likelihoods on held-out breaths: one false term in a hundred.
GATE = 4.6

#: Share of held-out breaths that must gain; least effect, cmH2O and as a share of the noise.
_AGREE, _LEAST, _SHARE = 0.6, 0.03, 0.1

#: Share of the best term's gain by which another one may fall short and still be an alternative;
#: standard deviation of C, as a share, beyond which a term has taken its place.
_NEAR, _UNSURE = 0.1, 0.1

#: Fewest breaths that can be split, and most terms.
FEWEST, MOST = 4, 5


@dataclass(frozen=True)
class Chosen:
    """A term of the model.

    Attributes:
        name: of the effect.
        column: that stands for it.
        nats: held-out evidence.
        alternatives: names that would have done nearly as well in its stead.
    """

    name: str
    column: int
    nats: float
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class _Trial:
    name: str
    column: int
    nats: float
    gain: float
    passes: bool


def select(table: Table) -> tuple[Chosen, ...]:
    """Terms that are needed beyond R and C, in the order in which they were found."""
    chosen: list[Chosen] = []
    idle: set[str] = set()
    while len(table) >= FEWEST and len(chosen) < MOST:
        columns = _columns(chosen)
        taken = {item.name for item in chosen} | idle
        trials = [_trial(table, columns, name) for name in TERMS if name not in taken]
        passing = [trial for trial in trials if trial.passes]
        if not passing:
            break
        most = max(trial.gain for trial in passing)
        near = [t for t in passing if t.gain >= most - max(GATE, _NEAR * most)]
        best = near[0]  # the more usual ones come first
        chosen.append(Chosen(best.name, best.column, best.nats, tuple(t.name for t in near[1:])))
        # What an earlier term stood in for may have found its own name.
        for item in chosen[:-1]:
            others = [other for other in chosen if other is not item]
            if not _trial(table, _columns(others), item.name).passes:
                chosen = others
                idle.add(item.name)
    return tuple(chosen)


def _columns(chosen: list[Chosen]) -> tuple[int, ...]:
    return (*range(len(BASE)), *(item.column for item in chosen))


def _trial(table: Table, columns: tuple[int, ...], name: str) -> _Trial:
    """One more term: its best column on all breaths, and what held-out breaths say of it."""
    every = np.ones(len(table), bool)
    column = _best_column(table, every, columns, name)
    whole = solve(table, every, (*columns, column))
    ratios, gains = [], []
    for train in splits(len(table)):
        own = _best_column(table, train, columns, name)
        richer = solve(table, train, (*columns, own))
        # The null hypothesis may be fitted to the very breaths that judge: a ratio above 1 / alpha
        # then has a probability below alpha, whatever the model (split likelihood ratio).
        null = solve(table, ~train, columns)
        ratio = log_likelihood(table, richer) - log_likelihood(table, null)
        ratios.append(float(ratio[~train].sum()) if _allowed(name, richer) else -np.inf)
        known = log_likelihood(table, richer) - log_likelihood(table, solve(table, train, columns))
        gains.append(np.where(train, np.nan, known))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    by_breath = np.nanmean(gains, axis=0)
    size = effect(table, whole, column)
    passes = (
        nats > GATE
        and float(np.mean(by_breath > 0)) >= _AGREE
        and size > max(_LEAST, _SHARE * whole.sigma)
        and _allowed(name, whole)
        and _plausible(table, whole)
    )
    return _Trial(name, column, nats, float(by_breath.sum()), passes)


def _plausible(table: Table, found: Solution) -> bool:
    """Whether R and C can still be told apart from the rest, and are not negative."""
    sd = np.sqrt(np.diag(covariance(table, found))[: len(BASE)])
    resistance, elastance = found.x[: len(BASE)]
    return resistance > -2.0 * sd[0] and elastance > 0.0 and sd[1] < _UNSURE * elastance


def _best_column(
    table: Table, which: NDArray[np.bool_], columns: tuple[int, ...], name: str
) -> int:
    """The column of a term that fits some breaths best."""
    options = columns_of(name)
    if len(options) == 1:
        return options[0]

    def value(column: int) -> float:
        found = solve(table, which, (*columns, column))
        if not _allowed(name, found):
            return -np.inf
        return float(log_likelihood(table, found)[which].sum())

    return max(options, key=value)


def _allowed(name: str, found: Solution) -> bool:
    return name not in POSITIVE or found.x[-1] > 0.0


def splits(count: int) -> list[NDArray[np.bool_]]:
    """Training breaths, bool ``(count,)``: every other one, and one half; each way round."""
    index = np.arange(count)
    first = [index % 2 == 0, index < count // 2]
    return [train for half in first for train in (half, ~half)]
