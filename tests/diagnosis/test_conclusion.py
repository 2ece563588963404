"""From a recording to mechanisms, an unnamed effect, or neither."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis import conclusion
from ventbench.diagnosis.conclusion import (
    _better_selection,
    conclude,
    is_unresolved,
)
from ventbench.diagnosis.estimates import nonparametric_term, split_form
from ventbench.diagnosis.findings import NonparametricTerm
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.latent_inputs import ALVEOLUS, SUPPLY
from ventbench.diagnosis.selection.candidate_comparison import fit_with_noise
from ventbench.diagnosis.selection.forward import drop_redundant_terms
from ventbench.recordings import join

from . import small


def concluded(breaths, settings=small.SETTINGS):
    told: list[str] = []
    found = conclude(
        small.split(breaths, settings), lambda: small.split_wide(breaths, settings), told.append
    )
    assert told
    return found


def test_nothing_is_missing():
    found = concluded(small.made(seed=1))
    assert found.names == ()
    assert found.unnamed is None
    assert not found.unresolved
    assert found.full is found.named
    assert (found.held_out_gains, found.alternatives, found.gain_sd) == ({}, {}, 0.0)
    assert found.noise.sigma[0] == pytest.approx(0.2, rel=0.15)
    assert nonparametric_term(found) is None


def test_mechanisms_selected_with_one_gain_are_started_from_where_gains_scatter(turbulent, both):
    scattered = dataclasses.replace(turbulent, gain_sd=0.05)
    named, without = both
    idle = turbulent.fit(Hypothesis(("leak", "turbulent_resistance")), named.noise, named)
    start = fit_with_noise(scattered, idle.hypothesis, idle)
    needed = drop_redundant_terms(scattered, start, start.names)
    assert needed.names == ("turbulent_resistance",)
    assert set(needed.problem.unknowns.paths) >= {"gain"}
    usual = (scattered.fit(Hypothesis(), without.noise), [])
    assert _better_selection(scattered, usual, (needed, []))[0] is needed
    assert _better_selection(scattered, (needed, []), usual)[0] is needed


def compared(gains: dict[str, tuple[float, float]]) -> tuple[Any, list[Any]]:
    """An evaluator and a comparison of mechanisms by their training and held-out gains, nats."""

    def model(training: float, held_out: float) -> SimpleNamespace:
        return SimpleNamespace(criterion=-training, held_out=np.full(4, held_out / 4))

    evaluator = SimpleNamespace(
        criterion=lambda fitted: fitted.criterion,
        held_out_log_likelihood=lambda fitted: fitted.held_out,
        settings=small.SETTINGS,
    )
    ranked = [
        SimpleNamespace(name=name, fitted=model(*gain), criterion=-gain[0])
        for name, gain in gains.items()
    ]
    return evaluator, [SimpleNamespace(base=model(0.0, 0.0), ranked=ranked)]


@pytest.mark.parametrize(
    ("nats", "hidden"),
    [
        ({"valve_curve": (500.0, 40.0)}, True),
        ({"valve_curve": (500.0, -40.0)}, False),  # held-out breaths are against it
        ({"valve_curve": (50.0, 40.0)}, False),  # little is missing
        ({"patient_effort": (2500.0, 500.0)}, False),  # which coloured noise looks like
        ({"patient_effort": (2500.0, 500.0), "leak": (101.0, 5.0)}, True),
    ],
)
def test_a_candidate_that_explains_much_and_is_rejected_leaves_the_recording_unresolved(
    nats, hidden
):
    assert is_unresolved(*compared(nats)) is hidden


def test_without_a_comparison_nothing_is_unresolved():
    assert not is_unresolved(compared({})[0], [])


@pytest.mark.parametrize(
    ("place", "names", "form_of"),
    [
        ("f(u)", ("valve_curve", "leak"), ("valve_curve",)),
        ("f(u)", ("leak",), ()),  # another place: a further effect
        ("memory of u", ("valve_delay", "valve_lag"), ("valve_delay", "valve_lag")),
        (ALVEOLUS, ("patient_effort",), ()),  # differs from breath to breath
        ("f(V)", (), ()),
    ],
)
def test_a_term_that_contains_a_named_mechanism_is_its_form(place, names, form_of):
    curve = np.zeros(3)
    term = NonparametricTerm(place, "meaning", 0.5, 30.0, curve, "%", curve, "mL/s")
    form, other = split_form(term, names)
    if form_of:
        assert other is None
        assert form is not None
        assert form.form_of == form_of
    else:
        assert form is None
        assert other is term
    assert split_form(None, names) == (None, None)


def test_a_mechanism_is_enough():
    found = concluded(small.made(small.effect("turbulent_resistance", quadratic=10.0)))
    assert found.names == ("turbulent_resistance",)
    assert found.unnamed is None
    assert found.held_out_gains["turbulent_resistance"] > 50.0
    assert set(found.alternatives) == {"turbulent_resistance"}
    # The noise is what the mechanism leaves, not what the base model leaves.
    assert found.noise.sigma[0] == pytest.approx(0.2, rel=0.15)
    assert found.base.hypothesis.names == ()


@pytest.mark.slow
def test_resistance_that_depends_on_volume_is_an_unnamed_effect():
    found = concluded(small.made(small.effect("volume_resistance", "R(V)", change=0.65)))
    assert found.names == ()
    assert found.unnamed is not None
    assert (found.unnamed.name, found.unnamed.term) == ("R(V)", "volume_resistance")
    assert found.unnamed.latent_input is None
    assert found.unnamed.nats > 20.0
    assert found.full.hypothesis.names == ("volume_resistance",)
    shown = nonparametric_term(found)
    assert shown is not None
    assert shown.name == "R(V)"
    assert 0.5 < shown.explains <= 1.0
    assert shown.x_unit.endswith("mL")
    # The rig's resistance grows with volume; what R could absorb is taken out.
    assert np.polyfit(shown.x, shown.y, 1)[0] * np.ptp(shown.x) > 3.0


@pytest.mark.slow  # many refits
def test_a_beating_heart_is_at_the_alveolus():
    beats = small.effect("cardiogenic", "oscillation", amplitude=1.3, frequency=1.4)
    found = concluded(small.made(beats))
    assert found.names == ()
    assert found.unnamed is not None
    assert (found.unnamed.name, found.unnamed.term) == (ALVEOLUS, None)
    assert found.unnamed.latent_input is not None
    assert found.unnamed.latent_input.scale == pytest.approx(1.4, abs=0.2)
    assert found.unnamed.nats > 20.0
    assert found.full is found.named
    shown = nonparametric_term(found)
    assert shown is not None
    assert "1.4 times a second" in shown.meaning
    assert shown.explains > 0.5
    assert np.ptp(shown.y) == pytest.approx(2.6, rel=0.4)


def test_a_mechanism_stands_beside_an_unnamed_effect():
    beats = small.effect("pulsating_supply", "oscillation", amplitude=0.175, frequency=5.0)
    name = small.effect("turbulent_resistance", quadratic=10.0)
    found = concluded(small.made(beats, name, noise=0.1))
    assert found.names == ("turbulent_resistance",)
    assert found.unnamed is not None
    assert found.unnamed.name == SUPPLY
    shown = nonparametric_term(found)
    assert shown is not None
    assert shown.y_unit.startswith("share of the flow")


@pytest.mark.slow
def test_scatter_of_the_valves_gain_is_no_missing_physics():
    rng = np.random.default_rng(4)
    rows = []
    for i in range(small.BREATHS):
        rig = dataclasses.replace(small.RIG, gain=22.8 * np.exp(0.08 * rng.standard_normal()))
        rows.append(small.numbered(small.made(seed=100 + i, base=rig, breaths=1), i + 1))
    found = concluded(join(rows))
    assert found.names == ()
    assert found.unnamed is None
    assert 0.03 < found.gain_sd < 0.2
    assert found.noise.sigma[0] == pytest.approx(0.2, rel=0.2)


@pytest.mark.slow  # all terms take minutes to compile
@pytest.mark.parametrize(
    ("name", "form", "parameters", "place"),
    [
        ("volume_resistance", "R(V)", {"change": 0.65}, "R(V)"),
        ("cardiogenic", "oscillation", {"amplitude": 1.3, "frequency": 1.4}, ALVEOLUS),
        ("direction_resistance", "R(direction)", {"ratio": 2.0}, "R(direction)"),
    ],
)
def test_unnamed_effects_are_found_among_all_terms(name, form, parameters, place):
    breaths = small.made(small.effect(name, form, **parameters), samples=60)
    found = concluded(breaths, small.ALL_TERMS)
    assert found.names == ()
    assert found.unnamed is not None
    assert found.unnamed.name == place


@pytest.mark.slow  # all terms take minutes to compile
def test_a_mechanism_or_nothing_is_enough_among_all_terms():
    named = concluded(
        small.made(small.effect("viscoelasticity", ratio=0.7, time=1.0)), small.ALL_TERMS
    )
    assert named.names == ("viscoelasticity",)
    assert named.unnamed is None
    nothing = concluded(small.made(seed=1), small.ALL_TERMS)
    assert nothing.names == ()
    assert nothing.unnamed is None


@pytest.mark.parametrize(("sd", "early"), [(0.02, True), (0.2, False), (0.0, False)])
def test_gains_that_scatter_as_those_of_one_valve_do_end_the_first_search(sd, early, monkeypatch):
    """More may be several rigs, or a name that is not right yet."""
    monkeypatch.setattr(conclusion, "gain_scatter", lambda evaluator, selected: sd)
    selected: Any = None
    scatter = conclusion._GainScatter(SimpleNamespace(gain_sd=0.0, settings=small.SETTINGS))  # type: ignore[arg-type]
    assert scatter(selected) is early
    assert scatter.sd == (sd if early else 0.0)
    found = conclusion._GainScatter(SimpleNamespace(gain_sd=0.05, settings=small.SETTINGS))  # type: ignore[arg-type]
    assert not found(selected)  # each breath has its gain already
