"""Tests on held-out breaths, comparisons at one noise, and forward selection."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base
from ventbench.diagnosis.conclusion import _supported
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.selection import acceptance, forward
from ventbench.diagnosis.selection.acceptance import passes_heldout_test
from ventbench.diagnosis.selection.candidate_comparison import (
    Comparison,
    RankedModel,
    compare_candidates,
    estimate_noise,
    fit_with_noise,
    fit_with_white_noise,
)
from ventbench.diagnosis.selection.forward import (
    _free_earlier_shapes,
    drop_redundant_terms,
    forward_selection,
    is_far_from_label,
    selection_at_label,
)
from ventbench.diagnosis.selection.pair_exchange import replace_pair
from ventbench.diagnosis.selection.screening import screen_mechanisms
from ventbench.diagnosis.settings import HeldOutTestSettings
from ventbench.system_id import Noise

from . import small


def test_a_mechanism_is_needed_if_and_only_if_it_acts(turbulent, both):
    named, without = both
    assert acceptance.is_needed(turbulent, named, without)
    idle = turbulent.fit(Hypothesis(("turbulent_resistance", "leak")), named.noise, named)
    assert not acceptance.is_needed(turbulent, idle, named)


def test_cross_validation_runs_only_where_the_training_breaths_clearly_ask(
    turbulent, both, monkeypatch
):
    asked = []

    def of_all(*given):
        asked.append(given)
        return np.full(small.BREATHS, 1.0)

    monkeypatch.setattr(acceptance, "cross_validated_gain", of_all)
    monkeypatch.setattr(acceptance, "passes_heldout_test", lambda gained, *_: len(gained) > 8)
    assert acceptance.is_needed(turbulent, *both)
    assert len(asked) == 1
    assert not acceptance.is_needed(turbulent, *reversed(both))
    assert len(asked) == 1


def test_a_negligible_term_is_far_weaker_than_mild_and_explains_little(turbulent, both):
    named, _ = both
    two = turbulent.fit(Hypothesis(("turbulent_resistance", "sensor_drift")), named.noise, named)
    assert abs(two.column("sensor_drift.drift")[0]) < 0.2 * 1.2
    assert acceptance.is_negligible(turbulent, two, named, "sensor_drift")
    without = turbulent.fit(two.hypothesis.without("turbulent_resistance"), two.noise, two)
    assert not acceptance.is_negligible(turbulent, two, without, "turbulent_resistance")


def test_a_weak_term_that_explains_nearly_all_is_not_negligible():
    evaluator = small.split(small.made(small.effect("valve_dead_band", width=0.28), noise=0.02))
    weak = fit_with_noise(evaluator, Hypothesis(("valve_dead_band",)))
    assert weak.column("valve_dead_band.width")[0] < 0.2 * 1.5
    without = evaluator.fit(Hypothesis(), weak.noise, weak)
    assert evaluator.criterion(without) - evaluator.criterion(weak) > 100.0
    assert not acceptance.is_negligible(evaluator, weak, without, "valve_dead_band")


THRESHOLD = HeldOutTestSettings().threshold

#: Effects that are named.
STRONG = {
    "valve_lag": {"tau": 0.1},
    "viscoelasticity": {"ratio": 0.7, "time": 1.0},
    "command_rounding": {"amount": 1.0},
}


def quiet(what: str) -> None:
    pass


def test_excluded_mechanisms_are_not_compared():
    active = small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))
    without = dataclasses.replace(active, excluded=("turbulent_resistance", "patient_effort"))
    assert set(active.allowed_mechanisms) - set(without.allowed_mechanisms) == set(without.excluded)
    base = fit_with_noise(without, Hypothesis())
    named, steps = forward_selection(without, base, quiet)
    assert not set(named.hypothesis.names) & set(without.excluded)
    assert not {candidate.name for candidate in steps[0].ranked} & set(without.excluded)


def test_the_held_out_test_needs_enough_gain_from_more_than_one_breath():
    even = np.full(8, 1.0)
    assert passes_heldout_test(even)
    assert not passes_heldout_test(0.9 * THRESHOLD / 8 * even)
    assert not passes_heldout_test(-even)
    one = np.zeros(8)
    one[3] = 1000.0
    assert not passes_heldout_test(one)
    assert not passes_heldout_test(one + 0.1)
    assert passes_heldout_test(one + 200.0)
    # Two breaths of another rig do not outvote the others, nor decide for them.
    mixed = np.array([20.0, 25.0, 18.0, -150.0, 30.0, 22.0, 24.0, -60.0, 28.0, 26.0, 33.0, 19.0])
    assert passes_heldout_test(mixed)
    carried = np.tile([0.1, -0.2, 0.1, -0.3, 0.2], 4)
    carried[[3, 11]] = 150.0, 60.0
    assert not passes_heldout_test(carried)
    # A total that loses in half of the breaths is scatter.
    mixed = np.array([40.0, -30.0] * 4)
    assert mixed.sum() > THRESHOLD
    assert not passes_heldout_test(mixed)


def test_without_a_promising_candidate_there_is_no_comparison(plain):
    found = screen_mechanisms(plain.base, fit_with_white_noise(plain.evaluator, plain.base))
    faint = [candidate for candidate in found if candidate.promise <= 3.0]
    assert faint
    assert compare_candidates(plain.evaluator, plain.base, faint) is None
    assert compare_candidates(plain.evaluator, plain.base, []) is None


def test_a_comparison_ranks_candidates_at_one_noise():
    evaluator = small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))
    base = fit_with_noise(evaluator, Hypothesis())
    found = compare_candidates(
        evaluator,
        base,
        screen_mechanisms(base, fit_with_white_noise(evaluator, base)),
    )
    assert found is not None
    assert found.ranked[0].name == "turbulent_resistance"
    criteria = [candidate.criterion for candidate in found.ranked]
    assert criteria == sorted(criteria)
    assert len({candidate.name for candidate in found.ranked}) == len(found.ranked)
    # The noise is the best candidate's, without the effect in the residual.
    best = found.ranked[0].fitted
    assert best.log_likelihood > best.log_likelihood_at(base.noise) + 20.0
    assert found.base.noise == found.ranked[0].fitted.noise
    assert passes_heldout_test(found.held_out_gain)


@pytest.mark.parametrize("name", STRONG)
def test_one_strong_effect_is_selected_and_nothing_else(name):
    evaluator = small.split(small.made(small.effect(name, **STRONG[name]), seed=4))
    named, steps = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert named.hypothesis.names == (name,)
    assert passes_heldout_test(steps[0].held_out_gain)
    assert named.noise.sigma[0] == pytest.approx(0.2, rel=0.2)
    assert estimate_noise(named).ar[0] == pytest.approx(0.0, abs=0.2)


def test_the_noise_is_that_of_the_shape_that_is_freed():
    """What a drift of another form leaves is no noise, and no other effect either."""
    drift = small.effect("sensor_drift", "warming", drift=4.0)
    evaluator = small.split(small.made(drift, noise=0.05, seed=4))
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert named.hypothesis == Hypothesis(("sensor_drift",), ("sensor_drift.warming",))
    assert named.noise.sigma[0] == pytest.approx(0.05, rel=0.2)
    assert named.noise.sigma[0] == pytest.approx(estimate_noise(named).sigma[0], rel=0.05)


def test_a_little_of_what_every_rig_has_is_compared_with_but_not_named():
    """A little circuit before a high resistance explains much; gas with inertia looks like it."""
    turbulent = small.effect("turbulent_resistance", quadratic=10.0)
    little = small.effect("circuit_compliance", compliance=0.15)
    rig = Base(50.0, 19.5)
    evaluator = small.split(small.made(turbulent, little, base=rig, noise=0.1, seed=3))
    selected, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert selected.names == ("turbulent_resistance", "circuit_compliance")
    named, gains, _ = _supported(evaluator, selected, None)
    assert named.names == tuple(gains) == ("turbulent_resistance",)


def test_shapes_of_earlier_terms_are_freed_once_others_are_known():
    drift = small.effect("sensor_drift", "warming", drift=4.0)
    lag = small.effect("sensor_lag", tau=0.1)
    evaluator = small.split(small.made(drift, lag, noise=0.05, seed=4))
    both = fit_with_noise(evaluator, Hypothesis(("sensor_drift", "sensor_lag")))
    freed = _free_earlier_shapes(evaluator, both)
    assert freed is not None
    assert freed.hypothesis.free == ("sensor_drift.warming",)
    assert freed.noise.sigma[0] == pytest.approx(0.05, rel=0.2)
    assert _free_earlier_shapes(evaluator, freed) is None


def test_a_search_can_be_ended_before_terms_are_exchanged():
    two = (
        small.effect("turbulent_resistance", quadratic=10.0), small.effect("sensor_lag", tau=0.12)
    )  # fmt: skip
    evaluator = small.split(small.made(*two))
    asked = []

    def interrupt(selected: FittedModel) -> bool:
        asked.append(selected)
        return True

    start = fit_with_noise(evaluator, Hypothesis())
    selected, _ = forward_selection(evaluator, start, quiet, interrupt=interrupt)
    assert asked == [selected]
    assert set(selected.names) == {"turbulent_resistance", "sensor_lag"}


@pytest.mark.slow  # every refit has each breath's own effort
def test_strong_efforts_are_selected_and_nothing_else():
    effect = small.effect("patient_effort", amplitude=5.0, duration=0.8)
    evaluator = small.split(small.made(effect, seed=4))
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert named.hypothesis.names == ("patient_effort",)


def test_two_strong_effects_are_both_selected():
    two = (
        small.effect("turbulent_resistance", quadratic=10.0), small.effect("sensor_lag", tau=0.12)
    )  # fmt: skip
    evaluator = small.split(small.made(*two))
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert set(named.hypothesis.names) == {"turbulent_resistance", "sensor_lag"}


@pytest.mark.parametrize("coloured", [0.0, 0.6])
@pytest.mark.parametrize("seed", [10, 11, 12])
def test_nothing_is_selected_in_noise(coloured, seed):
    recording = small.made(coloured=coloured, correlation=0.8, seed=seed)
    evaluator = small.split(recording)
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert named.hypothesis.names == ()


def test_a_term_that_another_replaces_is_dropped():
    evaluator = small.split(small.made(small.effect("sensor_lag", tau=0.12)))
    noise = Noise((0.2,), (0.0,))
    both = evaluator.fit(Hypothesis(("sensor_drift", "sensor_lag")), noise)
    assert drop_redundant_terms(evaluator, both).hypothesis.names == ("sensor_lag",)
    kept = evaluator.fit(Hypothesis(("sensor_lag", "sensor_drift")), noise)
    # Only terms before the newest are tested.
    assert drop_redundant_terms(evaluator, kept).hypothesis.names == ("sensor_lag", "sensor_drift")


def test_one_mechanism_takes_the_place_of_two_that_imitate_it():
    effect = small.effect("supply_droop", drop=0.3, recovery=0.8)
    evaluator = small.split(small.made(effect, noise=0.1, seed=3))
    two = fit_with_noise(evaluator, Hypothesis(("supply_pressure", "valve_curve")))
    instead = replace_pair(evaluator, two)
    assert instead is not None
    assert instead.names == ("supply_droop",)


def test_a_single_mechanism_has_no_pair_to_replace(turbulent, both):
    assert replace_pair(turbulent, both[0]) is None


@pytest.mark.slow  # seconds a pair: all twos of the rivals
def test_two_mechanisms_take_the_place_of_two_that_imitate_them():
    acting = (
        small.effect("circuit_compliance", compliance=3.0),
        small.effect("exhalation_valve_delay", "slow opening", opening=0.09),
    )
    evaluator = small.split(small.strange(*acting, noise=0.2, seed=3))
    wrong = Hypothesis(("sensor_lag", "inertance"), ("sensor_lag.second",))
    instead = replace_pair(evaluator, fit_with_noise(evaluator, wrong))
    assert instead is not None
    assert set(instead.names) == {"circuit_compliance", "exhalation_valve_delay"}


def test_a_term_too_small_to_be_named_gives_way_to_one_that_explains_as_much(turbulent, both):
    """The second candidate is taken where the first is negligible, if it is as good."""
    named, without = both
    tiny = turbulent.fit(Hypothesis(("sensor_drift",)), named.noise, without)
    level = turbulent.criterion(named)
    ranked = (RankedModel("sensor_drift", tiny, level - 1.0),
              RankedModel("turbulent_resistance", named, level))  # fmt: skip
    gains = turbulent.held_out_log_likelihood(named) - turbulent.held_out_log_likelihood(without)
    taken = forward._accepted(turbulent, Comparison(without, ranked, gains))
    assert taken is not None
    assert taken.names == ("turbulent_resistance",)


@pytest.mark.slow  # four rounds and the exchanges, 20 s
def test_a_small_term_that_hides_others_is_compared_with_and_not_named():
    """A few hundredths of a millilitre before 50 cmH2O/(L/s), and a bent valve behind a delay."""
    acting = (
        small.effect("valve_delay", delay=0.0625),
        small.effect("valve_curve", "rational saturation", loss=0.43),
    )
    breaths = small.strange(
        *acting, noise=0.15, seed=5, dead_space=0.05,
        base=dataclasses.replace(small.RIG, R=52.8, C=9.5, gain=22.8), proportional=1.3,
    )  # fmt: skip
    evaluator = small.split(breaths)
    selected, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert set(selected.names) == {"valve_delay", "valve_curve", "circuit_compliance"}
    named, _, _ = _supported(evaluator, selected, None)
    assert set(named.names) == {"valve_delay", "valve_curve"}


def test_an_effort_that_all_breaths_have_is_not_taken_for_compliance():
    """R and C of the base model make up for the efforts' mean; fits start at the label too."""
    effect = small.effect("patient_effort", "half sine", amplitude=2.5, duration=0.9)
    evaluator = small.split(small.strange(effect, noise=0.1, seed=7))
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
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
        *acting, noise=0.2, seed=3,
        base=dataclasses.replace(small.RIG, R=51.3, C=9.8, gain=22.8),
    )  # fmt: skip
    labelled = dataclasses.replace(breaths, R=50.0 + 0.0 * breaths.R, C=10.0 + 0.0 * breaths.C)
    evaluator = small.split(labelled)
    refitted = fit_with_noise(evaluator, Hypothesis())
    assert refitted.column("R")[0] < 2.0
    assert is_far_from_label(evaluator, refitted)
    better = selection_at_label(evaluator, refitted, quiet, lambda _: None)
    assert better is not None
    named, _ = better
    assert set(named.names) == {"sensor_lag", "valve_delay"}
    assert named.column("R")[0] == pytest.approx(51.3, rel=0.1)
    assert "R" not in dict(named.hypothesis.fixed)
    assert not is_far_from_label(evaluator, named)


