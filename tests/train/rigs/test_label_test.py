"""Which sessions pass the test of their label, and which of them stands for the lung.

The rigs of the first tests are an orifice in parallel units and a balloon on paper: what a fit that
has the gain of the valve wrong reads of them follows from their drop alone. Those of the last are
integrated by Euler's rule here and fitted as recordings are. No plant of ours is in either.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float32
from ventbench.plants.sessions import Session, Sessions, find
from ventbench.recordings import Breaths, join, make_breaths
from ventbench.task.lungs import lung
from ventbench.train.rigs.data import groups_of_sessions, inspirations
from ventbench.train.rigs.fit import FitConfig, centre, fit, plants
from ventbench.train.rigs.label_test import (
    APPARATUS,
    REFERENCE_FLOW,
    LabelTest,
    interval,
    label_gain,
    label_tests,
)
from ventbench.train.rigs.train import choose_rigs

#: Laws of a test lung's resistor: an orifice, what was measured, the largest laminar share.
LAWS = (0.0, 0.2, 0.4)


def drop(label: float, share: float, flow: float) -> float:
    """Pressure over the resistor of a label, cmH2O, which it has at 1 L/s by any law."""
    return label * (share * flow + (1.0 - share) * flow**2)


def read(
    name: str, *, C: float, gain: float = 1.0, share: float = 0.2, tube: float = 0.0
) -> LabelTest:
    """What is read of a rig whose flows are ``gain`` times those that the fit believes in."""
    label = lung(name)
    believed, true = REFERENCE_FLOW, gain * REFERENCE_FLOW
    R = (drop(label.R, share, true) + tube * true) / believed
    return LabelTest(
        session=0,
        lung=label,
        measured=5,
        breaths=20,
        R=R,
        R_interval=(0.97 * R, 1.03 * R),
        C=C / gain,
        C_interval=(0.97 * C, 1.03 * C),
        laminar_share=0.4,
        error_own_label=0.5,
        best_other_label="R50C20",
        error_best_other_label=0.9,
    )


PASSED = read("R20C50", C=48.0)


def test_a_session_as_its_label_says_passes():
    assert PASSED.label_true
    assert {"reason", "doubt"}.isdisjoint(PASSED.as_dict())


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 1.0])
@pytest.mark.parametrize("gain", [0.7, 1.0, 1.3])
def test_a_resistor_tells_the_flow_by_its_own_law(share, gain):
    R = drop(20.0, share, gain * REFERENCE_FLOW) / REFERENCE_FLOW
    assert label_gain(R, 20.0, share) == pytest.approx(gain)


def test_an_orifice_that_is_rated_at_1_has_half_its_label_at_half_the_flow():
    orifice = read("R20C50", C=50.0, share=0.0)
    assert pytest.approx(10.0) == orifice.R
    assert max(orifice.gain) == pytest.approx(1.0)
    assert orifice.reasons == []


@pytest.mark.parametrize("share", LAWS)
@pytest.mark.parametrize("gain", [0.8, 1.0, 1.25])
@pytest.mark.parametrize("off", [0.75, 1.25, 1 / 0.75])
@pytest.mark.parametrize("name", ["R20C10", "R20C20", "R20C50", "R5C20"])
def test_no_lung_a_quarter_off_passes_whatever_gain_hides_it(name, off, gain, share):
    label = lung(name)
    assert not read(name, C=off * label.C, gain=gain, share=share).label_true
    hidden = read(name, C=off * label.C, gain=off, share=share)
    assert pytest.approx(label.C) == hidden.C, "as fitted, nothing is wrong"
    assert not hidden.label_true


@pytest.mark.parametrize("share", LAWS)
def test_a_right_lung_passes_behind_a_valve_of_another_gain(share):
    for gain in (0.9, 1.0, 1.1):
        right = read("R20C50", C=50.0, gain=gain, share=share)
        assert right.reasons == []
        assert min(right.C_by_resistor) <= 50.0 + 1e-9
        assert max(right.C_by_resistor) >= 50.0 - 1e-9
        assert right.label_true or share != 0.2, "at the ends of the laws 20 % is just missed"


def test_a_common_bias_of_all_sessions_is_no_agreement():
    """Six sessions that agree with each other, and with no label: none passes by that."""
    biased = [replace(read("R20C50", C=37.5, gain=0.75), session=i) for i in range(6)]
    assert not any(test.label_true for test in biased)
    assert choose_rigs(biased, sessions(*[False] * 6))["label_test"] != "passed"


def test_where_tubes_could_make_the_drop_nothing_can_be_told():
    small = read("R5C50", C=50.0)
    assert small.reasons == []
    assert "the drop over its resistor tells the gain of the valve" in small.as_dict()["doubt"]
    tube = read("R5C50", C=50.0, tube=APPARATUS)
    assert min(tube.gain) > 1.0, "which is why"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"R": 6.0}, "fitted R 6.0 cmH2O/(L/s) at 0.5 L/s is more than 20 % from what a resistor"),
        ({"R": 25.0}, "of the label 20 has there, 10 to 14"),
        ({"C": 30.0}, "fitted C 30.0 mL/cmH2O is 40 % too low for the label 50"),
        ({"C": 63.0}, "26 % too high for the label 50"),
        ({"R": 8.5, "C": 41.0}, "by the flow that its resistor tells, 28.6 to 37.8 mL/cmH2O, is"),
        ({"error_best_other_label": 0.4}, "explained better by R50C20 (median error 0.40 cmH2O)"),
    ],
)
def test_why_a_session_does_not_pass(change, said):
    if "R" in change:
        change = {**change, "R_interval": (change["R"], change["R"])}
    test = replace(PASSED, **change)
    assert said in test.as_dict()["reason"]
    assert not test.label_true


def test_several_reasons_are_all_told():
    wrong = replace(PASSED, C=30.0, error_best_other_label=0.4)
    assert len(wrong.reasons) == 2
    assert all(reason in wrong.as_dict()["reason"] for reason in wrong.reasons)


def test_the_only_label_has_no_other():
    alone = replace(PASSED, best_other_label=None, error_best_other_label=None)
    assert alone.reasons == []
    assert "best_other_label" not in alone.as_dict()


def recorded(
    name: str, *, C: float, gain: float = 1.0, share: float = 0.2, first_id: int = 1
) -> Breaths:
    """Ten inspirations of a balloon behind a resistor and a linear valve, by Euler's rule."""
    n, samples, dt, parts = 10, 32, 0.033, 33
    random, label = np.random.default_rng(0), lung(name)
    level = random.uniform(0.25, 1.0, (n, 1)) * min(45.0, 0.9 * label.C + 8.0)
    u_in = level * np.repeat(random.uniform(0.0, 1.0, (n, samples)), 3, axis=1)[:, :samples]
    pressure = np.full(n, 5.0)
    recoil, readings = pressure.copy(), np.empty((n, samples))
    a, b = share * label.R, (1.0 - share) * label.R
    for k in range(samples):
        readings[:, k] = pressure
        for _ in range(parts):
            over = pressure - recoil
            flow = np.sign(over) * (np.sqrt(a * a + 4.0 * b * np.abs(over)) - a) / (2.0 * b)
            pressure = pressure + (gain * 0.0228 * u_in[:, k] - flow) / 0.0008 * dt / parts
            recoil = recoil + 1000.0 * flow / C * dt / parts
    return make_breaths(
        breath_id=np.arange(n) + first_id,
        R=np.full(n, label.R),
        C=np.full(n, label.C),
        time=np.tile(dt * np.arange(samples), (n, 1)),
        u_in=u_in,
        u_out=np.zeros((n, samples), int),
        pressure=readings + random.normal(0.0, 0.1, u_in.shape),
    )


