"""From a recording to mechanisms, an unnamed effect, or neither."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from ventbench.diagnosis import evidence
from ventbench.diagnosis.estimates import nonparametric_term, split_form
from ventbench.diagnosis.findings import NonparametricTerm
from ventbench.diagnosis.in_time import ALVEOLUS, SUPPLY
from ventbench.recordings import join

from . import small

INSPIRED = 30


def test_nothing_is_missing():
    found = small.concluded(small.made(seed=1))
    assert found.names == ()
    assert found.unnamed is None
    assert not found.unresolved
    assert found.full is found.named
    assert (found.held_out_gains, found.alternatives, found.gain_sd) == ({}, {}, 0.0)
    assert found.noise.sigma[0] == pytest.approx(0.2, rel=0.15)
    assert nonparametric_term(found) is None


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
    found = small.concluded(small.made(small.effect("turbulent_resistance", quadratic=10.0)))
    assert found.names == ("turbulent_resistance",)
    assert found.unnamed is None
    assert found.held_out_gains["turbulent_resistance"] > 50.0
    assert set(found.alternatives) == {"turbulent_resistance"}
    # The noise is what the mechanism leaves, not what the base model leaves.
    assert found.noise.sigma[0] == pytest.approx(0.2, rel=0.15)
    assert found.base.hypothesis.names == ()


@pytest.mark.slow
def test_a_mechanism_stands_beside_an_unnamed_effect():
    beats = small.effect("pulsating_supply", "oscillation", amplitude=0.175, frequency=5.0)
    name = small.effect("turbulent_resistance", quadratic=10.0)
    found = small.concluded(small.made(beats, name, noise=0.1))
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
    found = small.concluded(join(rows))
    assert found.names == ()
    assert found.unnamed is None
    assert 0.03 < found.gain_sd < 0.2
    assert found.noise.sigma[0] == pytest.approx(0.2, rel=0.2)


@pytest.mark.slow
def test_resistance_that_depends_on_volume_is_an_unnamed_effect_among_all_terms():
    found = small.concluded(
        small.made(small.effect("volume_resistance", "R(V)", change=0.65)), small.ALL_TERMS
    )
    assert found.names == ()
    assert found.unnamed is not None
    assert (found.unnamed.name, found.unnamed.term) == ("R(V)", "volume_resistance")
    assert found.unnamed.swing is None
    assert found.unnamed.nats > 20.0
    assert found.full.hypothesis.names == ("volume_resistance",)
    shown = nonparametric_term(found)
    assert shown is not None
    assert shown.name == "R(V)"
    assert 0.5 < shown.explains <= 1.0
    assert shown.x_unit.endswith("mL")
    # The rig's resistance grows with volume; what R could absorb is taken out.
    assert np.polyfit(shown.x, shown.y, 1)[0] * np.ptp(shown.x) > 3.0


@pytest.mark.slow
def test_a_beating_heart_is_at_the_alveolus():
    beats = small.effect("cardiogenic", "oscillation", amplitude=1.3, frequency=1.4)
    found = small.concluded(small.made(beats))
    assert found.names == ()
    assert found.unnamed is not None
    assert (found.unnamed.name, found.unnamed.term) == (ALVEOLUS, None)
    swing = found.unnamed.swing
    assert swing is not None
    assert swing.frequency == pytest.approx(1.4, abs=0.2)
    assert 0.0 < swing.frequency_sd < 0.2
    size = float(np.sqrt(np.mean(swing.course[:, :INSPIRED] ** 2)))
    assert size == pytest.approx(1.3 / np.sqrt(2), rel=0.3)
    assert swing.noise.sigma[0] == pytest.approx(0.2, rel=0.4)
    assert found.unnamed.nats > 20.0
    assert found.full is found.named
    shown = nonparametric_term(found)
    assert shown is not None
    assert "1.4 times a second" in shown.meaning
    assert shown.explains > 0.5
    assert np.ptp(shown.y) == pytest.approx(2.6, rel=0.4)


@pytest.mark.slow
def test_resistance_that_depends_on_direction_is_found_among_all_terms():
    effect = small.effect("direction_resistance", "R(direction)", ratio=2.0)
    found = small.concluded(small.made(effect, samples=60), small.ALL_TERMS)
    assert found.names == ()
    assert found.unnamed is not None
    assert found.unnamed.name == "R(direction)"


@pytest.mark.slow
def test_a_mechanism_is_enough_among_all_terms():
    effect = small.effect("viscoelasticity", ratio=0.7, time=1.0)
    found = small.concluded(small.made(effect), small.ALL_TERMS)
    assert found.names == ("viscoelasticity",)
    assert found.unnamed is None


def test_nothing_is_missing_among_all_terms():
    found = small.concluded(small.made(seed=1), small.ALL_TERMS)
    assert found.names == ()
    assert found.unnamed is None


def test_what_no_sensor_leaves_is_searched_again_from_all_of_a_ventilator(monkeypatch):
    searched, search = [], evidence.search

    def spy(evaluator, also=()):
        searched.append((evaluator.white, tuple(also)))
        return search(evaluator, also)

    monkeypatch.setattr(evidence, "search", spy)
    breaths = small.made(seed=1)
    small.concluded(breaths)
    assert searched == [(False, ())]
    # An error that lasts for twenty readings: nothing of a ventilator, so the first answer stands.
    shocks = np.random.default_rng(2).normal(0.0, 0.3, breaths.pressure.shape)
    slow = lfilter([1.0], [1.0, -0.95], shocks, axis=1)
    found = small.concluded(dataclasses.replace(breaths, pressure=breaths.pressure + slow))
    assert searched[1:] == [(False, ()), (True, small.SETTINGS.search.ventilator)]
    assert found.names == ()
    assert not found.white
