"""The sentences of a diagnosis."""

from __future__ import annotations

import dataclasses

import pytest

from ventbench.diagnosis import number_text, report_text
from ventbench.diagnosis.findings import Change, ErrorRegion, MissingMechanism, OpenLoopError
from ventbench.diagnosis.number_text import probability, quantity
from ventbench.mechanics.labels import Estimate
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
        (Estimate(22.1, "cmH2O/(L/s)", (NAN, NAN)), "", "22.1 cmH2O/(L/s)"),
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
        text = report_text.missing_mechanism(MissingMechanism(name, values, 0.8, (), 10.0))
        assert item.description.title in text.lower()
        assert text.count("[") == len(known)
        assert text.endswith("held-out evidence 10 nats; posterior probability of 80 %.")
        for p in known[1:]:
            assert p.meaning in text
    assert parameter("valve_delay.delay").meaning == "dead time"


def test_a_named_mechanism():
    found = made.diagnosis(12)
    said = report_text.sentences(found)
    loop = found.open_loop
    assert said[0] == (
        "Missing in the physics simulator: dead time of the inspiratory valve (posterior "
        "probability of 97 %); mending it takes the error on 4 breaths set aside "
        f"from {loop.refit.rmse:.2f} (R and C refitted; {loop.before.rmse:.2f} as given) to "
        f"{loop.after.rmse:.2f} cmH2O, and of the {loop.whole.rmse:.2f} over whole breaths, hardly "
        "more than the noise of 0.20 is left."
    )
    assert said[1].startswith(
        "Dead time of the inspiratory valve (valve_delay): 41 ms [38, 44]; held-out evidence 212"
    )
    assert "This recording cannot tell valve_delay from valve_lag." in said
    assert any(text.startswith("The lung does not match its label R20C50: R 22.1") for text in said)
    assert any(
        text.startswith(
            "Record next: 3 breaths of random pulses of the valve. These breaths "
            "distinguish between valve_delay and valve_lag (expected evidence 64 nats; 4.6 decide)."
        )
        for text in said
    )
    assert said[-1] == found.notes[0]
    changed = dataclasses.replace(found.mechanisms[0], changed=True)
    assert (
        "valve, which the simulator has with another strength (valve_delay): 41 ms [38, 44]; "
        in report_text.missing_mechanism(changed)
    )
    both = dataclasses.replace(changed, simulator_values={"delay": 0.0123})
    assert (
        "inspiratory valve (valve_delay): 41 ms [38, 44] instead of 12 ms in the simulator;"
        in report_text.missing_mechanism(both)
    )


def test_the_effect_of_what_is_missing():
    found = made.diagnosis(12)
    start = ErrorRegion("time since inspiration", 0.0, 0.2, "s", -2.13, 0.001, 0.6)
    other = ErrorRegion("volume", 0.0, 50.0, "mL", 1.0, 0.001, 0.9)
    one = dataclasses.replace(found, location=(other, start))
    assert report_text.effect(one) == (
        "Without it the simulated pressure is 2.1 cmH2O too high in the first 0.2 s of each "
        "breath, even with R and C refitted."
    )
    two = dataclasses.replace(one, mechanisms=one.mechanisms * 2)
    assert report_text.effect(two).startswith("Without them ")
    assert report_text.effect(dataclasses.replace(found, location=())) == ""


