"""Dead times that began on the wrong side of a sample."""

from __future__ import annotations

import pytest

from ventbench.diagnosis.evaluator import delay_restarts
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.selection import estimate_noise, fit_with_noise

from . import small

PATH = "exhalation_valve_delay.opening"


@pytest.fixture(scope="module")
def late():
    return small.split(
        small.made(small.effect("exhalation_valve_delay", opening=0.1), samples=64, noise=0.1)
    )


def test_a_search_that_stays_on_its_side_is_carried_over(late):
    late_by = Hypothesis(("exhalation_valve_delay",))
    stuck = late.fit(late_by, fit_with_noise(late, late_by).noise, start={PATH: 0.02})
    moved = delay_restarts(stuck.problem, stuck.minimum.x)
    there = moved[stuck.problem.unknowns.of(PATH)]
    assert there == pytest.approx(0.1, abs=0.025)
    fitted = fit_with_noise(late, late_by, stuck)
    assert fitted.column(PATH)[0] == pytest.approx(0.1, abs=0.02)
    assert estimate_noise(fitted).sigma[0] == pytest.approx(0.1, rel=0.3)


def test_what_is_right_stays(late):
    fitted = fit_with_noise(late, Hypothesis(("exhalation_valve_delay",)))
    assert delay_restarts(fitted.problem, fitted.minimum.x) == pytest.approx(fitted.minimum.x)


def test_without_dead_times_there_is_nothing_to_leap_over(late):
    fitted = late.fit(Hypothesis(("sensor_lag",)), fit_with_noise(late, Hypothesis()).noise)
    assert delay_restarts(fitted.problem, fitted.minimum.x) is fitted.minimum.x
