from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.figures import (
    by_kind,
    calibration_error,
    full_answer,
    paired,
    scores,
    share,
    wilson,
)
from proofs.challenge.judge import FLOOR, judge
from proofs.challenge.truth import true_values

from .truths import answer, answered, case, drawn, judged, recording, withheld

LEAK = Effect("leak", "strong", "library", {"conductance": 20.0})
LAG = Effect("valve_lag", "mild", "library", {"tau": 0.04})
LINEAR = Effect("leak", "strong", "linear", {"conductance": 20.0})
HEART = Effect("cardiogenic", "strong", "oscillation", {"amplitude": 1.0, "frequency": 1.2})
SECOND = Effect("second_compartment", "strong", "two compartments", {"share": 0.4, "time": 1.0})
SURE = answer((1.0, "leak"))
NOTHING = answer((1.0, ""))


def value(figures, what):
    return next(f for f in figures if f.what.startswith(what))


def test_wilson_is_the_published_interval():
    # Newcombe, Statistics in Medicine 17 (1998) 857, table I, method 3
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def test_right_is_the_name_and_nothing_else():
    assert judged("single", [LEAK], SURE).right
    assert not judged("single", [LEAK], answer((1.0, "leak unknown:lung"))).right
    both = answer((1.0, "leak valve_lag"))
    assert not judged("single", [LEAK], both).right
    assert judged("single", [LEAK], both).false == {"valve_lag"}
    assert judged("pair", [LEAK, LAG], both).right
    assert judged("null", [], NOTHING).right
    assert not judged("null", [], answer((1.0, "unknown:lung"))).right


def test_probabilities_are_scored():
    case = judged("single", [LEAK], answer((0.7, "leak"), (0.2, "valve_lag"), (0.1, "")))
    assert case.log_score == pytest.approx(-np.log(0.7))
    assert case.brier == pytest.approx(0.3**2 + 0.2**2 + 0.1**2)
    assert (case.confidence, case.isolation, case.missing) == (0.7, 1.0, pytest.approx(0.9))
    assert judged("single", [LEAK], NOTHING).log_score == pytest.approx(-np.log(FLOOR))


def test_a_set_counts_by_its_size():
    halves = judged("single", [LEAK], answer((0.5, "leak"), (0.5, "valve_lag")))
    assert halves.isolation == 0.5
    assert halves.confidence == 1.0
    assert not halves.right
    others = judged("single", [LEAK], answer((0.4, "cough"), (0.4, "valve_lag"), (0.2, "leak")))
    assert others.isolation == 0.0


def test_harm_is_less_in_the_right_part_of_the_rig():
    near = judged("single", [LEAK], answer((1.0, "circuit_compliance")))
    far = judged("single", [LEAK], answer((0.8, "cough"), (0.2, "leak")))
    assert near.harm == 0.5
    assert far.harm == 0.8
    assert near.right_place
    assert not far.right_place
    assert judged("single", [LEAK], answer((1.0, "unknown:lung"))).harm == 0.0


def test_outside_wants_the_place_or_an_equivalent():
    assert judged("outside", [HEART], answer((1.0, "unknown:muscles"))).right
    assert not judged("outside", [HEART], answer((1.0, "unknown:lung"))).right
    assert judged("outside", [SECOND], answer((1.0, "viscoelasticity"))).right


def test_what_is_below_the_detection_limit_may_be_left_out():
    for given in (SURE, NOTHING):
        assert judged("single", [LEAK], given, worth=3.0).right
    assert not judged("single", [LEAK], answer((1.0, "cough")), worth=3.0).right
    assert judged("single", [LEAK], answer((0.5, "leak"), (0.5, "")), worth=3.0).belief == 1.0


def test_errors_are_measured_on_the_withheld_pressures():
    off = SURE | {"pressures": {"2": [0, 21, 9, 6], "5": [0, 20, 6, 6]}}
    found = judged("single", [LEAK], off)
    assert found.inspiration == pytest.approx(0.5)  # the first sample is not counted
    assert found.expiration == pytest.approx(3.0 / 4.0)


def test_an_answer_that_lies_about_itself_changes_nothing():
    forged = SURE | {
        "notes": {
            "open_loop": {"after": {"rmse": 0.0}},
            "verdict": "named",
            "seconds": 0.0,
            "right": True,
        }
    }
    assert judged("single", [LEAK], forged) == judged("single", [LEAK], SURE)
    first, second = (
        [f for f in [*scores([c]), *by_kind([c])] if f.value is not None]
        for c in (judged("null", [], forged), judged("null", [], SURE))
    )
    assert first == second


def test_a_lost_case_is_not_right_and_predicts_a_constant():
    lost = judged("null", [], None)
    assert not lost.right
    assert lost.log_score == pytest.approx(-np.log(FLOOR))
    assert lost.brier == 1.0
    assert lost.inspiration == 7.0  # the median of the recording is 13
    assert value(scores([lost]), "lost cases").met is False
    assert value(scores([lost]), "false alarms").value == 1.0
    assert full_answer(lost) == "no answer"


def test_localisation_is_the_f1_of_samples():
    kept = withheld(active={1: ((0.5, 1.0),), 3: ((0.0, 0.5),)})
    half = judged(
        "single", [LEAK], SURE | {"active": {"1": [[0.5, 1.0]], "4": [[0, 0.5]]}}, kept=kept
    )
    assert half.overlap == pytest.approx(0.5)
    assert judged("single", [LEAK], SURE, kept=kept).overlap == 0.0
    assert judged("single", [LEAK], SURE).overlap is None


