"""Intervals over rigs: right width where one source of scatter is alone, paired, reproducible."""

import numpy as np
import pytest

from ventbench.task.metrics.bootstrap import resampled_scores

LUNGS, DRAWS = 6, 24
RIG = np.arange(DRAWS) % 4 + 10 * np.arange(LUNGS)[:, None]
MEMBER = np.broadcast_to(np.arange(DRAWS) // 4 % 5, (LUNGS, DRAWS))


def spread(values, rig=RIG, member=MEMBER):
    return resampled_scores(values, rig, member).std()


def test_equal_values_have_no_spread():
    scores = resampled_scores(np.full((LUNGS, DRAWS), 3.5), RIG, MEMBER)
    np.testing.assert_allclose(scores, 3.5)


def test_rigs_that_differ_spread_as_a_mean_over_so_many_rigs():
    # Var of the mean over 4 rigs of unit variance, over 6 lungs: 1 / 24; unbiased on average.
    rng = np.random.default_rng(0)
    variances = []
    for _ in range(300):
        effect = rng.normal(size=(LUNGS, 4))
        values = np.take_along_axis(effect, np.broadcast_to(np.arange(DRAWS) % 4, RIG.shape), 1)
        rigs_alone = resampled_scores(values, RIG, np.zeros_like(RIG), resamples=200)
        draws_share = values.var(axis=1).mean() / DRAWS / LUNGS
        variances.append(rigs_alone.var() - draws_share)
    assert np.mean(variances) == pytest.approx(1 / 24, rel=0.08)


def test_members_are_shared_by_lungs_and_do_not_average_out():
    effect = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    values = effect[MEMBER]
    expected = np.sqrt(np.var(effect, ddof=1) / 5)
    assert spread(values) > 0.9 * expected
    lungs_apart = spread(values) / spread(values[:1], RIG[:1], MEMBER[:1])
    assert lungs_apart > 0.8  # six lungs help little


def test_draws_alone_are_counted_at_most_three_times():
    values = np.random.default_rng(1).normal(size=(LUNGS, DRAWS))
    least = values.std() / np.sqrt(values.size)
    assert 0.95 * least < spread(values) < 1.9 * least


def test_pairs_share_what_is_resampled():
    rng = np.random.default_rng(2)
    one, other = rng.normal(size=(2, LUNGS, DRAWS))
    difference = resampled_scores(one - other, RIG, MEMBER)
    apart = resampled_scores(one, RIG, MEMBER) - resampled_scores(other, RIG, MEMBER)
    np.testing.assert_allclose(difference, apart, atol=1e-12)


def test_stream_stays():
    scores = resampled_scores([[1.0, 2.0, 4.0]], [[0, 0, 1]], [[0, 1, 1]], resamples=4)
    np.testing.assert_array_equal(
        scores, resampled_scores([[1.0, 2.0, 4.0]], [[5, 5, 7]], [[1, 2, 2]], resamples=4)
    )


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="differ in shape"):
        resampled_scores(np.ones((2, 3)), np.ones((2, 3)), np.ones((2, 4)))
