"""What strangers' recordings got wrong once: a test for each pattern, or where it is.

What laboratories' recordings got wrong stands in ``docs/missing_physics_method.md``.

Recordings here are those of the challenge's second generator, which shares no code with what is
fitted, with 16 breaths of 40 samples.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.stranger.effects import StrangerCase
from proofs.challenge.stranger.laboratory import record
from ventbench.diagnosis.hypothesis import FittedModel
from ventbench.task.lungs import lung

from . import small

HERE = Path(__file__).parent.parent

#: Rows of the table of the method page, ``|pattern|`file.py::test`, ...|``.
ROWS = re.findall(
    r"^\|(\d+)\. (.*?)\|(.*::.*)\|$",
    (HERE.parent / "docs" / "missing_physics_method.md").read_text("utf-8"),
    re.MULTILINE,
)

#: Pattern, and the tests that would fail if it came back.
PATTERNS = {what: tuple(re.findall("`(.*?)`", tests)) for _, what, tests in ROWS} | {
    "an inertance with its circuit is missed or misnamed": (
        "diagnosis/test_patterns.py::test_a_gas_that_rings_is_named",
    ),
    "corrected worse than given": (
        "diagnosis/test_corrected.py::test_whatever_the_candidates_no_lung_gets_worse",
        "diagnosis/test_corrected.py::test_the_refit_never_errs_more_than_the_label_whatever_the_start",
    ),
    "strengths that nothing has are named": (
        "diagnosis/test_plausibility.py::test_strengths",
        "diagnosis/test_patterns.py::test_a_lung_that_changes_makes_no_effort",
    ),
    "effects without a mechanism of their own": (
        "diagnosis/test_patterns.py::test_flow_that_falls_with_pressure_is_no_droop",
        "diagnosis/test_patterns.py::test_an_expiratory_valve_that_opens_slowly",
    ),
    "confusions in closed loop": (
        "diagnosis/test_patterns.py::test_a_late_expiratory_valve_in_closed_loop",
    ),
    "R and C that no lung has": (
        "mechanics/test_mechanics.py::test_what_no_lung_has_is_not_printed_but_explained",
    ),
    "a label that holds beside another": (
        "mechanics/test_mechanics.py::test_a_label_that_holds_is_named_first_among_what_the_lung_may_be",
        "mechanics/test_mechanics.py::test_the_label_comes_first_where_it_holds",
    ),
    "confidence that is none": (
        "diagnosis/test_plausibility.py::test_an_interval_around_zero_names_nothing",
        "diagnosis/test_selection.py::test_the_held_out_test_needs_enough_gain_from_more_than_one_breath",
        "diagnosis/test_report_text.py::test_what_stays_unexplained_is_told_first",
        "mechanics/test_mechanics.py::test_a_late_sensor_is_told_beside_the_circuit_that_would_do_the_same",
    ),
    "held-out breaths that a fit had seen": (
        "diagnosis/test_identification.py::test_breaths_that_judged_an_earlier_correction_judge_again",
        "diagnosis/test_identification.py::test_each_breath_has_one_use_where_there_are_enough",
    ),
    "commands that were lost become efforts": (
        "diagnosis/test_intermittent.py::test_commands_that_were_lost_are_found_and_followed",
    ),
    "a sentence that contradicts its chart": (
        "diagnosis/test_residual_analysis.py::test_sentence_and_chart_have_one_mean",
    ),
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_every_pattern_has_a_test(pattern):
    for place in PATTERNS[pattern]:
        file, _, name = place.partition("::")
        tree = ast.parse((HERE / file).read_text("utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_the_table_has_all_eleven_patterns():
    assert [int(number) for number, _, _ in ROWS] == list(range(1, 12))


def selected(
    where: str, *effects: Effect, closed_loop: bool = False, seed: int = 1, noise: float = 0.15
) -> FittedModel:
    """What is selected from a stranger's recording of a lung."""
    label = lung(where)
    case = StrangerCase(
        "",
        label.R,
        label.C,
        effects,
        base=Base(1.06 * label.R, 0.97 * label.C),
        noise=noise,
        breaths=small.BREATHS,
        samples=small.SAMPLES,
        inspiration=0.8,
        explored=0.0 if closed_loop else 0.5,
        proportional=4.0,
    )
    return small.concluded(record(case, np.random.default_rng(seed))).named


def effect(name: str, form: str, /, **parameters: float) -> Effect:
    return Effect(name, "strong", form, parameters)


def test_a_gas_that_rings_is_named():
    """From a usual start, its fit ends in another local minimum, and a lag of the valve wins."""
    ringing = effect("inertance", "library", inertance=0.13, circuit=0.9)
    named = selected("R20C50", ringing, noise=0.05)
    assert named.names == ("inertance",)
    assert named.column("inertance.inertance")[0] == pytest.approx(0.13, rel=0.05)
    assert named.column("inertance.tubing")[0] == pytest.approx(0.93, rel=0.05)


def test_a_sensor_of_second_order_has_two_lags():
    named = selected("R20C20", effect("sensor_lag", "second order", tau=0.1))
    assert named.names == ("sensor_lag",)
    assert named.column("sensor_lag.tau")[0] == pytest.approx(0.05, rel=0.3)
    assert named.column("sensor_lag.second")[0] == pytest.approx(0.05, rel=0.3)


def test_an_expiratory_valve_that_opens_slowly():
    """Not a dead time, and no ringing gas either."""
    named = selected("R20C50", effect("exhalation_valve_delay", "slow opening", opening=0.09))
    assert named.names == ("exhalation_valve_delay",)
    assert named.column("exhalation_valve_delay.slow")[0] > 0.8
    assert named.column("exhalation_valve_delay.opening")[0] == pytest.approx(0.063, rel=0.2)


def test_flow_that_falls_with_pressure_is_no_droop():
    named = selected("R50C20", effect("supply_back_pressure", "incompressible valve", supply=75.0))
    assert named.names == ("supply_pressure",)


def test_a_lung_that_changes_makes_no_effort():
    named = selected("R20C20", effect("compliance_change", "recruitment", change=0.35))
    assert named.names == ("compliance_drift",)
    assert named.column("compliance_drift.change")[0] == pytest.approx(0.35, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("drift", [0.0, 2.5])
def test_a_late_expiratory_valve_in_closed_loop(drift):
    """It drags no leak along, and stands beside a drift of the sensor."""
    late = effect("exhalation_valve_delay", "library", opening=0.09)
    also = (effect("sensor_drift", "library", drift=drift),) if drift else ()
    named = selected("R20C20", late, *also, closed_loop=True)
    assert set(named.names) == {late.name, *(e.name for e in also)}
    assert named.column("exhalation_valve_delay.opening")[0] == pytest.approx(0.09, abs=0.012)
