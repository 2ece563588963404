from __future__ import annotations

from dataclasses import replace

import pytest

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.figures import (
    by_parameter,
    confusion,
    figures,
    second_round,
    share,
    wilson,
)
from proofs.challenge.judge import judge, true_values

from .truths import answer, case, drawn, mechanism

LEAK = Effect("leak", "strong", "library", {"conductance": 20.0})
LAG = Effect("valve_lag", "mild", "library", {"tau": 0.04})
LINEAR = Effect("leak", "strong", "linear", {"conductance": 20.0})
HEART = Effect("cardiogenic", "strong", "oscillation", {"amplitude": 1.0, "frequency": 1.2})
SECOND = Effect("second_compartment", "strong", "two compartments", {"share": 0.4, "time": 1.0})


def judged(kind, effects, given, worth=100.0):
    return judge(drawn(kind, *effects), [worth] * len(effects), given)


def value(cases, what):
    return next(f for f in figures(cases) if f.what.startswith(what))


def test_wilson_is_the_published_interval():
    # Newcombe, Statistics in Medicine 17 (1998) 857, table I, method 3
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def test_right_is_the_name_and_nothing_else():
    assert judged("single", [LEAK], answer("named", mechanism("leak"))).right
    assert not judged("single", [LEAK], answer("named", mechanism("leak"), slot="f(V)")).right
    bent = judged("single", [LEAK], answer("named", mechanism("leak"), form="leak"))
    assert bent.right
    assert (bent.slot, bent.form) == (None, "leak")
    both = answer("named", mechanism("leak"), mechanism("valve_lag"))
    assert not judged("single", [LEAK], both).right
    assert judged("single", [LEAK], both).wrong == {"valve_lag"}
    assert judged("pair", [LEAK, LAG], both).right
    assert judged("null", [], answer("nothing_missing")).right
    assert not judged("null", [], answer("unnamed", slot="f(V)")).right


def test_only_two_alternatives_count():
    listed = answer("named", mechanism("valve_lag", "sensor_lag", "leak"))
    assert judged("single", [LEAK], listed).listed == {"leak"}
    longer = answer("named", mechanism("valve_lag", "sensor_lag", "inertance", "leak"))
    assert judged("single", [LEAK], longer).listed == frozenset()


def test_outside_wants_the_place():
    there = judged("outside", [HEART], answer("unnamed", slot="f(t) at the alveolus"))
    assert there.right
    elsewhere = judged("outside", [HEART], answer("unnamed", slot="f(V)"))
    assert elsewhere.said_outside
    assert not elsewhere.right
    assert not judged("outside", [HEART], answer("named", mechanism("leak"))).said_outside


def test_a_second_compartment_may_be_called_viscoelasticity():
    for given in (answer("named", mechanism("viscoelasticity")),
                  answer("unnamed", slot="memory of p")):  # fmt: skip
        found = judged("outside", [SECOND], given)
        assert found.said_outside
        assert found.right


def test_values_are_those_a_fit_with_the_nominal_gain_sees():
    tube = Effect("circuit_compliance", "mild", "library", {"compliance": 1.2})
    rough = Effect("turbulent_resistance", "mild", "library", {"quadratic": 4.0})
    weak = case(LEAK, tube, rough, LAG, base=Base(10.0, 20.0, gain=22.8 * 1.1))
    found = true_values(weak)
    assert found == pytest.approx({
        "leak.conductance": 20 / 1.1, "circuit_compliance.compliance": 1.2 / 1.1,
        "turbulent_resistance.quadratic": 4 * 1.21, "valve_lag.tau": 0.04,
    })  # fmt: skip
    assert true_values(case(LINEAR)) == {}


def test_estimates_know_error_and_coverage():
    given = answer("named", mechanism("leak", conductance=(22.0, 19.0, 25.0)))
    (item,) = judged("single", [LEAK], given).estimates
    assert item.error == pytest.approx(0.1)
    assert item.covered
    narrow = answer("named", mechanism("leak", conductance=(22.0, 21.0, 23.0)))
    assert not judged("single", [LEAK], narrow).estimates[0].covered
    assert judged("form", [LINEAR], given).estimates == ()


def test_figures_count_what_they_say():
    right = judged("single", [LEAK], answer("named", mechanism("leak")))
    silent = judged("single", [LEAK], answer("nothing_missing"))
    assert value([right, right, right, silent], "strong: right").value == 0.75
    assert value([right, silent], "strong: right").met is False
    mild = judged("single", [LAG], answer("named", mechanism("leak")))
    assert value([mild], "mild: a wrong").value == 1.0
    assert value([right], "mild: a wrong").count == 0
    hidden = judged("single", [LEAK], answer("nothing_missing"), worth=3.0)
    assert value([hidden], "strong: right").count == 0
    assert value([hidden], "below the detection").value == 1.0
    null = judged("null", [], answer("named", mechanism("leak")))
    assert value([null], "nothing missing: false").met is False
    unknown = judged("form", [LINEAR], answer("unnamed", slot="f(V)"))
    assert value([unknown, right], "library effect called").value == 0.5


def test_four_counts_terms():
    given = answer("named", mechanism("leak"), mechanism("inertance"))
    found = judged("four", [LEAK, LAG], given)
    assert value([found], "four: terms").value == 0.5
    assert value([found], "four: spurious").value == 1.0


def test_costs_leave_out_the_first_of_a_process():
    quick = judged("single", [LEAK], answer("nothing_missing", seconds=20.0))
    first = judged("single", [LEAK], answer("nothing_missing", seconds=90.0, first_in_process=True))
    assert value([quick, first], "seconds a case, longest").value == 20.0
    assert value([quick, first], "memory").met


def test_distances_must_not_grow():
    good = judged("single", [LEAK], answer("nothing_missing"))
    assert value([good], "held-out RMSE not above").met
    assert value([good, replace(good, after=1.1)], "held-out RMSE not above").value == 0.5


def test_second_round_counts_what_was_open():
    sure = judged("single", [LEAK], answer("named", mechanism("leak")))
    unsure = judged("single", [LEAK], answer("named", mechanism("leak", "valve_dead_band")))
    mistaken = judged("single", [LEAK], answer("named", mechanism("valve_dead_band")))
    before = {"a": sure, "b": unsure, "c": mistaken, "d": unsure}
    after = {"a": sure, "b": sure, "c": mistaken, "d": sure}
    found = second_round(before, after)
    assert (found.value, found.count) == (pytest.approx(2 / 3), 3)


def test_confusion_has_truths_and_answers():
    cases = [
        judged("single", [LEAK], answer("named", mechanism("leak"))),
        judged("single", [LEAK], answer("nothing_missing")),
        judged("null", [], answer("unnamed", slot="f(V)")),
        judged("pair", [LEAK, LAG], answer("nothing_missing")),
    ]
    assert confusion(cases) == {
        "nothing missing": {"unnamed: f(V)": 1},
        "leak": {"leak": 1, "nothing missing": 1},
    }
    found = judged(
        "single", [LEAK], answer("named", mechanism("leak", conductance=(20.0, 19.0, 21.0)))
    )
    table = by_parameter([found])
    assert table == {"leak.conductance": {"count": 1, "covered": 1, "median_error": 0.0}}


def test_a_share_of_nothing_has_no_value():
    empty = share("x", [], least=0.9)
    assert (empty.value, empty.met, empty.count) == (None, None, 0)
    band = share("x", [True] * 95 + [False] * 5, least=0.92, most=0.98)
    assert band.met
    assert share("x", [True] * 10, least=0.92, most=0.98).met is False
