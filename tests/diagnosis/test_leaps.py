"""Dead times that began on the wrong side of a sample."""

from __future__ import annotations

import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.leaps import leapt
from ventbench.diagnosis.steps import noise_of, settle

from . import small

PATH = "exhalation_valve_delay.opening"


@pytest.fixture(scope="module")
def late():
    return small.split(
        small.made(small.effect("exhalation_valve_delay", opening=0.1), samples=64, noise=0.1)
    )


def test_a_search_that_stays_on_its_side_is_carried_over(late):
    late_by = Hypothesis(("exhalation_valve_delay",))
    stuck = late.solve(late_by, settle(late, late_by).noise, start={PATH: 0.02})
    moved = leapt(stuck.problem, stuck.minimum.x)
    there = moved[stuck.problem.unknowns.of(PATH)]
    assert there == pytest.approx(0.1, abs=0.025)
    solved = settle(late, late_by, stuck)
    assert solved.column(PATH)[0] == pytest.approx(0.1, abs=0.02)
    assert noise_of(solved).sigma[0] == pytest.approx(0.1, rel=0.3)


def test_what_is_right_stays(late):
    solved = settle(late, Hypothesis(("exhalation_valve_delay",)))
    assert leapt(solved.problem, solved.minimum.x) == pytest.approx(solved.minimum.x)


def test_without_dead_times_there_is_nothing_to_leap_over(late):
    solved = late.solve(Hypothesis(("sensor_lag",)), settle(late, Hypothesis()).noise)
    assert leapt(solved.problem, solved.minimum.x) is solved.minimum.x
