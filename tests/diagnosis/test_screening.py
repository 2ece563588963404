"""First-order ranking of mechanisms and of nonparametric terms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.selection.candidate_comparison import (
    compare_candidates,
    fit_with_noise,
    fit_with_white_noise,
)
from ventbench.diagnosis.selection.screening import (
    all_parameter_paths,
    component_of,
    score_nonparametric_terms,
    screen_mechanisms,
)
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.physics import library, parameter
from ventbench.physics.catalogue import basis_terms, intermittent
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.system_id import Noise

from . import small

#: Without tails, so that sums of squares are all there is.
NOISE = Noise((0.2,), (0.0,), np.inf)


def test_every_basis_term_belongs_to_a_component():
    for name in basis_terms():
        assert name in NONPARAMETRIC_COMPONENTS[component_of(name)].terms
    assert component_of("sensor_memory") == component_of("drift_shape") == "measurement"


def test_all_parameter_paths_are_those_of_the_library_of_events_and_of_all_terms():
    found = all_parameter_paths(SelectionConfig())
    owners = {path.rpartition(".")[0] for path in found} - {""}
    assert owners == {*library(), *basis_terms(), *intermittent()}
    assert len(set(found)) == len(found)


def scanned(*effects, seed=0, **changed):
    evaluator = small.split_wide(small.made(*effects, seed=seed, **changed))
    base = fit_with_noise(evaluator, Hypothesis())
    return evaluator, base, score_nonparametric_terms(base, small.SETTINGS)


@pytest.mark.parametrize("change", [0.65, -0.65])
def test_resistance_that_depends_on_volume_is_ranked_first(change):
    effect = small.effect("volume_resistance", "R(V)", change=change)
    _, base, found = scanned(effect)
    assert {candidate.name for candidate in found} == set(small.FEW)
    assert found[0].name == "volume_resistance"
    assert found[0].promise > 20.0
    best = [candidate.promise for candidate in found]
    assert best == sorted(best, reverse=True)
    assert all(candidate.hypothesis == Hypothesis((candidate.name,)) for candidate in found)
    again = dataclasses.replace(base, hypothesis=Hypothesis((found[0].name,)))
    assert {
        candidate.name for candidate in score_nonparametric_terms(again, small.SETTINGS)
    } == set(small.FEW) - {found[0].name}


def test_no_term_is_promising_where_nothing_is_missing():
    *_, found = scanned(seed=3)
    # A term has up to ten coefficients, each worth half a nat by chance.
    assert max(candidate.promise for candidate in found) < 10.0


def test_the_expected_gain_is_what_a_refit_gains():
    effect = small.effect("turbulent_resistance", quadratic=1.0)
    evaluator = small.split_wide(small.made(effect))
    base = evaluator.fit(Hypothesis(), NOISE, tolerance=1e-4, iterations=30)
    found = {
        candidate.name: candidate.nats
        for candidate in score_nonparametric_terms(base, small.SETTINGS)
    }
    assert max(found, key=lambda name: found[name]) == "flow_shape"
    refitted = evaluator.fit(
        Hypothesis(("flow_shape",)), NOISE, base, iterations=30, tolerance=1e-4
    )
    # The cost contains the prior of the coefficients, as the expected gain does.
    fallen = base.minimum.cost - refitted.minimum.cost
    assert fallen > 5.0
    assert found["flow_shape"] == pytest.approx(fallen, rel=0.15)
    first = next(path for path in refitted.problem.unknowns.paths if path.startswith("flow_shape"))
    assert np.ptp(refitted.column(first)) == 0.0
    assert refitted.column(first)[0] != parameter(first).neutral


#: Mild effects.
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


@pytest.mark.parametrize("name", MILD)
def test_screening_ranks_a_mild_effect_among_the_first(name):
    evaluator = small.split(small.made(small.effect(name, **MILD[name]), seed=3))
    base = fit_with_noise(evaluator, Hypothesis())
    found = screen_mechanisms(base, fit_with_white_noise(evaluator, base))
    assert {candidate.name for candidate in found} == set(library())
    place = [candidate.name for candidate in found].index(name)
    assert place < 5, [candidate.name for candidate in found]
    candidate = found[place]
    assert candidate.promise > 10.0
    assert candidate.hypothesis.names == (name,)
    for path, value in candidate.start.items():
        item = parameter(path)
        assert item.low <= value <= item.high


def test_a_threshold_starts_where_it_was_simulated_too():
    """A seat that lets go at 3.3 % is no multiple of one that lets go at 0.7 %."""
    stuck = small.effect("valve_dead_band", "cracking", width=3.3)
    evaluator = small.split(small.strange(stuck, seed=5))
    base = fit_with_noise(evaluator, Hypothesis())
    white = fit_with_white_noise(evaluator, base)
    (band,) = screen_mechanisms(base, white, ("valve_dead_band",))
    assert band.hypothesis.free == ("valve_dead_band.crack",)
    starts = [start["valve_dead_band.width"] for start in (band.start, *band.other_starts)]
    assert 3.5 in starts
    comparison = compare_candidates(evaluator, base, [band])
    assert comparison is not None
    fitted = comparison.ranked[0].fitted
    assert fitted.column("valve_dead_band.width")[0] == pytest.approx(3.3, abs=0.15)
    assert fitted.column("valve_dead_band.crack")[0] > 0.8


def test_screening_ranks_only_the_allowed_mechanisms_that_are_missing(plain):
    named = plain.evaluator.fit(Hypothesis(("leak",)), plain.base.noise, plain.base, iterations=1)
    assert "leak" not in {
        candidate.name
        for candidate in screen_mechanisms(named, fit_with_white_noise(plain.evaluator, named))
    }
    some = screen_mechanisms(
        plain.base,
        fit_with_white_noise(plain.evaluator, plain.base),
        ("leak", "inertance"),
    )
    assert {candidate.name for candidate in some} == {"leak", "inertance"}
