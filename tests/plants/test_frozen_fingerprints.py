"""Breaths are known again by lung and commands, and by nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.plants.frozen import BY_ALL, BY_NONE, fingerprints, seen
from ventbench.recordings import join, load, write

LUNGS = ["R5C10", "R20C50", "R5C10", "R20C20"]


@pytest.fixture
def breaths(make_recording):
    return make_recording(LUNGS)


def changed(breaths, breath, sample, by):
    u_in = breaths.u_in.copy()
    u_in[breath, sample] += by
    return replace(breaths, u_in=u_in)


def test_all_differ_and_follow_the_order_of_rows(breaths):
    keys = fingerprints(breaths)
    assert len(set(keys.tolist())) == 4
    assert keys.dtype == np.uint64
    np.testing.assert_array_equal(fingerprints(breaths.select([2, 0, 3])), keys[[2, 0, 3]])


def test_clock_pressure_id_and_expiration_do_not_matter(breaths):
    other = replace(
        changed(breaths, 1, 60, 3.0),
        breath_id=breaths.breath_id + 100,
        time=breaths.time * 1.1,
        dt=breaths.dt * 1.1,
        pressure=np.full_like(breaths.pressure, np.nan),
    )
    np.testing.assert_array_equal(fingerprints(other), fingerprints(breaths))


@pytest.mark.parametrize("by", [0.001, -5.0])
def test_a_changed_command_or_lung_is_another_breath(breaths, by):
    keys = fingerprints(breaths)
    assert (fingerprints(changed(breaths, 1, 4, by)) != keys).tolist() == [
        False,
        True,
        False,
        False,
    ]
    lungs = replace(breaths, C=np.array([20.0, 50.0, 10.0, 20.0]))
    assert (fingerprints(lungs) != keys).tolist() == [True, False, False, False]
    u_out = breaths.u_out.copy()
    u_out[3, 29] = 1  # a shorter inspiration
    assert (fingerprints(replace(breaths, u_out=u_out)) != keys).tolist() == [False] * 3 + [True]


def test_a_copy_with_fewer_digits_is_known(breaths, tmp_path):
    breaths = replace(breaths, u_in=np.round(breaths.u_in, 4))
    copy = replace(breaths, u_in=breaths.u_in.astype(np.float32).astype(float))
    assert (copy.u_in != breaths.u_in).any()
    np.testing.assert_array_equal(fingerprints(copy), fingerprints(breaths))
    write(breaths, tmp_path / "copy.csv")
    np.testing.assert_array_equal(fingerprints(load(tmp_path / "copy.csv")), fingerprints(breaths))


def test_folds_are_looked_up(breaths, make_recording):
    known = seen(breaths, np.array([0, 3, BY_ALL, 2]))
    assert known.fold.dtype == np.int8
    assert (np.diff(known.key.astype(object)) > 0).all()
    mixed = join([breaths.select([3, 1]), make_recording(LUNGS, seed=1), breaths.select([0, 2])])
    assert known.folds(mixed).tolist() == [2, 3, *[BY_NONE] * 4, 0, BY_ALL]


def test_a_breath_that_is_there_twice_has_been_seen_by_all(breaths):
    """Whichever member holds one copy out has learned from the other."""
    twice = join([breaths, breaths.select([1, 2])])
    known = seen(twice, np.array([0, 3, 4, 2, 1, BY_ALL]))
    assert known.folds(breaths).tolist() == [0, BY_ALL, BY_ALL, 2]
