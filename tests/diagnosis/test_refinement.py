"""Mechanisms beside nonparametric terms and latent inputs, and their alternatives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.selection import refinement
from ventbench.diagnosis.selection.alternatives import exchange, find_alternatives
from ventbench.diagnosis.selection.candidate_comparison import fit_with_noise
from ventbench.diagnosis.selection.forward import forward_selection
from ventbench.diagnosis.selection.refinement import (
    NonparametricFit,
    SingleTermAlternative,
    drop_compensating_terms,
    special_case_of,
)

from . import small

NAMES = ("turbulent_resistance", "leak")


@pytest.fixture(scope="module")
def named():
    evaluator = small.split(
        small.made(
            small.effect("turbulent_resistance", quadratic=10.0),
            small.effect("leak", conductance=20.0),
        )
    )
    return evaluator, fit_with_noise(evaluator, Hypothesis(NAMES))


@pytest.mark.parametrize(("nats", "kept"), [(1.0, NAMES), (1e9, ())])
def test_an_input_replaces_only_mechanisms_that_explain_less_than_it_does(
    named, monkeypatch, nats, kept
):
    evaluator, fitted = named

    def idle(evaluator, current, here, nats, name):
        return 0.0, evaluator.fit(current.hypothesis.without(name), current.noise, current), here

    monkeypatch.setattr(refinement, "_without_idle", idle)
    latent: Any = SimpleNamespace(place="f(t) at the supply")
    assert refinement.eliminate_beside_input(evaluator, fitted, latent, nats).names == kept


BOTH = Hypothesis(("leak", "viscoelasticity"))


def left(*effects):
    breaths = small.made(*effects, noise=0.1, seed=2)
    evaluator, wide = small.split(breaths), small.split_wide(breaths)
    said: list[str] = []
    named = drop_compensating_terms(evaluator, wide, fit_with_noise(evaluator, BOTH), said.append)
    assert said
    return named


@pytest.mark.slow
def test_a_mechanism_that_compensates_for_anothers_form_is_dropped():
    """A linear leak is no square root, and a viscoelastic lung compensates for that."""
    named = left(small.effect("leak", "linear", conductance=20.0))
    assert named.hypothesis.names == ("leak",)


def test_two_mechanisms_that_act_both_stay():
    named = left(
        small.effect("leak", conductance=20.0),
        small.effect("viscoelasticity", ratio=0.7, time=1.0),
    )
    assert named.hypothesis.names == BOTH.names


def test_a_single_mechanism_compensates_for_nothing(plain):
    one = plain.evaluator.fit(Hypothesis(("leak",)), plain.base.noise, plain.base, iterations=1)
    said: list[str] = []
    assert drop_compensating_terms(plain.evaluator, plain.evaluator, one, said.append) is one
    assert not said


@pytest.mark.parametrize(
    ("acting", "term", "names"),
    [
        (small.effect("turbulent_resistance", quadratic=10.0), "flow_shape",
         ("turbulent_resistance",)),
        (small.effect("leak", conductance=20.0), "flow_shape", None),
        (small.effect("turbulent_resistance", quadratic=10.0), "volume_resistance", None),
    ],
)  # fmt: skip
def test_what_a_nonparametric_term_stands_for_is_named_if_it_is_most_of_it(acting, term, names):
    breaths = small.made(acting, noise=0.1, seed=2)
    evaluator, wide = small.split(breaths), small.split_wide(breaths)
    base = fit_with_noise(evaluator, Hypothesis())
    full = fit_with_noise(wide, Hypothesis((term,)), wide.fit(Hypothesis(), base.noise, base))
    named = special_case_of(evaluator, base, NonparametricFit(term, full, 100.0))
    assert (named and named.names) == names


def test_what_a_term_stands_for_is_named_where_no_mechanism_looks_promising(monkeypatch):
    """As a lag of the valve where R is large: what was fitted without it makes up for it."""
    breaths = small.made(small.effect("turbulent_resistance", quadratic=10.0), noise=0.1, seed=2)
    evaluator, wide = small.split(breaths), small.split_wide(breaths)
    base = fit_with_noise(evaluator, Hypothesis())
    full = fit_with_noise(
        wide, Hypothesis(("flow_shape",)), wide.fit(Hypothesis(), base.noise, base)
    )
    monkeypatch.setattr(refinement, "compare_candidates", lambda *_, **__: None)
    named = special_case_of(evaluator, base, NonparametricFit("flow_shape", full, 100.0))
    assert named is not None
    assert named.column("turbulent_resistance.quadratic")[0] == pytest.approx(10.0, rel=0.2)


SUM = Hypothesis(("turbulent_resistance", "viscoelasticity", "leak"))


def single_term_alternative(breaths):
    evaluator = small.split(breaths)
    base = fit_with_noise(evaluator, Hypothesis())
    return (
        evaluator,
        base,
        SingleTermAlternative(evaluator, lambda: small.split_wide(breaths), base),
    )


def test_mechanisms_that_imitate_a_nonparametric_term_are_replaced():
    effect = small.effect("volume_resistance", "R(V)", change=0.65)
    evaluator, base, replacement = single_term_alternative(small.made(effect, noise=0.1))
    too_few = fit_with_noise(evaluator, Hypothesis(SUM.names[:2]))
    assert replacement(too_few) is None
    assert replacement(fit_with_noise(evaluator, SUM)) is base


def test_mechanisms_that_act_are_not_replaced():
    evaluator, _, replacement = single_term_alternative(
        small.made(
            small.effect("turbulent_resistance", quadratic=10.0),
            small.effect("leak", conductance=20.0),
            small.effect("viscoelasticity", ratio=0.7, time=1.0),
            noise=0.1,
        )
    )
    assert replacement(fit_with_noise(evaluator, SUM)) is None


@pytest.fixture(scope="module")
def alike():
    """A recording from which a lag of the valve and a compliant circuit look the same."""
    effect = small.effect("valve_lag", tau=0.04)
    evaluator = small.split(small.made(effect, noise=0.3, style="pi"))
    return evaluator, *forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), print)


def test_an_alternative_that_is_nearly_as_good_is_listed(alike):
    evaluator, named, steps = alike
    named, other = find_alternatives(evaluator, named, steps)
    (name,) = named.hypothesis.names
    assert {name, *other[name].names} == {"valve_lag", "circuit_compliance"}
    assert 0.5 <= other[name].confidence < 0.9
    rival = other[name].models[0]
    gap = rival.criterion - evaluator.criterion(named)
    assert other[name].confidence == pytest.approx(1.0 / (1.0 + np.exp(-0.5 * gap)))


def test_a_worse_mechanism_is_swapped_for_the_better_one(alike):
    evaluator, named, _ = alike
    wrong = evaluator.fit(Hypothesis(("viscoelasticity",)), named.noise)
    swapped, other = find_alternatives(evaluator, wrong, [])
    assert set(swapped.hypothesis.names) <= {"valve_lag", "circuit_compliance"}
    assert evaluator.criterion(swapped) < evaluator.criterion(wrong) - 20.0
    assert set(other) == set(swapped.hypothesis.names)
    kept, _ = find_alternatives(evaluator, wrong, [], swap=False)
    assert kept.hypothesis.names == ("viscoelasticity",)


def test_an_effect_like_no_other_has_no_near_alternative():
    evaluator = small.split(small.made(small.effect("viscoelasticity", ratio=0.7, time=1.0)))
    named, steps = forward_selection(evaluator, fit_with_noise(evaluator, Hypothesis()), print)
    named, other = find_alternatives(evaluator, named, steps)
    # Pressure alone can never tell it from a second compartment; a leak that opens at a pressure
    # is a hundred times less likely by eight breaths.
    assert "second_compartment" in other["viscoelasticity"].names
    assert set(other["viscoelasticity"].names) <= {"second_compartment", "relief_leak"}
    assert other["viscoelasticity"].confidence > 0.99
    assert {model.name for model in other["viscoelasticity"].models} <= {"relief_leak"}


def test_an_exchange_needs_bic_and_held_out_breaths(alike):
    evaluator, named, _ = alike
    wrong = fit_with_noise(evaluator, Hypothesis(("viscoelasticity",)))
    known: dict = {}
    better = exchange(evaluator, wrong, [], known)
    assert better is not None
    assert set(better.names) <= {"valve_lag", "circuit_compliance"}
    assert list(known) == [(Hypothesis(), "viscoelasticity")], "what was fitted is kept"
    assert exchange(evaluator, named, [], {}) is None, "rivals that tie stay alternatives"
