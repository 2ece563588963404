"""Distances of held-out breaths against sums by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.distances import distance, distances
from ventbench.recordings import join

from . import made


def test_of_some_samples():
    recorded = np.array([[1.0, 2.0, np.nan, 4.0], [0.0, 0.0, 0.0, 0.0]])
    simulated = np.array([[1.0, 5.0, 7.0, 8.0], [9.0, 9.0, np.nan, 9.0]])
    mask = np.array([[True, True, True, True], [False] * 4])
    found = distance(recorded, simulated, mask)
    assert found.mae == pytest.approx((0.0 + 3.0 + 4.0) / 3)
    assert found.rmse == pytest.approx(np.sqrt((9.0 + 16.0) / 3))
    nothing = distance(recorded, simulated, ~mask & (np.arange(4) == 2))
    assert np.isnan(nothing.mae)
    assert np.isnan(nothing.rmse)


@pytest.fixture
def breaths():
    other = made.breaths("R5C10", n=4, seed=3)
    return join([made.breaths(n=4), dataclasses.replace(other, breath_id=other.breath_id + 100)])


def answers(breaths):
    """Off by a number in inspiration and by twice as much after it."""
    off = np.where(breaths.u_out == 1, 2.0, 1.0)
    return {name: breaths.pressure + k * off for name, k in
            (("before", 3.0), ("refit", 2.0), ("after", 1.0))}  # fmt: skip


def test_only_inspiration_of_held_out_breaths_counts(breaths):
    held = np.arange(8) % 4 == 1
    given = answers(breaths)
    for x in given.values():
        x[~held] += 100.0
        x[:, 0] += 100.0  # where every simulation starts
    found = distances(breaths, held, given, 0.2)
    assert found.held_out_breaths == (2, 102)
    assert (found.before.mae, found.before.rmse) == pytest.approx((3.0, 3.0))
    assert (found.refit.mae, found.after.rmse) == pytest.approx((2.0, 1.0))
    assert found.noise_floor == 0.2
    assert found.groups["expiration"]["refit"].mae == pytest.approx(4.0)


def test_parts_of_the_breath_and_lungs(breaths):
    held = np.ones(8, bool)
    given = answers(breaths)
    early = breaths.time <= 0.2
    given["after"][early] += 4.0
    given["before"][breaths.lung_ids == "R5C10"] += 5.0
    found = distances(breaths, held, given, 0.2)
    assert list(found.groups) == [
        "first 0.2 s of inspiration", "rest of inspiration", "expiration", "lung R5C10",
        "lung R20C50",
    ]  # fmt: skip
    assert found.groups["first 0.2 s of inspiration"]["after"].mae == pytest.approx(5.0)
    assert found.groups["rest of inspiration"]["after"].mae == pytest.approx(1.0)
    assert found.groups["lung R5C10"]["before"].mae == pytest.approx(8.0)
    assert found.groups["lung R20C50"]["before"].mae == pytest.approx(3.0)
    # Parts together are the whole.
    inside = breaths.inspiratory & (breaths.time > 0)
    error = (given["after"] - breaths.pressure)[inside]
    assert found.after.rmse == pytest.approx(np.sqrt(np.mean(error**2)))


def test_one_lung_is_no_part_and_gaps_do_not_count(breaths):
    one = breaths.select(np.arange(4))
    pressure = one.pressure.copy()
    pressure[:, 10:15] = np.nan
    given = answers(one)
    given["after"][2] = np.nan
    given["after"][:, 10:15] = 1e6
    holes = dataclasses.replace(one, pressure=pressure)
    found = distances(holes, np.ones(4, bool), given, 0.2)
    assert not [name for name in found.groups if name.startswith("lung")]
    assert found.after.mae == pytest.approx(1.0)
