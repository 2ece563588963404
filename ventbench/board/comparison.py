r"""Which entries are better beyond doubt, over all pairs at once.

**Paired test.** Entries ran on the same draws. The difference of two of them on a lung is a mean
over rigs; draws on one rig share it, so that the rig is what varies independently (the draw, where
a lung has one rig only). With the sums :math:`e_{lg}` of the centred differences of rig g of lung l
over the number of draws, the variance of the mean over L lungs is

.. math:: V = \sum_l V_l / L^2, \qquad V_l = \frac{G_l}{G_l - 1} \sum_g e_{lg}^2,

with Satterthwaite's degrees of freedom :math:`(\sum V_l)^2 / \sum V_l^2 / (G_l - 1)`.

**Beyond doubt.** Entry i is better than j if ``mean_j - mean_i`` exceeds the least difference that
matters by more than chance: one-sided t tests of all ordered pairs, with Holm's correction. So the
probability that any pair is called wrongly is at most :data:`ERROR`, whatever the truth is.

**Rank.** 1 + the number of entries that are better beyond doubt than it or than one with a lower
mean: no entry stands above one that has a lower mean. Beside it stand the ranks that it may have;
they hold for all entries together. An entry that follows another's commands counts as one with it,
and never against it; see :func:`sources`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.interval import Interval
from ventbench.task.metrics.score import LEAST_HEADROOM

#: Probability that any pair of entries is called wrongly.
ERROR = 0.05

#: Least difference that matters: points of the normalised score, and cmH2O of the stress score, as
#: of :data:`~ventbench.task.metrics.score.LEAST_HEADROOM`: what the sensor cannot tell apart. Six
#: draws are on five rigs of each lung; of equal entries with the spread of the published rigs some
#: rank is false on 0.5 % of boards or fewer, with 7 to 60 entries (``test_comparison.py``).
POINTS, CMH2O = 1.0, LEAST_HEADROOM

#: Runs of two entries follow each other if their commands, scaled to fit best, differ by this share
#: (root mean square), and one entry follows another if this share of its runs does. Independent
#: bundled entries differ by 8 to 45 % in the middle run.
DISTANCE, FOLLOWING = 0.05, 0.75

# Runs by which entries are first compared.
_FEW = 48

#: Resamples and seed of the interval over seeds of a training.
_RESAMPLES, _SEED = 400, 20210215

# Below this standard error, replays on other machines round differently.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Ranks:
    """Ranks of N entries, in the order in which they were given, each of shape ``(N,)``."""

    better: Bools  #: whether row i is better than column j beyond doubt, shape ``(N, N)``.
    rank: Ints  #: from 1; equal where entries cannot be told apart.
    best: Ints  #: best rank that each may have.
    worst: Ints  #: worst rank.


def ranks(
    values: Floats, rig: Ints, source: Sequence[int | None] | None = None, *, matters: float
) -> Ranks:
    """Rank entries; less is better.

    Args:
        values: of each lung and draw, shape ``(N, L, K)``.
        rig: of each lung and draw, shape ``(L, K)``.
        source: index of the entry that each follows; see :func:`sources`.
        matters: least difference that matters, in the unit of the values.
    """
    count, means = len(values), values.mean(axis=(1, 2))
    better = holm(p_values(values, rig, matters))
    source = [None] * count if source is None else source
    lines = [_line_of(k, source) for k in range(count)]
    root = np.array([line[-1] for line in lines], int)
    # Whoever follows an entry, directly or not, never counts against it.
    against = np.array([[j != i and i not in lines[j] for j in range(count)] for i in range(count)])
    against = against.reshape(count, count)
    best = np.array([1 + len({*root[better[:, i] & against[i]]}) for i in range(count)], int)
    worst = np.array([1 + len({*root[~better[i] & against[i]]}) for i in range(count)], int)
    order = np.argsort(means, kind="stable")
    rank = np.empty(count, int)
    rank[order] = np.maximum.accumulate(best[order]) if count else best
    return Ranks(better, np.minimum(rank, worst), best, worst)


def _line_of(k: int, source: Sequence[int | None]) -> list[int]:
    """An entry, the one that it follows, and so on."""
    line = [k]
    while (earlier := source[line[-1]]) is not None:
        line.append(earlier)
    return line


def p_values(values: Floats, rig: Ints, matters: float) -> Floats:
    """Probability of such a lead of row i over column j, did it not exceed what matters.

    Takes what :func:`ranks` does; shape ``(N, N)``, 1 on the diagonal.
    """
    count, lungs, _ = values.shape
    means = values.mean(axis=(1, 2))
    p = np.ones((count, count))
    parts = [_clusters(values[:, lung], rig[lung]) for lung in range(lungs)]
    for i in range(count):
        lead = means - means[i] - matters
        variances = np.stack(
            [
                part.shape[1] / max(part.shape[1] - 1, 1) * ((part - part[i]) ** 2).sum(axis=1)
                for part in parts
            ]
        )
        spare = np.array([max(part.shape[1] - 1, 1) for part in parts])[:, None]
        total = variances.sum(axis=0)
        freedom = total**2 / np.maximum((variances**2 / spare).sum(axis=0), 1e-300)
        error = np.maximum(np.sqrt(total) / lungs, _ROUNDING)
        p[i] = np.where(lead > 0.0, stats.t.sf(lead / error, np.maximum(freedom, 1.0)), 1.0)
    return p


def _clusters(values: Floats, rig: Ints) -> Floats:
    """Sums over the rigs of a lung of centred values over the number of draws, ``(N, G)``."""
    names, index = np.unique(rig, return_inverse=True)
    if len(names) < 2:  # nothing is known of other rigs: draws are all that varies
        index = np.arange(len(rig))
    member = index[:, None] == np.arange(index.max() + 1)
    centred = values - values.mean(axis=1, keepdims=True)
    return centred @ member / values.shape[1]


def holm(p: Floats) -> Bools:
    """Which hypotheses of all ordered pairs are rejected, shape ``(N, N)``."""
    rejected = np.zeros(p.shape, bool)
    pairs = np.flatnonzero(~np.eye(len(p), dtype=bool))
    order = pairs[np.argsort(p.ravel()[pairs], kind="stable")]
    passed = p.ravel()[order] <= ERROR / np.arange(len(order), 0, -1)
    rejected.ravel()[order[: int(np.logical_and.accumulate(passed).sum())]] = True
    return rejected


def sources(commands: Sequence[Floats]) -> list[int | None]:
    """Find entries whose commands follow those of an earlier one nearly everywhere.

    A factor does not matter: commands times 1.01 follow as copies do. Controllers that were made
    independently answer differently to the noise of the draws.

    Args:
        commands: as applied, %, of each entry, the earliest first, shapes ``(runs, steps)``.

    Returns:
        For each entry the index of the earliest one that it follows, or None.
    """
    if not commands:
        return []
    # A few runs tell most pairs apart; the others are looked at in full.
    few = np.stack([runs[:: max(1, len(runs) // _FEW)] for runs in commands])
    indices: list[int | None] = []
    for k, runs in enumerate(commands):
        likely = (
            np.mean(_relative_residual(few[k], few[:k]) <= 2.0 * DISTANCE, axis=-1)
            >= 0.5 * FOLLOWING
        )
        follows = (
            j
            for j in np.flatnonzero(likely).tolist()
            if np.mean(_relative_residual(runs, commands[j]) <= DISTANCE) >= FOLLOWING
        )
        indices.append(next(follows, None))
    return indices


def _relative_residual(commands: Floats, reference: Floats) -> Floats:
    """What is left of commands less those of a reference, times the factor that fits best.

    Root mean square over that of the run, shape ``(..., runs)``, of ``(runs, steps)`` and
    ``(..., runs, steps)``.
    """
    squares = [np.maximum((x**2).sum(axis=-1), _ROUNDING) for x in (commands, reference)]
    product = np.einsum("rs,...rs->...r", commands, reference)
    return np.sqrt(np.maximum(1.0 - product**2 / (squares[0] * squares[1]), 0.0))


def over_seeds(scores: Sequence[float]) -> Interval:
    """Interquartile mean of the scores of seeds, with its 95 % bootstrap interval over seeds."""
    resamples = np.random.default_rng(_SEED).choice(np.sort(scores), (_RESAMPLES, len(scores)))
    low, high = np.quantile(stats.trim_mean(resamples, 0.25, axis=1), (0.025, 0.975))
    return Interval(float(stats.trim_mean(scores, 0.25)), float(low), float(high))
