"""Tests on held-out breaths, and what a search selects."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base
from ventbench.diagnosis import validation
from ventbench.diagnosis.conclusion import eliminate
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.settings import HeldOutTestSettings
from ventbench.diagnosis.validation import passes_heldout_test
from ventbench.system_id import Noise, robust_noise

from . import small


def test_a_mechanism_is_needed_if_and_only_if_it_acts(turbulent, both):
    named, without = both
    assert validation.is_needed(turbulent, named, without)
    idle = turbulent.fit(Hypothesis(("turbulent_resistance", "leak")), named.noise, named)
    assert not validation.is_needed(turbulent, idle, named)


def test_cross_validation_runs_only_where_the_training_breaths_clearly_ask(
    turbulent, both, monkeypatch
):
    asked = []

    def of_all(*given):
        asked.append(given)
        return np.full(small.BREATHS, 1.0)

    monkeypatch.setattr(validation, "cross_validated_gain", of_all)
    monkeypatch.setattr(validation, "passes_heldout_test", lambda gained, *_: len(gained) > 8)
    assert validation.is_needed(turbulent, *both)
    assert len(asked) == 1
    assert not validation.is_needed(turbulent, *reversed(both))
    assert len(asked) == 1


THRESHOLD = HeldOutTestSettings().threshold

#: Effects that are named.
STRONG = {
    "valve_lag": {"tau": 0.1},
    "viscoelasticity": {"ratio": 0.7, "time": 1.0},
    "command_rounding": {"amount": 1.0},
}


def test_the_held_out_test_needs_enough_gain_from_more_than_one_breath():
    even = np.full(8, 1.0)
    assert passes_heldout_test(even)
    assert not passes_heldout_test(0.9 * THRESHOLD / 8 * even)
    assert not passes_heldout_test(-even)
    one = np.zeros(8)
    one[3] = 1000.0
    scatter = np.random.default_rng(1).normal(0.0, 0.5, 8)
    assert not passes_heldout_test(one)
    assert not passes_heldout_test(one + scatter)
    assert passes_heldout_test(one + 200.0)
    assert not passes_heldout_test(np.array([3.0, 30.0]) - 5.0)
    few = np.full(20, 0.01)
    few[:5] = 30.0  # an effect that lives in a quarter of the breaths
    assert passes_heldout_test(few)
    # Two breaths of another rig do not decide for the others.
    carried = np.tile([0.1, -0.2, 0.1, -0.3, 0.2], 4)
    carried[[3, 11]] = 150.0, 60.0
    assert not passes_heldout_test(carried)
    # A total that loses in half of the breaths is scatter.
    mixed = np.array([40.0, -30.0] * 4)
    assert mixed.sum() > THRESHOLD
    assert not passes_heldout_test(mixed)


@pytest.mark.parametrize("name", STRONG)
def test_one_strong_effect_is_selected_and_nothing_else(name):
    found = small.concluded(small.made(small.effect(name, **STRONG[name]), seed=4))
    named = found.named
    assert found.names == (name,)
    assert found.held_out_gains[name] > THRESHOLD
    assert named.noise.sigma[0] == pytest.approx(0.2, rel=0.2)
    left = robust_noise(named.residual, named.problem.data.weight)
    assert left.ar[0] == pytest.approx(0.0, abs=0.2)


def test_the_noise_is_that_of_the_shape_that_is_freed():
    """What a drift of another form leaves is no noise, and no other effect either."""
    drift = small.effect("sensor_drift", "warming", drift=4.0)
    named = small.concluded(small.made(drift, noise=0.05, seed=4)).named
    assert named.names == ("sensor_drift",)
    assert "sensor_drift.warming" in named.hypothesis.free
    assert named.noise.sigma[0] == pytest.approx(0.05, rel=0.2)
    left = robust_noise(named.residual, named.problem.data.weight)
    assert named.noise.sigma[0] == pytest.approx(left.sigma[0], rel=0.05)


@pytest.mark.slow
def test_a_little_of_what_every_rig_has_is_compared_with_but_not_named():
    """A little circuit before a high resistance explains much; gas with inertia looks like it."""
    turbulent = small.effect("turbulent_resistance", quadratic=10.0)
    little = small.effect("circuit_compliance", compliance=0.15)
    rig = Base(50.0, 19.5)
    found = small.concluded(small.made(turbulent, little, base=rig, noise=0.1, seed=3))
    assert found.names == tuple(found.held_out_gains) == ("turbulent_resistance",)


def test_strong_efforts_are_selected_and_nothing_else():
    effect = small.effect("patient_effort", amplitude=5.0, duration=0.8)
    named = small.concluded(small.made(effect, seed=4)).named
    assert named.hypothesis.names == ("patient_effort",)


def test_two_strong_effects_are_both_selected():
    two = (
        small.effect("turbulent_resistance", quadratic=10.0),
        small.effect("sensor_lag", tau=0.12),
    )
    named = small.concluded(small.made(*two)).named
    assert set(named.hypothesis.names) == {"turbulent_resistance", "sensor_lag"}


@pytest.mark.parametrize("coloured", [0.0, 0.6])
@pytest.mark.parametrize("seed", [10, 11, 12])
def test_nothing_is_selected_in_noise(coloured, seed):
    recording = small.made(coloured=coloured, correlation=0.8, seed=seed)
    named = small.concluded(recording).named
    assert named.hypothesis.names == ()


def test_a_term_that_another_replaces_is_dropped():
    evaluator = small.split(small.made(small.effect("sensor_lag", tau=0.12)))
    both = evaluator.fit(Hypothesis(("sensor_drift", "sensor_lag")), Noise((0.2,), (0.0,)))
    left = eliminate(evaluator, both)[0]
    assert left.hypothesis.names == ("sensor_lag",)


@pytest.mark.slow  # four rounds and the exchanges, 20 s
def test_a_small_term_that_hides_others_is_compared_with_and_not_named():
    """A few hundredths of a millilitre before 50 cmH2O/(L/s), and a bent valve behind a delay."""
    acting = (
        small.effect("valve_delay", delay=0.0625),
        small.effect("valve_curve", "rational saturation", loss=0.43),
    )
    breaths = small.strange(
        *acting,
        noise=0.15,
        seed=5,
        dead_space=0.05,
        base=dataclasses.replace(small.RIG, R=52.8, C=9.5, gain=22.8),
        proportional=1.3,
    )
    assert set(small.concluded(breaths).names) == {"valve_delay", "valve_curve"}


@pytest.mark.slow
def test_an_effort_that_all_breaths_have_is_not_taken_for_compliance():
    """R and C of the base model make up for the efforts' mean; fits start at the label too."""
    effect = small.effect("patient_effort", "half sine", amplitude=2.5, duration=0.9)
    named = small.concluded(small.strange(effect, noise=0.1, seed=7)).named
    assert named.names == ("patient_effort",)
    assert np.median(named.column("patient_effort.amplitude")) > 1.0


@pytest.mark.slow  # a search in which everything is fitted, 10 s
def test_strong_lags_are_told_from_a_lung_without_resistance():
    """Lags of 0.1 s take R to nothing, where other terms imitate them; at the label, none can."""
    acting = (
        small.effect("sensor_lag", "second order", tau=0.116),
        small.effect("valve_delay", delay=0.0728),
    )
    breaths = small.strange(
        *acting,
        noise=0.2,
        seed=3,
        base=dataclasses.replace(small.RIG, R=51.3, C=9.8, gain=22.8),
    )
    labelled = dataclasses.replace(breaths, R=50.0 + 0.0 * breaths.R, C=10.0 + 0.0 * breaths.C)
    named = small.concluded(labelled).named
    assert set(named.names) == {"sensor_lag", "valve_delay"}
    assert named.column("R")[0] == pytest.approx(51.3, rel=0.1)
