"""The sentences of a diagnosis."""

from __future__ import annotations

import dataclasses

import pytest

from ventbench.diagnosis import words
from ventbench.diagnosis.quantity import probability, quantity
from ventbench.diagnosis.result import Distance, Estimate, Named, Place
from ventbench.physics import library, parameter

from . import made

NAN = float("nan")


@pytest.mark.parametrize(
    ("estimate", "path", "text"),
    [
        (Estimate(0.0412, "s", (0.0381, 0.0443)), "valve_delay.delay", "41 ms [38, 44]"),
        (Estimate(1.234, "s", (1.0, 1.5)), "viscoelasticity.time", "1.2 s [1.0, 1.5]"),
        (Estimate(0.213, "1", (0.184, 0.243)), "valve_curve.loss", "21 % [18, 24]"),
        (Estimate(0.213, "1", (0.184, 0.243)), "viscoelasticity.ratio", "0.21 [0.18, 0.24]"),
        (Estimate(8.21, "mL/s", (7.5, 8.9)), "leak.conductance", "8.2 mL/s [7.5, 8.9]"),
        (Estimate(-1e-4, "cmH2O", (-0.4, 0.4)), "", "0.0 cmH2O [-0.4, 0.4]"),
        (Estimate(22.1, "cmH2O s/L", (NAN, NAN)), "", "22.1 cmH2O s/L"),
        (Estimate(NAN, "s", (NAN, NAN)), "", "unknown s"),
    ],
)
def test_quantities(estimate, path, text):
    assert quantity(estimate, path) == text


def test_every_mechanism_has_a_sentence():
    """Each with all its parameters, in words, units and intervals."""
    for name, item in library().items():
        known = item.description.parameters
        values = {p.name: Estimate(p.strong, p.unit, (p.mild, p.high)) for p in known}
        text = words.named(Named(name, values, 0.8, (), 10.0))
        assert item.description.title in text
        assert text.count("[") == len(known)
        assert text.endswith("Confidence in the name: 80 %.")
        for p in known[1:]:
            assert p.meaning in text
    assert parameter("valve_delay.delay").meaning == "dead time"


def test_a_named_mechanism():
    found = made.diagnosis(12)
    said = words.sentences(found)
    assert said[0] == (
        "Missing in the physics simulator: dead time of the inspiratory valve (valve_delay)."
    )
    assert said[1].startswith(
        "The recording needs 41 ms [38, 44] of dead time of the inspiratory valve."
    )
    assert "This recording cannot tell valve_delay from valve_lag." in said
    assert any(
        text.startswith("The lung is not what its label R20C50 says: the recording fits R 22.1")
        for text in said
    )
    assert any(
        text.startswith("Record next: 3 breaths of random pulses of the valve. That tells "
        "valve_delay and valve_lag apart")
        for text in said
    )  # fmt: skip
    assert said[-1] == found.notes[0]
    changed = dataclasses.replace(found.mechanisms[0], changed=True)
    assert "needs another: dead time of the inspiratory valve: 41 ms" in words.named(changed)
    both = dataclasses.replace(changed, had={"delay": 0.0123})
    assert "inspiratory valve: 41 ms [38, 44] instead of 12 ms" in words.named(both)


def test_the_effect_of_what_is_missing():
    found = made.diagnosis(12)
    start = Place("time since inspiration", 0.0, 0.2, "s", -2.13, 0.001, 0.6)
    other = Place("volume", 0.0, 50.0, "mL", 1.0, 0.001, 0.9)
    one = dataclasses.replace(found, location=(other, start))
    assert words.effect(one) == (
        "Without it the simulated pressure is 2.1 cmH2O too high in the first 0.2 s of each "
        "breath, even with R and C refitted."
    )
    two = dataclasses.replace(one, mechanisms=one.mechanisms * 2)
    assert words.effect(two).startswith("Without them ")
    assert words.effect(dataclasses.replace(found, location=())) == ""


