"""Strengths that a recording would have shown: those that are named if they are there."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis import report_text
from ventbench.diagnosis.evaluator import fit_with_noise
from ventbench.diagnosis.hypothesis import Hypothesis, varies_by_breath
from ventbench.diagnosis.validation import detection_limits
from ventbench.physics import library, mechanism

from . import made, small


@pytest.fixture(scope="module")
def limits(plain) -> dict[str, float]:
    return detection_limits(plain.evaluator, plain.base)


def test_every_mechanism_that_all_breaths_share_has_a_limit(limits):
    assert set(limits) == {name for name in library() if not varies_by_breath(name)}
    for name, limit in limits.items():
        assert limit >= mechanism(name).description.least


def test_twice_the_limit_is_seen_and_a_fifth_is_not(limits):
    limit = limits["turbulent_resistance"]
    assert 0.5 < limit < 10.0
    for times, seen in ((2.0, True), (0.2, False)):
        effect = small.effect("turbulent_resistance", quadratic=times * limit)
        evaluator = small.split(small.made(effect))
        named = fit_with_noise(evaluator, Hypothesis(("turbulent_resistance",)))
        base = evaluator.fit(Hypothesis(), named.noise, named)
        gained = evaluator.held_out_log_likelihood(named) - evaluator.held_out_log_likelihood(base)
        assert bool(gained.sum() > evaluator.settings.held_out_test.threshold) is seen


def test_the_limits_are_told_where_nothing_is_missing():
    nothing = dataclasses.replace(
        made.nothing(12),
        detection_limits={"valve_delay": 0.0123, "leak": 1.5, "inertance": np.inf},
    )
    assert report_text.visible_strengths(nothing) == {
        "valve_delay": "12 ms",
        "leak": "1.5 mL/s",
        "inertance": "",
    }
    assert any("lists the smallest strength" in text for text in report_text.sentences(nothing))
    plain = nothing.as_dict()["detection_limits"]
    assert plain["leak"] == {"strength": 1.5, "unit": "mL/s"}
    assert plain["inertance"]["strength"] is None
    assert report_text.visible_strengths(made.diagnosis(12)) == {}
