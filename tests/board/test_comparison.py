"""Ranks against known truth: equal entries, copies, ruined copies, one rig of large variance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ventbench.board import comparison
from ventbench.board.comparison import DISTANCE, ERROR, FOLLOWING, POINTS

#: Rigs of each lung as the frozen set has them, and draws; or a rig of its own in each draw.
SIZES, DRAWS = (3, 4, 4, 2, 2, 3), 20
FIXED = np.array([np.arange(DRAWS) % size + 10 * k for k, size in enumerate(SIZES)])
FRESH = np.tile(np.arange(DRAWS), (6, 1))

#: Replicates of a simulation; so many false ones come up once in 1000 tries at the promised rate.
REPLICATES = 120
MOST = int(stats.binom.ppf(0.999, REPLICATES, ERROR))


def world(random, true, rig, *, wild=1.0, heavy=False):
    """Scores of entries with true means, points: what rigs and draws add differs by entry."""
    lungs, draws = rig.shape

    def drawn(*shape):
        return random.exponential(size=shape) - 1.0 if heavy else random.standard_normal(shape)

    values = np.empty((len(true), lungs, draws))
    for lung in range(lungs):
        names, index = np.unique(rig[lung], return_inverse=True)
        of_rig = 10.0 * drawn(len(true), len(names))
        of_rig[:, 0] *= wild if lung == 0 else 1.0
        shared = 5.0 * drawn(1, draws)
        values[:, lung] = true[:, None] + of_rig[:, index] + shared + 10.0 * drawn(len(true), draws)
    return values


@pytest.mark.parametrize("rig", [FIXED, FRESH], ids=["fixed rigs", "fresh rigs"])
@pytest.mark.parametrize(("count", "wild", "heavy"), [(7, 1, False), (15, 5, True), (30, 1, True)])
def test_equal_entries_get_false_ranks_in_at_most_five_of_a_hundred(rig, count, wild, heavy):
    random, false = np.random.default_rng(count), 0
    for _ in range(REPLICATES):
        values = world(random, np.zeros(count), rig, wild=wild, heavy=heavy)
        false += bool((comparison.ranks(values, rig, matters=POINTS).rank > 1).any())
    assert false <= MOST


def test_the_rate_holds_where_a_difference_is_just_what_does_not_matter():
    """The least favourable truth: half of the entries are worse by one point, little noise."""
    random, true, false = np.random.default_rng(3), np.repeat([0.0, POINTS], 4), 0
    for _ in range(REPLICATES):
        values = true[:, None, None] + 0.01 * world(random, 0.0 * true, FIXED)
        false += bool(comparison.ranks(values, FIXED, matters=POINTS).better.any())
    assert false <= MOST


def test_without_a_correction_equal_entries_do_get_false_ranks():
    """Control: the simulation would show it."""
    random, false = np.random.default_rng(5), 0
    for _ in range(REPLICATES):
        values = world(random, np.zeros(15), FIXED)
        false += bool((comparison.p_values(values, FIXED, 0.0) < 0.025).any())
    assert false > 0.4 * REPLICATES


def test_clear_differences_are_found_and_the_ranks_hold_together():
    random = np.random.default_rng(7)
    true = np.array([20.0, 20.0, 60.0, 100.0, 100.0, 170.0])
    truth = 1 + np.array([(true < own - POINTS).sum() for own in true])
    inside = 0
    for _ in range(REPLICATES):
        made = comparison.ranks(world(random, true, FRESH), FRESH, matters=POINTS)
        inside += bool(np.all((made.best <= truth) & (truth <= made.worst)))
        assert made.rank.tolist() == truth.tolist() or (made.rank <= truth).all()
    assert inside >= REPLICATES - MOST
    assert made.rank.tolist() == [1, 1, 3, 4, 4, 6]


def test_a_lower_mean_never_stands_below_a_higher_one():
    """Although the wild entry cannot be told from the best, it is not ranked above the middle."""
    random = np.random.default_rng(9)
    for _ in range(20):
        values = world(random, np.array([20.0, 45.0, 50.0]), FRESH)
        values[2] += np.where(FRESH < 2, 600.0, 0.0) - 60.0
        made = comparison.ranks(values, FRESH, matters=POINTS)
        order = np.argsort(values.mean(axis=(1, 2)))
        assert (np.diff(made.rank[order]) >= 0).all()
        assert (made.best <= made.rank).all()
        assert (made.rank <= made.worst).all()
    assert made.best[2] == 1, "control: its range says that it cannot be told from the best"


def test_what_does_not_matter_gives_no_rank():
    """A copy that is better by half a point in every run: certain, and of no matter."""
    values = world(np.random.default_rng(1), np.array([20.0]), FIXED)
    both = np.concatenate([values, values - 0.5])
    assert comparison.ranks(both, FIXED, matters=POINTS).rank.tolist() == [1, 1]
    apart = both - [[[0.0]], [[1.0]]]
    assert comparison.ranks(apart, FIXED, matters=POINTS).rank.tolist() == [2, 1]


def test_a_copy_never_pushes_its_source():
    """Copies that are better beyond doubt, and a ruined one; an honest entry is between."""
    values = world(np.random.default_rng(2), np.array([20.0, 60.0]), FIXED)
    better, ruined = values[:1] - 3.0, values[:1] + 20.0
    entries = np.concatenate([values, better, better - 3.0, ruined])
    alone = comparison.ranks(entries, FIXED, matters=POINTS)
    assert alone.rank[0] == 3, "control: as strangers they do"
    made = comparison.ranks(entries, FIXED, [None, None, 0, 2, 0], matters=POINTS)
    assert made.rank[0] == 1
    assert made.rank[1] == 2, "four of a kind count once"
    assert made.rank[4] == 2, "a ruined copy does not share its source's rank"


def _followers(random):
    """Commands of an entry, and of others that follow it or do not, shape ``(runs, steps)``."""
    own = np.clip(30.0 + 20.0 * random.standard_normal((200, 34)).cumsum(axis=1) / 3, 0.0, 100.0)
    ruined = own.copy()
    ruined[: int(200 * (0.95 - FOLLOWING))] = 100.0
    noisy = own + 0.5 * DISTANCE * 30.0 * random.standard_normal(own.shape)
    other = np.clip(own + 10.0 * random.standard_normal(own.shape), 0.0, 100.0)
    return [own, 1.01 * own, ruined, noisy, other, own]


def test_who_follows_an_earlier_entry_is_found():
    made = comparison.sources(_followers(np.random.default_rng(4)))
    assert made == [None, 0, 0, 0, None, 0]


def test_entries_without_commands_follow_nobody_but_each_other():
    zero, some = np.zeros((5, 34)), np.ones((5, 34))
    assert comparison.sources([some, zero]) == [None, None]


#: Spread between entries of the published stress scores on each lung and draw, cmH2O.
SPREAD = np.array(
    [
        [0.20, 0.05, 0.09, 0.06, 0.07, 0.14],
        [0.10, 0.19, 0.12, 0.14, 0.10, 0.17],
        [0.09, 0.11, 0.10, 0.19, 0.16, 0.07],
        [0.11, 0.22, 0.14, 0.10, 0.17, 0.22],
        [0.70, 0.71, 1.09, 0.68, 0.86, 0.67],
        [0.60, 0.24, 1.00, 0.24, 0.42, 0.73],
    ]
)


@pytest.mark.parametrize(("entries", "boards"), [(7, 300), (15, 150), (30, 60), (60, 20)])
def test_equal_entries_under_stress_are_not_told_apart(entries, boards):
    """Rigs differ by a factor of 20 in spread, and two draws share one: at most 5 % of boards."""
    random = np.random.default_rng(entries)
    rig = np.tile([0, 1, 2, 3, 1, 5], (6, 1))
    false = 0
    for _ in range(boards):
        of_rig = random.standard_normal((entries, 6, 6))[:, :, rig[0]]
        values = SPREAD * (0.9 * of_rig + 0.4 * random.standard_normal((entries, 6, 6)))
        false += comparison.ranks(values, rig, matters=comparison.CMH2O).better.any()
    assert false <= 0.05 * boards
