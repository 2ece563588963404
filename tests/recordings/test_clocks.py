"""Ventilators of a file, told apart by their clocks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.diagnosis import small
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.clocks import rigs_by_clock


def _sampled(intervals: np.ndarray) -> Breaths:
    """Breaths whose medians of the sampling interval are these, s."""
    breaths = small.made(breaths=len(intervals))
    dt = np.repeat(intervals[:, None], breaths.dt.shape[1], axis=1)
    return dataclasses.replace(breaths, dt=dt, time=np.cumsum(dt, axis=1) - dt)


@pytest.mark.parametrize("seed", range(5))
def test_two_clocks_are_two_ventilators_and_breaths_between_join_the_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    fast, slow = (interval * rng.normal(1.0, 1e-3, 6) for interval in (0.0319, 0.0340))
    intervals = np.concatenate([fast, slow, [0.0324, 0.0334]])
    order = rng.permutation(len(intervals))
    expected = np.array([0] * 6 + [1] * 6 + [0, 1])
    assert np.array_equal(rigs_by_clock(_sampled(intervals[order])), expected[order])


@pytest.mark.parametrize(
    "intervals",
    [
        np.full(8, 0.033),
        np.array([0.033, 0.034] * 4),  # a clock that counts milliseconds
        np.linspace(0.02, 0.04, 8),  # whenever something happened
        np.array([0.034] * 7 + [0.0319]),  # too few to tell
    ],
)
def test_one_clock_is_one_ventilator_however_irregular(intervals: np.ndarray) -> None:
    assert not rigs_by_clock(_sampled(intervals)).any()


def test_a_ventilator_with_few_breaths_of_a_lung_counts_as_the_other() -> None:
    breaths = _sampled(np.array([0.0319] * 5 + [0.0340] * 7))
    R = np.where(np.arange(12) == 4, 5.0, 20.0)
    R[5:9] = 5.0
    breaths = dataclasses.replace(breaths, R=R)
    assert rigs_by_clock(breaths).tolist() == [0] * 4 + [1] * 8