def judged(*parts: Breaths) -> list[LabelTest]:
    """Fit rigs as a training does, and test their labels."""
    breaths = join(list(parts))
    labels = tuple(sorted({lung(name) for name in breaths.lung_ids.tolist()}))
    table = find(breaths)
    with float32():
        data = inspirations(breaths, table, labels)
        around = centre(labels, len(table))
        fitted = fit(data, jnp.ones(len(breaths)), around, config=FitConfig(iterations=160))
        rigs = plants(fitted.pooled, groups_of_sessions(table, labels))
    counts = np.full(len(table), len(breaths))
    errors = {index: [0.0] * len(labels) for index in range(len(table))}
    return label_tests(rigs, [], errors, table, labels, (counts, counts), 0.4)


def test_recorded_lungs_pass_if_they_are_what_they_say_and_not_otherwise():
    cases: tuple[tuple[dict[str, Any], bool], ...] = (
        ({"C": 50.0}, True),
        ({"C": 50.0, "gain": 1.3}, True),
        ({"C": 50.0, "gain": 0.8}, True),
        ({"C": 37.5}, False),
        ({"C": 62.5}, False),
        ({"C": 37.5, "gain": 0.75}, False),
        ({"C": 62.5, "gain": 1.25}, False),
        ({"C": 37.5, "gain": 0.75, "share": 0.4}, False),
    )
    for rig, true in cases:
        (test,) = judged(recorded("R20C50", **rig))
        assert test.label_true == true, (rig, test.as_dict())
        # The compliance by the resistor is that of the lung, whatever was fitted.
        low, high = test.C_by_resistor
        assert 0.97 * low <= rig["C"] <= 1.03 * high


