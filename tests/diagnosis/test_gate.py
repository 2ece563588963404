"""Whether a term is needed, by breaths that were held out and by all of them in turn."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.diagnosis import gate
from ventbench.diagnosis.crossed import crossed
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.steps import settle

from . import small


@pytest.fixture(scope="module")
def turbulent():
    return small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))


@pytest.fixture(scope="module")
def both(turbulent):
    named = settle(turbulent, Hypothesis(("turbulent_resistance",)))
    return named, turbulent.solve(Hypothesis(), named.noise, named)


def test_every_breath_judges_once(turbulent, both):
    assert len(turbulent.folds) == 2
    seen = [turbulent.judging, *(judging for _, judging in turbulent.folds)]
    pressures = np.concatenate([side.data.seen[:, 0] for side in seen])
    assert len(np.unique(pressures, axis=0)) == small.BREATHS
    for training, judging in turbulent.folds:
        assert len(training.data) + len(judging.data) == small.BREATHS
    gained = crossed(turbulent, *both)
    assert gained.shape == (small.BREATHS,)
    assert gained[: len(turbulent.judging.data)] == pytest.approx(
        turbulent.judged(both[0]) - turbulent.judged(both[1])
    )
    assert gained.sum() > 50.0


def test_what_acts_is_needed_and_what_does_not_is_not(turbulent, both):
    named, without = both
    assert gate.needed(turbulent, named, without)
    idle = turbulent.solve(Hypothesis(("turbulent_resistance", "leak")), named.noise, named)
    assert not gate.needed(turbulent, idle, named)


def test_all_breaths_are_asked_only_where_the_training_ones_plainly_are(
    turbulent, both, monkeypatch
):
    asked = []

    def of_all(*given):
        asked.append(given)
        return np.full(small.BREATHS, 1.0)

    monkeypatch.setattr(gate, "crossed", of_all)
    monkeypatch.setattr(gate, "believed", lambda gained, least=gate.GATE: len(gained) > 8)
    assert gate.needed(turbulent, *both)
    assert len(asked) == 1
    assert not gate.needed(turbulent, *reversed(both))
    assert len(asked) == 1


def test_a_trace_is_far_weaker_than_mild_and_explains_little(turbulent, both):
    named, _ = both
    two = turbulent.solve(Hypothesis(("turbulent_resistance", "sensor_drift")), named.noise, named)
    assert abs(two.column("sensor_drift.drift")[0]) < 0.2 * 1.2
    assert gate.is_trace(turbulent, two, named, "sensor_drift")
    without = turbulent.solve(two.hypothesis.without("turbulent_resistance"), two.noise, two)
    assert not gate.is_trace(turbulent, two, without, "turbulent_resistance")


def test_a_weak_term_that_explains_nearly_all_is_no_trace():
    bench = small.split(small.made(small.effect("valve_dead_band", width=0.28), noise=0.02))
    weak = settle(bench, Hypothesis(("valve_dead_band",)))
    assert weak.column("valve_dead_band.width")[0] < 0.2 * 1.5
    without = bench.solve(Hypothesis(), weak.noise, weak)
    assert bench.criterion(without) - bench.criterion(weak) > 100.0
    assert not gate.is_trace(bench, weak, without, "valve_dead_band")
