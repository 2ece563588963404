"""Whether a term is needed, by breaths that were held out and by all of them in turn."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.diagnosis import selection
from ventbench.diagnosis.evaluator import cross_validated_gain
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.selection import fit_with_noise

from . import small


@pytest.fixture(scope="module")
def turbulent():
    return small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))


@pytest.fixture(scope="module")
def both(turbulent):
    named = fit_with_noise(turbulent, Hypothesis(("turbulent_resistance",)))
    return named, turbulent.fit(Hypothesis(), named.noise, named)


def test_every_breath_judges_once(turbulent, both):
    assert len(turbulent.folds) == 2
    seen = [turbulent.held_out, *(judging for _, judging in turbulent.folds)]
    pressures = np.concatenate([partition.data.seen[:, 0] for partition in seen])
    assert len(np.unique(pressures, axis=0)) == small.BREATHS
    for training, judging in turbulent.folds:
        assert len(training.data) + len(judging.data) == small.BREATHS
    gained = cross_validated_gain(turbulent, *both)
    assert gained.shape == (small.BREATHS,)
    assert gained[: len(turbulent.held_out.data)] == pytest.approx(
        turbulent.held_out_log_likelihood(both[0]) - turbulent.held_out_log_likelihood(both[1])
    )
    assert gained.sum() > 50.0


def test_what_acts_is_needed_and_what_does_not_is_not(turbulent, both):
    named, without = both
    assert selection.is_needed(turbulent, named, without)
    idle = turbulent.fit(Hypothesis(("turbulent_resistance", "leak")), named.noise, named)
    assert not selection.is_needed(turbulent, idle, named)


def test_all_breaths_are_asked_only_where_the_training_ones_plainly_are(
    turbulent, both, monkeypatch
):
    asked = []

    def of_all(*given):
        asked.append(given)
        return np.full(small.BREATHS, 1.0)

    monkeypatch.setattr(selection, "cross_validated_gain", of_all)
    monkeypatch.setattr(
        selection, "passes_heldout_test", lambda gained, least=selection.GATE: len(gained) > 8
    )
    assert selection.is_needed(turbulent, *both)
    assert len(asked) == 1
    assert not selection.is_needed(turbulent, *reversed(both))
    assert len(asked) == 1


def test_a_trace_is_far_weaker_than_mild_and_explains_little(turbulent, both):
    named, _ = both
    two = turbulent.fit(Hypothesis(("turbulent_resistance", "sensor_drift")), named.noise, named)
    assert abs(two.column("sensor_drift.drift")[0]) < 0.2 * 1.2
    assert selection.is_negligible(turbulent, two, named, "sensor_drift")
    without = turbulent.fit(two.hypothesis.without("turbulent_resistance"), two.noise, two)
    assert not selection.is_negligible(turbulent, two, without, "turbulent_resistance")


def test_a_weak_term_that_explains_nearly_all_is_no_trace():
    evaluator = small.split(small.made(small.effect("valve_dead_band", width=0.28), noise=0.02))
    weak = fit_with_noise(evaluator, Hypothesis(("valve_dead_band",)))
    assert weak.column("valve_dead_band.width")[0] < 0.2 * 1.5
    without = evaluator.fit(Hypothesis(), weak.noise, weak)
    assert evaluator.criterion(without) - evaluator.criterion(weak) > 100.0
    assert not selection.is_negligible(evaluator, weak, without, "valve_dead_band")