@pytest.mark.parametrize(("name", "goes_on"), [("leak", False), ("turbulent_resistance", True)])
def test_the_search_at_the_label_is_left_where_more_terms_do_no_better(
    turbulent, both, monkeypatch, name, goes_on
):
    searches = []

    def search(evaluator, start, *rest, max_terms=None):
        searches.append(max_terms)
        return evaluator.fit(start.hypothesis.plus(Hypothesis((name,))), start.noise, start), []

    monkeypatch.setattr(forward, "forward_selection", search)
    selected = both[0] if name == "leak" else both[1]
    limits = dataclasses.replace(turbulent.settings.forward, more_at_label=1 - len(selected.names))
    settings = dataclasses.replace(turbulent.settings, forward=limits)
    evaluator = dataclasses.replace(turbulent, settings=settings)
    better = selection_at_label(evaluator, selected, quiet, lambda _: None)
    assert searches == ([1, None] if goes_on else [1])
    assert (better is not None) == goes_on


def test_only_one_label_can_be_held(turbulent, both):
    label = turbulent.at_label
    assert label is not None
    assert dict(label.fixed) == {"R": 20.0, "C": 20.0}
    data = turbulent.training.data
    mixed = dataclasses.replace(data, R=np.where(np.arange(len(data)) < 2, 5.0, data.R))
    partition = dataclasses.replace(turbulent.training, data=mixed)
    several = dataclasses.replace(turbulent, training=partition)
    assert several.at_label is None
    assert not is_far_from_label(several, both[0])