def test_a_simulator_that_is_left_as_it_is_was_not_refitted():
    found = made.unnamed(12)
    assert words.effect(found).startswith("With R and C refitted, ")
    loop = found.open_loop
    same = dataclasses.replace(loop, refit=loop.before, after=loop.before)
    left = dataclasses.replace(found, open_loop=same, slot=None)
    assert words.effect(left).startswith("The simulated pressure is ")
    assert f"{loop.before.rmse:.2f} as given, noise" in words.distances(left)
    nothing = dataclasses.replace(left, verdict="nothing_missing")
    assert words.verdict(nothing) == (
        "Nothing is missing: the physics simulator explains the recording."
    )


@pytest.mark.parametrize(
    ("place", "text"),
    [
        (("time since inspiration", 0.3, 0.5, "s"), "from 0.3 to 0.5 s after the start of insp"),
        (("time since expiration", 0.0, 0.1, "s"), "in the first 100 ms of expiration"),
        (("time since a valve edge", 0.035, 0.07, "s"), "from 35 to 70 ms after an edge of a"),
        (("flow", 800.0, 1200.0, "mL/s"), "where the flow is 800 to 1200 mL/s"),
        (("breath number", 1.0, 12.0, "1"), "in breaths 1 to 12 of the recording"),
        (("lung R5C10", 0.0, 2.5, "s"), "on lung R5C10"),
    ],
)
def test_places(place, text):
    axis, low, high, unit = place
    sentence = words.location(Place(axis, low, high, unit, 0.52, 0.01, 0.5), 0.2)
    assert sentence.startswith(f"The simulated pressure is 0.52 cmH2O too low {text}")
    square = words.location(Place(axis, low, high, unit, 0.01, 0.01, 0.5), 0.2)
    assert f"errors whose sign changes from breath to breath {text}" in square


def test_other_verdicts():
    said = words.sentences(made.unnamed(12))
    assert said[0].endswith("no name for; it acts as resistance of the airway, R(V).")
    assert any("83 % of the squared error above the noise" in text for text in said)
    nothing = made.nothing(12)
    said = words.sentences(nothing)
    assert said[0].startswith("Nothing is missing")
    assert not any("corrected" in text for text in said)
    both = dataclasses.replace(made.diagnosis(12), slot=made.unnamed(12).slot)
    assert words.verdict(both).endswith("; something without a name is missing too.")
    assert words.slot(both).startswith("What remains acts as resistance of the airway, R(V)")
    slot = made.unnamed(12).slot
    assert slot is not None
    any_curve = dataclasses.replace(slot, name="f(V)", meaning="f(V): any recoil of the lung")
    text = words.verdict(dataclasses.replace(made.unnamed(12), slot=any_curve))
    assert text.endswith("it acts as a recoil of the lung, f(V).")


def test_distances_and_a_lung_that_matches():
    found = made.diagnosis(12)
    distances = dataclasses.replace(
        found.open_loop,
        before=Distance(1.0, 1.24),
        refit=Distance(0.5, 0.62),
        after=Distance(0.2, 0.22),
        noise_floor=0.21,
        held_out_breaths=tuple(range(20)),
    )
    assert words.distances(dataclasses.replace(found, open_loop=distances)) == (
        "Open-loop error on 20 held-out breaths (root mean square): 1.24 as given, 0.62 refitted, "
        "0.22 corrected, noise 0.21 cmH2O."
    )
    match = dataclasses.replace(found.lungs[0], label_matches=True, source="pressure and flow")
    assert words.lung(match) == (
        "The lung matches its label R20C50: R 22.1 cmH2O s/L [21.8, 22.4] and "
        "C 47.4 mL/cmH2O [47.0, 47.8], from pressure and flow."
    )
    assert probability(0.001) == "p < 0.01"
    assert probability(0.034) == "p = 0.03"