def test_recorded_lungs_with_a_common_bias_do_not_vouch_for_each_other():
    biased = judged(
        recorded("R20C50", C=37.5, gain=0.75), recorded("R20C20", C=15.0, gain=0.75, first_id=100)
    )
    assert len(biased) == 2
    assert not any(test.label_true for test in biased)


def test_interval_is_two_standard_deviations_of_the_logarithm():
    rng = np.random.default_rng(0)
    low, high = interval(20.0, 20.0 * np.exp(0.1 * rng.standard_normal(5000)))
    assert (low, high) == pytest.approx((20.0 * np.exp(-0.196), 20.0 * np.exp(0.196)), rel=0.01)
    assert interval(20.0, np.empty(0)) == (20.0, 20.0)


def sessions(*spiky: bool) -> Sessions:
    return Sessions(tuple(Session("R20C50", 34.0, kind, 29, 10) for kind in spiky))


def several(*measured: int, **change) -> list[LabelTest]:
    return [replace(PASSED, session=i, measured=n, **change) for i, n in enumerate(measured)]


def test_the_reference_has_the_most_measured_breaths_and_another_kind_is_held_out():
    chosen = choose_rigs(several(3, 8, 5, 2), sessions(False, False, False, True))
    apart = chosen.pop("held_out_rigs")
    assert chosen == {"session": 1, "rigs": [1, 0, 2, 3], "label_test": "passed"}
    assert apart[0] == 3
    assert apart[1:] in ([0], [2])


def test_on_one_kind_of_ventilator_the_best_recorded_other_rig_is_held_out():
    assert choose_rigs(several(3, 8, 5), sessions(False, False, False))["held_out_rigs"] == [2]


def test_of_two_rigs_one_is_held_out_and_of_one_none():
    assert choose_rigs(several(3, 8), sessions(False, True))["held_out_rigs"] == [0]
    assert "held_out_rigs" not in choose_rigs(several(3), sessions(False))


def test_a_clock_decides_what_is_held_out_beside_the_first_and_no_order_of_sessions():
    table = Sessions(tuple(Session("R20C50", 34.0 + k / 100, False, 29, 10) for k in range(7)))
    chosen = choose_rigs(several(9, 1, 1, 1, 1, 1, 1), table)["held_out_rigs"]
    moved = Sessions((table.table[0], *table.table[:0:-1]))
    again = choose_rigs(several(9, 1, 1, 1, 1, 1, 1), moved)["held_out_rigs"]
    assert len(chosen) == 3
    # The first is the best recorded; on a tie the first of the table.
    clocks = {table.table[k] for k in chosen[1:]}
    assert clocks & {moved.table[k] for k in again[1:]}


def test_rigs_that_failed_are_left_out_unless_all_did():
    three = several(3, 8, 5)
    three[1] = replace(three[1], C=30.0)
    assert choose_rigs(three, sessions(False, False, False))["rigs"] == [2, 0]


def test_where_no_label_can_be_told_the_lung_says_so():
    doubtful = replace(read("R5C50", C=50.0), session=1)
    chosen = choose_rigs([several(3, C=30.0)[0], doubtful], sessions(False, False))
    assert (chosen["rigs"], chosen["label_test"]) == ([1], "cannot be told")


def test_where_all_failed_the_best_recorded_stands_for_the_lung():
    failed = choose_rigs(several(3, 8, C=30.0), sessions(False, False))
    assert failed["rigs"] == [1]
    assert failed["label_test"] == "no session passed"
