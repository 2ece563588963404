"""Which breaths can be used, and which no fit may see."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ventbench.base.errors import InputError
from ventbench.diagnosis.experiment import held_out, split, usable
from ventbench.diagnosis.settings import DEFAULT

from . import made

EVERY, FEWEST = DEFAULT.data.held_out_every, DEFAULT.data.min_breaths


@given(st.lists(st.sampled_from([5.0, 20.0, 50.0]), min_size=1, max_size=40))
def test_every_third_breath_of_each_lung_is_held_out(R):
    one = made.breaths(n=1, samples=6)
    breaths = dataclasses.replace(one.select(np.zeros(len(R), int)), R=np.array(R))
    held = held_out(breaths)
    for value in set(R):
        own = held[np.array(R) == value]
        assert np.array_equal(own, np.arange(len(own)) % EVERY == 1)


def test_all_good_breaths_are_used_as_they_are():
    breaths = made.breaths(n=5)
    found, notes = usable(breaths)
    assert notes == []
    assert np.array_equal(found.breath_id, breaths.breath_id)
    assert np.array_equal(found.pressure, breaths.pressure)


def test_breaths_without_a_start_an_inspiration_or_a_command_are_left_out():
    breaths = made.breaths(n=9)
    pressure, u_in = breaths.pressure.copy(), breaths.u_in.copy()
    pressure[1, 0] = np.nan
    pressure[2, 4:] = np.nan  # four are one too many
    pressure[3, 3:] = np.nan
    u_in[5] = 0.0
    breaths = dataclasses.replace(breaths, pressure=pressure, u_in=u_in)
    found, notes = usable(breaths)
    assert found.breath_id.tolist() == [1, 3, 5, 7, 8, 9]
    assert len(notes) == 1
    assert notes[0].startswith("3 breaths without a first pressure")
    assert "breath_id 2, 4, 6" in notes[0]


def test_gaps_elsewhere_do_no_harm():
    breaths = made.breaths(n=5)
    pressure = breaths.pressure.copy()
    pressure[:, 5:9] = np.nan
    found, notes = usable(dataclasses.replace(breaths, pressure=pressure))
    assert len(found) == 5
    assert notes == []


def test_too_few_breaths_are_refused():
    with pytest.raises(InputError, match=rf"{FEWEST - 1} usable breaths; .* at least {FEWEST}"):
        usable(made.breaths(n=FEWEST - 1))
    assert len(usable(made.breaths(n=FEWEST))[0]) == FEWEST
    with pytest.raises(InputError, match=r"^0 usable breaths"):
        usable(made.breaths(n=3).select(np.zeros(0, int)))


def test_one_breath_of_each_lung_is_not_enough():
    breaths = dataclasses.replace(made.breaths(n=4), R=np.array([5.0, 10.0, 20.0, 50.0]))
    with pytest.raises(InputError, match=r"no lung has two usable breaths"):
        usable(breaths)
    twice = dataclasses.replace(breaths, R=np.array([5.0, 10.0, 20.0, 20.0]))
    assert held_out(usable(twice)[0]).tolist() == [False, False, False, True]


@pytest.mark.parametrize("n", [4, 12, 18, 60])
def test_each_breath_has_one_use_where_there_are_enough(n):
    uses = split(made.breaths(n=n, samples=6))
    training = ~uses.testing & ~uses.judging
    assert training.sum() >= 2
    assert uses.testing.any()
    assert uses.judging.any()
    if n >= DEFAULT.data.judging_from:
        assert not (uses.judging & uses.testing).any()
        assert uses.judging.sum() == n // DEFAULT.data.judging_every
        assert np.array_equal(uses.identifying, ~uses.judging)
    else:
        assert np.array_equal(uses.judging, uses.testing)
        assert uses.identifying.all()
    assert np.array_equal(uses.fitted, ~uses.judging), "what judges is never fitted"


def test_breaths_that_judged_an_earlier_correction_judge_again():
    breaths = made.breaths(n=24, samples=6)
    earlier = (2, 7, 11)  # of another split
    uses = split(breaths, never_fitted=earlier)
    assert breaths.breath_id[uses.judging].tolist() == list(earlier)
    assert not (uses.judging & uses.testing).any()
    everything = tuple(breaths.breath_id.tolist())
    assert np.array_equal(split(breaths, never_fitted=everything).judging, split(breaths).judging)
