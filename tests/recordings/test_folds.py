"""Folds of a cross-validation: complete, balanced, the same everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.errors import InputError
from ventbench.recordings import folds, join, make_breaths, split_by_breath


def breaths_of(lungs):
    n = len(lungs)
    time = np.tile([0.0, 1.0], (n, 1))
    r, c = np.array(lungs, dtype=float).reshape(n, 2).T
    return make_breaths(np.arange(n) * 7 + 3, r, c, time, time, time, time)


lungs = st.tuples(st.sampled_from([5, 20, 50]), st.sampled_from([10, 20, 50]))


@settings(deadline=None)
@given(
    st.lists(lungs, min_size=1, max_size=60),
    st.integers(2, 7),
    st.integers(0, 1000),
    st.randoms(use_true_random=False),
)
def test_each_lung_is_dealt_out_evenly_whatever_the_order(settings_of, count, seed, random):
    breaths = breaths_of(settings_of)
    fold = folds(breaths, count=count, seed=seed)
    assert fold.dtype == np.int64
    for index in breaths.by_lung_index.values():
        sizes = np.bincount(fold[index], minlength=count)
        assert len(sizes) == count
        assert sizes.max() - sizes.min() <= 1
    order = list(range(len(breaths)))
    random.shuffle(order)
    np.testing.assert_array_equal(folds(breaths.select(order), count=count, seed=seed), fold[order])


def test_folds_are_pinned():
    """These may never change: the members of the frozen ensemble stand on them."""
    breaths = breaths_of([(5, 10)] * 10 + [(20, 50)] * 10)
    assert folds(breaths).tolist() == PINNED
    assert folds(breaths, seed=1).tolist() != PINNED


PINNED = [4, 0, 1, 0, 3, 3, 4, 2, 1, 2, 1, 4, 4, 2, 2, 0, 3, 1, 0, 3]


def test_the_first_fold_begins_as_a_split_does():
    """Both take breaths in one order, so the first breath of fold 0 is held out by a split too."""
    breaths = breaths_of([(5, 10)] * 10)
    first = set(split_by_breath(breaths, held_out=0.1).held_out_ids)
    assert first <= set(breaths.breath_id[folds(breaths) == 0].tolist())


def test_what_is_refused():
    breaths = breaths_of([(5, 10)] * 4)
    for count in (1, 0, -2):
        with pytest.raises(InputError, match="at least 2 folds"):
            folds(breaths, count=count)
    with pytest.raises(InputError, match="more than once"):
        folds(join([breaths, breaths]))