def test_values_are_those_a_fit_with_the_nominal_gain_sees():
    tube = Effect("circuit_compliance", "mild", "library", {"compliance": 1.2})
    rough = Effect("turbulent_resistance", "mild", "library", {"quadratic": 4.0})
    weak = case(LEAK, tube, rough, LAG, base=Base(10.0, 20.0, gain=22.8 * 1.1))
    assert true_values(weak) == pytest.approx(
        {
            "leak.conductance": 20 / 1.1,
            "circuit_compliance.compliance": 1.2 / 1.1,
            "turbulent_resistance.quadratic": 4 * 1.21,
            "valve_lag.tau": 0.04,
        }
    )
    assert true_values(case(LINEAR)) == {}
    assert true_values(case(base=Base(10.0, 20.0, gain=22.8 * 1.1))) == pytest.approx(
        {"R": 11.0, "C": 20 / 1.1}
    )


def conductance(value, low, high):
    return SURE | {"parameters": {"leak.conductance": {"value": value, "low": low, "high": high}}}


def test_estimates_know_error_and_coverage():
    (item,) = judged("single", [LEAK], conductance(22.0, 19.0, 25.0)).estimates
    assert item.error == pytest.approx(0.1)
    assert item.covered
    (narrow,) = judged("single", [LEAK], conductance(22.0, 21.0, 23.0)).estimates
    assert not narrow.covered
    assert judged("form", [LINEAR], conductance(22.0, 19.0, 25.0)).estimates == ()
    unnamed = conductance(20.0, 19.0, 21.0) | {"hypotheses": NOTHING["hypotheses"]}
    assert judged("single", [LEAK], unnamed).estimates == ()


def test_figures_count_what_they_say():
    right, silent = judged("single", [LEAK], SURE), judged("single", [LEAK], NOTHING)
    figures = by_kind([right, right, right, silent])
    assert value(figures, "strong alone: right").value == 0.75
    assert value(figures, "strong alone: right").met is False
    assert value(scores([right, silent]), "detected").value == 0.5
    mild = judged("single", [LAG], SURE)
    assert value(by_kind([mild]), "mild alone: a wrong").value == 1.0
    assert value(scores([mild]), "a confident wrong").value == 1.0
    assert {f.what.partition(":")[0] for f in by_kind([right])} == {"strong alone"}
    hidden = judged("single", [LEAK], NOTHING, worth=3.0)
    assert [f.value for f in by_kind([hidden])] == [1.0, 0.0]
    assert value(by_kind([hidden]), "below the detection limit: right").met
    null = judged("null", [], SURE)
    assert value(by_kind([null]), "null: a wrong").value == 1.0
    pair = judged("pair", [LEAK, LAG], answer((1.0, "leak")))
    assert [f.value for f in by_kind([pair])] == [0.0, 0.0]


def test_size_is_right_within_a_quarter():
    near = judged("single", [LEAK], conductance(24.0, 19.0, 25.0))
    far = judged("single", [LEAK], conductance(30.0, 19.0, 35.0))
    assert value(scores([near, far]), "right name and size").value == 0.5


def test_calibration_compares_confidence_with_what_was_right():
    sure_and_half_right = np.array([[[1.0, 1.0], [1.0, 0.0]] * 50])
    assert calibration_error(sure_and_half_right) == pytest.approx(0.5)
    rng = np.random.default_rng(0)
    believed = rng.uniform(size=20_000)
    happened = rng.uniform(size=20_000) < believed
    honest = calibration_error(np.stack([believed, happened], axis=-1)[None].astype(float))
    assert honest < 0.02


def test_differences_are_paired():
    rng = np.random.default_rng(1)
    ours, other = {}, {}
    for k in range(30):  # both have the same hard and easy cases; ours is always a bit better
        p = float(rng.uniform(0.3, 0.9))
        ours[str(k)] = judged("single", [LEAK], answer((p + 0.05, "leak"), (0.95 - p, "")))
        other[str(k)] = judged("single", [LEAK], answer((p, "leak"), (1.0 - p, "")))
    other["more"] = judged("single", [LEAK], NOTHING)
    found = paired(ours, other)["log score"]
    assert found.count == 30
    assert found.ci95 is not None
    assert found.value is not None
    assert found.ci95[0] < found.value < found.ci95[1] < 0.0


def test_a_share_of_nothing_has_no_value():
    empty = share("x", [], least=0.9)
    assert (empty.value, empty.met, empty.count) == (None, None, 0)
    band = share("x", [True] * 95 + [False] * 5, least=0.92, most=0.98)
    assert band.met
    assert share("x", [True] * 10, least=0.92, most=0.98).met is False


def test_the_judge_knows_no_diagnoser():
    code = (
        "import sys; import proofs.challenge.reveal, proofs.challenge.answer; "
        "bad = ('ventbench.diagnosis', 'ventbench.system_id', 'ventbench.physics', "
        "'proofs.diagnosers', 'jax'); "
        "print([m for m in sys.modules if m.startswith(bad)])"
    )
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
    )
    assert done.stdout.strip() == "[]"


def test_another_order_of_hypotheses_is_the_same_answer():
    there = answer((0.5, "leak"), (0.5, "cough"))
    back = answer((0.5, "cough"), (0.5, "leak"))
    first, second = (
        judge(drawn("single", LEAK), (99.0,), recording(), withheld(), answered(a))
        for a in (there, back)
    )
    assert first == second