def test_a_simulator_that_is_left_as_it_is_was_not_refitted():
    found = made.unnamed(12)
    assert report_text.effect(found).startswith("With R and C refitted, ")
    loop = found.open_loop
    same = dataclasses.replace(loop, refit=loop.before, after=loop.before)
    left = dataclasses.replace(found, open_loop=same, nonparametric=None)
    assert report_text.effect(left).startswith("The simulated pressure is ")
    assert f"the error stays at {loop.before.rmse:.2f} cmH2O, and" in report_text.answer(left)
    nothing = dataclasses.replace(left, verdict="nothing_missing")
    assert report_text.verdict(nothing) == (
        "Nothing is missing: the physics simulator explains the recording"
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
    sentence = number_text.error_region(ErrorRegion(axis, low, high, unit, 0.52, 0.01, 0.5), 0.2)
    assert sentence.startswith(f"The simulated pressure is 0.52 cmH2O too low {text}")
    square = number_text.error_region(ErrorRegion(axis, low, high, unit, 0.01, 0.01, 0.5), 0.2)
    assert square.startswith(f"The simulated pressure is off {text}")
    assert square.endswith(", by errors whose sign changes from breath to breath.")


def test_other_verdicts():
    said = report_text.sentences(made.unnamed(12))
    assert (
        "that is not in the library of mechanisms (held-out evidence 41 nats); its place in the "
        "model is R(V) (resistance of the airway); mending it takes the error"
    ) in said[0]
    assert any("83 % of the squared error above the noise" in text for text in said)
    nothing = made.nothing(12)
    said = report_text.sentences(nothing)
    assert said[0].startswith("Nothing is missing")
    assert "; it errs by " in said[0]
    assert not any("corrected" in text for text in said)
    both = dataclasses.replace(made.diagnosis(12), nonparametric=made.unnamed(12).nonparametric)
    assert "valve, and an effect that is not in the library (posterior" in report_text.verdict(both)
    assert "; mending them takes" in report_text.answer(both)
    assert report_text.nonparametric_term(both).startswith(
        "In addition to these mechanisms, a nonparametric term for R(V) (resistance of the airway) "
        "explains 83 %"
    )
    term = made.unnamed(12).nonparametric
    assert term is not None
    places = (("f(t) at the supply", 0.7), ("f(t) at the alveolus", 0.29), ("measurement", 0.01))
    timed = dataclasses.replace(
        term, name=places[0][0], places=places, x_unit="sample of the breath where it is largest"
    )
    assert report_text.nonparametric_term(dataclasses.replace(both, nonparametric=timed)).endswith(
        "where it acts: f(t) at the supply 70 % or f(t) at the alveolus 29 %. From pressure alone, "
        "a rougher course elsewhere would read the same."
    )
    sure = dataclasses.replace(timed, places=(places[0], places[2]))
    assert report_text.nonparametric_term(dataclasses.replace(both, nonparametric=sure)).endswith(
        "A course as smooth at other places (measurement) is less likely. From pressure alone, a "
        "rougher course elsewhere would read the same."
    )
    own = dataclasses.replace(term, name="f(u)", form_of=("valve_delay",))
    bent = dataclasses.replace(made.diagnosis(12), form=own)
    assert (
        "inspiratory valve, in another form than the library's (posterior"
        in report_text.verdict(bent)
    )
    assert "; mending it takes" in report_text.answer(bent)
    assert report_text.nonparametric_term(bent).startswith(
        "The form of the dead time of the inspiratory valve differs from the library's: "
    )
    named = dataclasses.replace(term, name="f(V)", meaning="f(V): the recoil of the lung")
    text = report_text.verdict(dataclasses.replace(made.unnamed(12), nonparametric=named))
    assert text.endswith("its place in the model is f(V) (the recoil of the lung)")


def test_distances_and_a_lung_that_matches():
    found = made.diagnosis(12)
    distances = dataclasses.replace(
        found.open_loop,
        before=OpenLoopError(1.0, 1.24),
        refit=OpenLoopError(0.5, 0.62),
        after=OpenLoopError(0.2, 0.22),
        noise_floor=0.21,
        held_out_breaths=tuple(range(20)),
    )
    assert report_text.worth(dataclasses.replace(found, open_loop=distances)).startswith(
        "mending it takes the error on 20 breaths set aside from 0.62 (R and C refitted; 1.24 as "
        "given) to 0.22 cmH2O, and "
    )
    nothing = dataclasses.replace(made.nothing(12), open_loop=distances)
    assert report_text.worth(nothing).startswith("it errs by 0.22 cmH2O (1.24 as given) on 20 br")
    match = dataclasses.replace(found.lungs[0], label_matches=True, source="pressure and flow")
    assert report_text.lung(match) == (
        "The lung matches its label R20C50: R 22.1 cmH2O/(L/s) [21.8, 22.4] and "
        "C 47.4 mL/cmH2O [47.0, 47.8], from pressure and flow (tolerance: R by a factor of 1.3 and "
        "2 cmH2O/(L/s) of tubes, C by a factor of 1.2)."
    )
    also = dataclasses.replace(match, settings=("R20C50", "R20C20"), source="pressure")
    assert report_text.lung(also).endswith(
        "C by a factor of 1.2, and a valve gain wrong by 20 %). Within the same tolerance it could "
        "be R20C20."
    )
    doubted = dataclasses.replace(
        match, label_matches=False, informative=False, doubt="It shows a fault."
    )
    assert report_text.lung(doubted) == (
        "Whether the lung matches its label R20C50 is unknown: R 22.1 cmH2O/(L/s) [21.8, 22.4] and "
        "C 47.4 mL/cmH2O [47.0, 47.8], from pressure and flow."
    )
    unknown = dataclasses.replace(match, fitted_R=NAN, fitted_C=NAN, label_matches=False)
    assert report_text.lung(unknown) == (
        "Whether the lung matches its label R20C50 is unknown: R and C unknown."
    )
    assert probability(0.001) == "p < 0.01"
    assert probability(0.034) == "p = 0.03"


def test_what_stays_unexplained_is_told_first():
    """An error of 1.6 where the sensor scatters by 0.41 is no explanation."""
    found = made.unnamed(12)
    big = OpenLoopError(1.2, 1.6)
    errors = dataclasses.replace(
        found.open_loop, before=big, refit=big, after=big, noise_floor=0.41
    )
    left = dataclasses.replace(found, open_loop=errors, nonparametric=None, gain_scatter=0.12)
    first, *others = report_text.sentences(left)
    assert first == (
        "Something is missing in the physics simulator, but the recording singles out neither a "
        "mechanism nor a place in the model; mending it is worth nothing on the 4 breaths set "
        "aside, where the error stays at 1.60 cmH2O, and of the 1.60 over whole breaths, 1.55 "
        "cmH2O stay unexplained beyond the noise of 0.41."
    )
    assert any("differs from breath to breath by about 13 %" in text for text in others)
    assert report_text.scatter(dataclasses.replace(left, gain_scatter=0.003)) == ""
    place = ErrorRegion("volume", 0.0, 50.0, "mL", 0.8, 0.001, 0.9)
    better = dataclasses.replace(errors, after=OpenLoopError(0.5, 0.8))
    still = dataclasses.replace(left, open_loop=better, remaining=(place,))
    assert report_text.remaining(still) == (
        "After the correction, the simulated pressure is 0.8 cmH2O too low where the volume is 0 "
        "to 50 mL."
    )


def test_the_headline_is_short():
    found = made.diagnosis(12)
    loop = found.open_loop
    worth = f"takes the error from {loop.refit.rmse:.2f} to {loop.after.rmse:.2f} cmH2O"
    assert report_text.headline(found) == (
        f"Missing in the physics simulator: dead time of the inspiratory valve; mending it {worth}"
    )
    four = dataclasses.replace(found, mechanisms=found.mechanisms * 4)
    assert report_text.headline(four) == (
        f"Four effects are missing in the physics simulator; mending them {worth}"
    )
    assert "no name" in report_text.headline(made.unnamed(12))
    assert report_text.headline(made.nothing(12)).startswith("Nothing is missing in")
    useless = dataclasses.replace(loop, after=loop.refit)
    text = report_text.headline(dataclasses.replace(found, open_loop=useless))
    assert text.endswith(f"and the error stays at {loop.refit.rmse:.2f} cmH2O")


def test_places_that_breaths_cannot_tell_apart_are_one_answer():
    """Pattern 5: one was told, and no other place was left for it."""
    found = made.unnamed(12)
    term = found.nonparametric
    assert term is not None
    weights = (("R(V)", 0.6), ("f(V)", 0.36), ("f(Q)", 0.04))
    texts = report_text.sentences(
        dataclasses.replace(found, nonparametric=dataclasses.replace(term, places=weights))
    )
    assert (
        "its place in the model is R(V) (resistance of the airway), or f(V), which these breaths "
        "cannot tell from it;"
    ) in texts[0]
    assert any("do not settle where it acts: R(V) 60 % or f(V) 36 %." in text for text in texts)


def test_doubts_stand_in_the_first_sentence():
    """Pattern 7: names at 33 %, at the end of their range or worth nothing, at a million to one."""
    found = made.diagnosis(12)
    (sure,) = found.mechanisms
    high = parameter("valve_delay.delay").high
    for changed, doubt in (
        ({"confidence": 0.33}, "valve_delay has a posterior probability of 33 % only"),
        ({"worth": 0.01}, "valve_delay is worth less than 0.02 cmH2O"),
        ({"explains": 0.2}, "valve_delay explains 20 % of what is no noise"),
        (
            {"parameters": {"delay": Estimate(high, "s", (0.9 * high, high))}},
            "the strength of valve_delay is at the end of its range",
        ),
    ):
        doubtful = dataclasses.replace(sure, **changed)
        first = report_text.sentences(dataclasses.replace(found, mechanisms=(sure, doubtful)))[0]
        assert f"(uncertain: {doubt})" in first
        assert ("the nearest in the library is dead time" in first) is ("explains" in changed)
    earned = dataclasses.replace(sure, worth=0.4, confidence=0.9999)
    assert "(posterior probability above 99 %)" in report_text.answer(
        dataclasses.replace(found, mechanisms=(earned,))
    )


def test_expiration_counts():
    """Pattern 7: a collapse, or a rise, of the error in expiration went untold."""
    found = made.diagnosis(12)
    loop = found.open_loop

    def answer(before: float, after: float) -> str:
        stages = {"refit": OpenLoopError(0.0, before), "after": OpenLoopError(0.0, after)}
        groups = loop.groups | {"expiration": stages}
        return report_text.answer(
            dataclasses.replace(found, open_loop=dataclasses.replace(loop, groups=groups))
        )

    assert "in inspiration, and from 1.13 to 0.19 in expiration, and of the" in answer(1.13, 0.19)
    assert "from 0.46 to 0.49 in expiration, where it gets worse" in answer(0.46, 0.49)


def test_what_is_unexplained_follows_from_the_numbers_beside_it():
    """Over whole breaths: an error in expiration alone is as unexplained as one in inspiration."""
    found = made.diagnosis(12)
    whole = {"after": OpenLoopError(0.5, 1.3)}
    loop = dataclasses.replace(
        found.open_loop,
        noise_floor=0.3,
        scatter_error=0.4,
        groups=found.open_loop.groups | {"whole breath": whole},
    )
    assert loop.unexplained == pytest.approx(1.2)
    text = report_text.answer(dataclasses.replace(found, open_loop=loop))
    assert text.endswith(
        "of the 1.30 over whole breaths, 1.20 cmH2O stay unexplained beyond the noise of 0.30 and "
        "the 0.40 of what differs from breath to breath."
    )


def test_what_vetoes_nothing_is_told_first():
    """Patterns 1 and 2."""
    found = dataclasses.replace(
        made.nothing(12), verdict="unnamed", changes=(Change("gain", 15, 1.25, False, 5e-4, 0.4),)
    )
    assert report_text.verdict(found) == (
        "Something is missing in the physics simulator that depends on the breath number: the gain "
        "of the valve changes at breath 15 (x 1.25, p < 0.01), which no mechanism of the library "
        "explains"
    )
    assert report_text.headline(found).startswith(
        "Missing in the physics simulator: the gain of the valve changes at breath 15"
    )
    assert any("The breaths before 15, and" in text for text in report_text.would_change(found))
    drift = Change("zero", 9, -0.52, True, 5e-4, 0.4)
    assert report_text.change(drift) == (
        "the zero of the pressure drifts from the first to the last breath (by -0.52 cmH2O, "
        "p < 0.01)"
    )
    named = dataclasses.replace(made.diagnosis(12), changes=(drift,))
    assert "probability of 97 %), and the zero of the" in report_text.verdict(named)
    saturated = dataclasses.replace(made.nothing(12), saturated=(31.0, 0.045))
    assert report_text.verdict(saturated).startswith(
        "The pressure sensor saturates at 31.0 cmH2O (4 % of the readings, which are left out); by "
        "the others: Nothing is missing"
    )
    assert report_text.headline(saturated).startswith("Readings saturate at 31.0 cmH2O. Nothing")
    spoiled = dataclasses.replace(saturated, left_out="3 % of the readings of flow are none")
    assert report_text.verdict(spoiled).startswith(
        "3 % of the readings of flow are none; by the others: The pressure sensor saturates"
    )
    assert report_text.headline(spoiled).startswith("3 % of the readings of flow are none. Read")
    place = ErrorRegion("volume", 0.0, 50.0, "mL", 0.8, 0.03, 0.9)
    weak = dataclasses.replace(made.nothing(12), remaining=(place,))
    assert report_text.verdict(weak) == (
        "No mechanism is shown to be missing in the physics simulator, but the simulated pressure "
        "is 0.8 cmH2O too low where the volume is 0 to 50 mL (p = 0.03)"
    )


def test_what_would_change_the_answer():
    found = made.diagnosis(12)
    texts = report_text.would_change(found)
    assert any("less than 4.6 nats by it would withdraw the name" in text for text in texts)
    assert any("Only 4 breaths judge" in text for text in texts)
    assert not any("unexplained" in text for text in texts)
    stress = dataclasses.replace(found.mechanisms[0], name="viscoelasticity")
    texts = report_text.would_change(dataclasses.replace(found, mechanisms=(stress,)))
    assert any("never tell viscoelasticity from second_compartment" in text for text in texts)
    big = dataclasses.replace(found.open_loop, after=OpenLoopError(1.0, 1.0))
    texts = report_text.would_change(dataclasses.replace(found, open_loop=big))
    assert any("More than the noise is unexplained" in text for text in texts)
    assert any("another kind" in text for text in report_text.would_change(made.nothing(12)))
    assert any("would give it a name" in text for text in report_text.would_change(made.unnamed()))


def test_a_change_is_told_with_its_breaths_and_what_else_it_may_be():
    values = {
        "change": Estimate(-0.25, "1", (-0.26, -0.24)),
        "at": Estimate(0.6, "1", (0.59, 0.62)),
    }
    step = MissingMechanism(
        "gain_step", values, 0.9, ("gain_drift", "leak"), 40.0, worth=0.4, breaths=(37, 36, 38)
    )
    found = dataclasses.replace(made.diagnosis(12), mechanisms=(step,))
    said = "the valve's gain falls by 25 % from breath 37 on"
    assert report_text.verdict(found).startswith(
        f"Missing in the physics simulator: {said}, or drift of the valve's gain (posterior"
    )
    assert said in report_text.headline(found)
    text = report_text.missing_mechanism(step)
    assert "from breath 37 [36, 38] on; -25 % [-26, -24] (change, as a share" in text
    assert "0.6" not in text
