"""Screening, comparing and adding mechanisms, with a gate on held-out breaths."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.refinement import alternatives
from ventbench.diagnosis.screening import screen_mechanisms
from ventbench.diagnosis.selection import (
    compare_candidates,
    drop_redundant_terms,
    estimate_noise,
    fit_with_noise,
    fit_with_white_noise,
    forward_selection,
    free_shape_parameters,
    passes_heldout_test,
)
from ventbench.diagnosis.settings import GATE
from ventbench.physics import library, parameter
from ventbench.system_id import Noise

from . import small

#: Mild effects, and the ones that are named strong.
MILD = {
    "valve_delay": {"delay": 0.04},
    "valve_dead_band": {"width": 1.5},
    "supply_droop": {"drop": 0.1, "recovery": 1.0},
    "sensor_lag": {"tau": 0.05},
    "sensor_drift": {"drift": 1.2},
    "turbulent_resistance": {"quadratic": 4.0},
    "nonlinear_compliance": {"stiffening": 1 / 40},
    "patient_effort": {"amplitude": 2.0, "duration": 0.8},
}
STRONG = {
    "valve_lag": {"tau": 0.1},
    "viscoelasticity": {"ratio": 0.7, "time": 1.0},
    "command_rounding": {"amount": 1.0},
}


def quiet(what: str) -> None:
    pass


@pytest.mark.parametrize("name", MILD)
def test_screening_ranks_a_mild_effect_among_the_first(name):
    evaluator = small.split(small.made(small.effect(name, **MILD[name]), seed=3))
    null = fit_with_noise(evaluator, Hypothesis())
    found = screen_mechanisms(null, fit_with_white_noise(evaluator, null))
    assert {one.name for one in found} == set(library())
    place = [one.name for one in found].index(name)
    assert place < 5, [one.name for one in found]
    one = found[place]
    assert max(one.nats, one.white) > 10.0
    assert one.hypothesis.names == (name,)
    for path, value in one.start.items():
        item = parameter(path)
        assert item.low <= value <= item.high


def test_screening_leaves_out_what_is_there_and_looks_only_at_what_it_is_told(plain):
    named = plain.evaluator.fit(Hypothesis(("leak",)), plain.null.noise, plain.null, iterations=1)
    assert "leak" not in {
        one.name for one in screen_mechanisms(named, fit_with_white_noise(plain.evaluator, named))
    }
    some = screen_mechanisms(
        plain.null, fit_with_white_noise(plain.evaluator, plain.null), ("leak", "inertance")
    )
    assert {one.name for one in some} == {"leak", "inertance"}


def test_what_cannot_act_is_not_looked_at():
    active = small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))
    without = dataclasses.replace(active, excluded=("turbulent_resistance", "patient_effort"))
    assert set(active.allowed_mechanisms) - set(without.allowed_mechanisms) == set(without.excluded)
    null = fit_with_noise(without, Hypothesis())
    named, steps = forward_selection(without, null, quiet)
    assert not set(named.hypothesis.names) & set(without.excluded)
    assert not {one.name for one in steps[0].rivals} & set(without.excluded)


def test_gate_needs_much_and_from_more_than_one_breath():
    even = np.full(8, 1.0)
    assert passes_heldout_test(even)
    assert not passes_heldout_test(0.9 * GATE / 8 * even)
    assert not passes_heldout_test(-even)
    one = np.zeros(8)
    one[3] = 1000.0
    assert not passes_heldout_test(one)
    assert not passes_heldout_test(one + 0.1)
    assert passes_heldout_test(one + 200.0)
    # Two breaths of another rig do not outvote the others, nor carry them.
    mixed = np.array([20.0, 25.0, 18.0, -150.0, 30.0, 22.0, 24.0, -60.0, 28.0, 26.0, 33.0, 19.0])
    assert passes_heldout_test(mixed)
    carried = np.tile([0.1, -0.2, 0.1, -0.3, 0.2], 4)
    carried[[3, 11]] = 150.0, 60.0
    assert not passes_heldout_test(carried)
    # A total that loses in half of the breaths is scatter.
    mixed = np.array([40.0, -30.0] * 4)
    assert mixed.sum() > GATE
    assert not passes_heldout_test(mixed)


def test_nothing_is_worth_a_look_if_nothing_is_promising(plain):
    found = screen_mechanisms(plain.null, fit_with_white_noise(plain.evaluator, plain.null))
    faint = [one for one in found if max(one.nats, one.white) <= 3.0]
    assert faint
    assert compare_candidates(plain.evaluator, plain.null, faint) is None
    assert compare_candidates(plain.evaluator, plain.null, []) is None


def test_a_step_orders_candidates_at_one_noise():
    evaluator = small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))
    null = fit_with_noise(evaluator, Hypothesis())
    found = compare_candidates(
        evaluator, null, screen_mechanisms(null, fit_with_white_noise(evaluator, null))
    )
    assert found is not None
    assert found.rivals[0].name == "turbulent_resistance"
    criteria = [one.criterion for one in found.rivals]
    assert criteria == sorted(criteria)
    assert len({one.name for one in found.rivals}) == len(found.rivals)
    # The noise is the best one's, and no longer what the effect left in the residual.
    best = found.rivals[0].fitted
    assert best.log_likelihood > best.log_likelihood_at(null.noise) + 20.0
    assert found.before.noise == found.rivals[0].fitted.noise
    assert found.nats == pytest.approx(found.gained.sum())
    assert passes_heldout_test(found.gained)


@pytest.mark.parametrize("name", STRONG)
def test_one_strong_effect_is_named_and_nothing_else(name):
    evaluator = small.split(small.made(small.effect(name, **STRONG[name]), seed=4))
    named, steps = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert named.hypothesis.names == (name,)
    assert passes_heldout_test(steps[0].gained)
    assert named.noise.sigma[0] == pytest.approx(0.2, rel=0.2)
    assert estimate_noise(named).ar[0] == pytest.approx(0.0, abs=0.2)


@pytest.mark.slow  # every refit has each breath's own effort
def test_strong_efforts_are_named_and_nothing_else():
    effect = small.effect("patient_effort", amplitude=5.0, duration=0.8)
    evaluator = small.split(small.made(effect, seed=4))
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert named.hypothesis.names == ("patient_effort",)


@pytest.mark.slow  # many refits
def test_two_strong_effects_are_both_named():
    two = (
        small.effect("turbulent_resistance", quadratic=10.0), small.effect("sensor_lag", tau=0.12)
    )  # fmt: skip
    evaluator = small.split(small.made(*two))
    named, _ = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    assert set(named.hypothesis.names) == {"turbulent_resistance", "sensor_lag"}


@pytest.mark.parametrize("coloured", [0.0, 0.6])
@pytest.mark.parametrize("seed", [10, 11, 12])
def test_nothing_is_named_in_noise(coloured, seed):
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
    # Only those before the newest are asked.
    assert drop_redundant_terms(evaluator, kept).hypothesis.names == ("sensor_lag", "sensor_drift")


@pytest.mark.parametrize("form", ["linear", "library"])
def test_a_shape_is_freed_if_the_recording_asks_for_it(form):
    effect = small.effect("leak", form, conductance=20.0)
    evaluator = small.split(small.made(effect, noise=0.1, seed=5))
    found = free_shape_parameters(
        evaluator, evaluator.fit(Hypothesis(("leak",)), Noise((0.1,), (0.0,)))
    )
    # The library's is an orifice.
    assert found.hypothesis.free == (("leak.exponent",) if form == "linear" else ())
    wanted = 1.0 if form == "linear" else 0.5
    assert found.column("leak.exponent")[0] == pytest.approx(wanted, abs=0.05)


@pytest.mark.parametrize(
    ("effect", "path", "wanted"),
    [
        (small.effect("valve_lag", "two lags", tau=0.1), "valve_lag.second", 0.05),
        (small.effect("valve_hysteresis", "soft play", width=5.0), "valve_hysteresis.give", 1.0),
        (
            small.effect("turbulent_resistance", "exponent 1.75", quadratic=10.0),
            "turbulent_resistance.exponent",
            1.75,
        ),
        (small.effect("sensor_drift", "warming", drift=3.0), "sensor_drift.warming", 3.0),
    ],
)
def test_another_form_is_found_by_the_shape_of_its_name(effect, path, wanted):
    evaluator = small.split(small.made(effect, noise=0.03, seed=5))
    found = free_shape_parameters(evaluator, fit_with_noise(evaluator, Hypothesis((effect.name,))))
    assert found.hypothesis.free == (path,)
    assert found.column(path)[0] == pytest.approx(wanted, rel=0.15)


@pytest.fixture(scope="module")
def alike():
    """A recording from which a lag of the valve and a compliant circuit look the same."""
    effect = small.effect("valve_lag", tau=0.04)
    evaluator = small.split(small.made(effect, noise=0.3, style="pi"))
    return evaluator, *forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)


def test_a_rival_that_is_nearly_as_good_is_listed(alike):
    evaluator, named, steps = alike
    named, other = alternatives(evaluator, named, steps)
    (name,) = named.hypothesis.names
    assert {name, *other[name].names} == {"valve_lag", "circuit_compliance"}
    assert 0.5 <= other[name].confidence < 0.9
    rival = other[name].rivals[0]
    gap = rival.criterion - evaluator.criterion(named)
    assert other[name].confidence == pytest.approx(1.0 / (1.0 + np.exp(-0.5 * gap)))


@pytest.mark.slow  # many refits
def test_a_worse_name_is_swapped_for_the_better_one(alike):
    evaluator, named, _ = alike
    wrong = evaluator.fit(Hypothesis(("viscoelasticity",)), named.noise)
    swapped, other = alternatives(evaluator, wrong, [])
    assert set(swapped.hypothesis.names) <= {"valve_lag", "circuit_compliance"}
    assert evaluator.criterion(swapped) < evaluator.criterion(wrong) - 20.0
    assert set(other) == set(swapped.hypothesis.names)
    kept, _ = alternatives(evaluator, wrong, [], swap=False)
    assert kept.hypothesis.names == ("viscoelasticity",)


def test_an_effect_like_no_other_has_no_alternative():
    evaluator = small.split(small.made(small.effect("viscoelasticity", ratio=0.7, time=1.0)))
    named, steps = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), quiet)
    named, other = alternatives(evaluator, named, steps)
    # But for what pressure alone can never tell from it.
    assert other["viscoelasticity"].names == ("second_compartment",)
    assert other["viscoelasticity"].confidence > 0.99
    assert other["viscoelasticity"].rivals == ()
