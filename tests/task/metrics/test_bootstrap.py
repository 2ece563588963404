import numpy as np
import pytest

from ventbench.task.metrics import bootstrap


def test_interval_is_that_of_theory():
    values = np.random.default_rng(1).normal(3.0, 2.0, size=400)
    found = bootstrap.summary(values, resamples=20000)
    half = 1.96 * values.std() / 20
    assert found.mean == pytest.approx(values.mean())
    assert found.median == pytest.approx(np.median(values))
    assert found.ci95 == pytest.approx(
        (values.mean() - half, values.mean() + half), abs=0.05 * half
    )
    assert found.count == 400


def test_covers_as_often_as_it_says():
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(300):
        low, high = bootstrap.summary(rng.exponential(size=60), resamples=400).ci95
        hits += low <= 1.0 <= high
    assert 0.88 <= hits / 300 <= 0.98  # a percentile bootstrap of a skewed sample is a bit narrow


def test_frozen_stream():
    # The resampled indices must never change: intervals on the board depend on them.
    values = np.arange(10.0)
    np.testing.assert_allclose(
        bootstrap.resampled_means(values, resamples=4, seed=7), FROZEN, rtol=0, atol=1e-12
    )


FROZEN = [5.3, 5.2, 3.8, 2.7]


def test_every_index_is_as_likely():
    counts = [
        bootstrap.resampled_means(np.eye(3)[i], resamples=20000).sum() for i in range(3)
    ]  # each mean counts how often value i was drawn
    assert np.sum(counts) == pytest.approx(20000)
    np.testing.assert_allclose(counts, 20000 / 3, rtol=0.03)


def test_chunks_change_nothing(monkeypatch):
    values = np.random.default_rng(3).normal(size=50)
    whole = bootstrap.resampled_means(values, resamples=100)
    monkeypatch.setattr(bootstrap, "_CHUNK", 333)
    np.testing.assert_array_equal(bootstrap.resampled_means(values, resamples=100), whole)


def test_paired():
    a = np.random.default_rng(4).normal(size=20)
    difference = bootstrap.resampled_means(a + 1.0) - bootstrap.resampled_means(a)
    np.testing.assert_allclose(difference, 1.0)


def test_missing_values():
    found = bootstrap.summary([1.0, np.nan, 3.0])
    assert (found.mean, found.median, found.count) == (2.0, 2.0, 2)
    nothing = bootstrap.summary([np.nan])
    assert np.isnan([nothing.mean, nothing.median, *nothing.ci95]).all()
    assert nothing.count == 0
    one = bootstrap.summary([4.0])
    assert one.mean == 4.0
    assert np.isnan(one.ci95).all()
    broken = bootstrap.summary([1.0, np.inf, 2.0])
    assert (broken.mean, broken.median, broken.count) == (np.inf, 2.0, 3)
    assert np.isnan(broken.ci95).all()


def test_nothing_to_resample():
    with pytest.raises(ValueError, match="cannot resample"):
        bootstrap.resampled_means([])
