"""Which sessions pass the test of their label, and which of them stands for the lung."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.plants.sessions import Session, Sessions
from ventbench.task.lungs import lung
from ventbench.train.rigs.label_test import LabelTest, interval
from ventbench.train.rigs.train import choose_rigs

PASSED = LabelTest(
    session=0,
    lung=lung("R20C50"),
    measured=5,
    breaths=20,
    R=17.0,
    R_interval=(16.0, 18.0),
    R_pooled=14.0,
    C=48.0,
    C_interval=(46.0, 50.0),
    C_pooled=46.0,
    error_own_label=0.5,
    best_other_label="R20C20",
    error_best_other_label=0.9,
)


def test_a_session_as_its_label_says_passes():
    assert PASSED.reasons == []
    assert "reason" not in PASSED.as_dict()


@pytest.mark.parametrize("R", [16.1, 23.9, 14.5, 12.0])
def test_within_a_fifth_of_the_label_or_of_the_pooled_value(R):
    assert replace(PASSED, R=R).reasons == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"R": 11.0}, "fitted R 11.0 cmH2O/(L/s) is more than 20 % from the label 20 and from the"),
        ({"R": 24.5}, "pooled value 14.0"),
        ({"C": 30.0}, "fitted C 30.0 mL/cmH2O is more than 20 % from the label 50"),
        ({"error_best_other_label": 0.4}, "explained better by R20C20 (median error 0.40 cmH2O)"),
    ],
)
def test_why_a_session_does_not_pass(change, said):
    (reason,) = replace(PASSED, **change).reasons
    assert said in reason
    assert replace(PASSED, **change).as_dict()["reason"] == reason


def test_several_reasons_are_all_told():
    wrong = replace(PASSED, C=30.0, error_best_other_label=0.4)
    assert len(wrong.reasons) == 2
    assert all(reason in wrong.as_dict()["reason"] for reason in wrong.reasons)


def test_the_only_label_has_no_other():
    alone = replace(PASSED, best_other_label=None, error_best_other_label=None)
    assert alone.reasons == []
    assert "best_other_label" not in alone.as_dict()


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
    assert chosen == {"session": 1, "rigs": [1, 0, 2, 3], "label_test": "passed", "held_out_rig": 3}


def test_on_one_kind_of_ventilator_the_best_recorded_other_rig_is_held_out():
    assert choose_rigs(several(3, 8, 5), sessions(False, False, False))["held_out_rig"] == 2


def test_two_rigs_are_too_few_to_hold_one_out():
    assert "held_out_rig" not in choose_rigs(several(3, 8), sessions(False, True))


def test_rigs_that_failed_are_left_out_unless_all_did():
    three = several(3, 8, 5)
    three[1] = replace(three[1], C=30.0)
    assert choose_rigs(three, sessions(False, False, False))["rigs"] == [2, 0]
    failed = choose_rigs(several(3, 8, C=30.0), sessions(False, False))
    assert failed["rigs"] == [1]
    assert failed["label_test"] == "no session passed"
