"""Rivals answer what they are asked."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.answer import answer
from proofs.challenge.contract import PUBLISHED, TERMS, VOCABULARY
from proofs.challenge.faults import laboratory
from proofs.challenge.faults.effects import FaultsCase
from proofs.challenge.first.rig import record
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.make import make
from proofs.challenge.reveal import reveal
from proofs.challenge.run import Limits, built_in, find
from proofs.diagnosers import classifier
from proofs.diagnosers.gaussian_process import _Process
from proofs.diagnosers.sindy import thresholded_least_squares
from proofs.diagnosers.ventbench import CALIBRATION, hypotheses
from ventbench.diagnosis.diagnose import with_effect


def test_the_project_enters_itself_and_its_rivals() -> None:
    assert built_in() == (
        "classifier",
        "gaussian_process",
        "refit",
        "sindy",
        "ventbench",
    )


def test_a_process_learns_a_smooth_discrepancy_and_tells_it_from_noise() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((120, 2))
    noise = 0.1 * rng.standard_normal(120)
    process = _Process(x, np.sin(x[:, 0]) + noise)
    new = rng.standard_normal((50, 2))
    assert np.abs(process.mean(new) - np.sin(new[:, 0])).mean() < 0.1
    assert process.evidence > 50.0
    assert process.scales[0] < process.scales[1], "only the first input matters"
    assert _Process(x, noise).evidence < 2.0


def test_sparse_regression_finds_the_terms_that_act() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((400, 6))
    y = 1.5 * x[:, 1] - 0.7 * x[:, 4] + 0.05 * rng.standard_normal(400)
    found = thresholded_least_squares(x, y, 0.2)
    assert np.flatnonzero(found).tolist() == [1, 4]
    np.testing.assert_allclose(found[[1, 4]], [1.5, -0.7], atol=0.02)
    assert not thresholded_least_squares(x, y, np.inf).any()
    assert not thresholded_least_squares(x, y, 2.0).any()


def test_a_classifier_weighs_sets_as_if_terms_were_independent() -> None:
    names, chances = ["cough", "leak", "valve_lag"], np.array([0.1, 0.6, 0.3])
    told = classifier.hypotheses(names, chances)
    found = {frozenset(each["terms"]): each["probability"] for each in told}
    assert len(found) == 8
    for chosen, probability in found.items():
        inside = np.isin(names, list(chosen))
        assert probability == pytest.approx(np.where(inside, chances, 1.0 - chances).prod())


def test_the_classifier_has_its_weights_and_sees_what_drifts() -> None:
    weights = classifier.load()
    terms = weights["terms"].tolist()  # those of the vocabulary when it was trained
    assert terms == sorted(terms)
    assert set(terms) <= set(TERMS)
    assert classifier.WEIGHTS.stat().st_size < 200_000
    drift = Effect("sensor_drift", "strong", "linear", {"drift": 3.0})
    lag = Effect("clock_offset", "strong", "plain", {"offset": 0.07})
    quiet = FaultsCase("", 20.0, 50.0, (), Base(20.0, 50.0), breaths=16, samples=84)
    cases = [replace(quiet, effects=effects) for effects in ((), (drift,), (lag,))]
    rows = [classifier.summaries(laboratory.record(c, np.random.default_rng(0))) for c in cases]
    chances = classifier.probabilities(weights, np.array(rows))
    for k, name in ((1, "sensor_drift"), (2, "clock_offset")):
        at = terms.index(name)
        assert chances[k, at] > 10.0 * chances[0, at]


def named(name: str, confidence: float = 1.0, *rivals: str, affected=None) -> dict[str, object]:
    about = {"confidence": confidence, "alternatives": list(rivals), "affected_breaths": affected}
    return {"name": name, **about}


def told(verdict: str, *mechanisms: str, **found) -> dict[frozenset[str], float]:
    given = {
        "verdict": verdict,
        "mechanisms": [named(name) for name in mechanisms],
        "slot": None,
        "changes": [],
        "saturated": None,
        "posterior": [{"terms": list(mechanisms), "probability": 1.0}],
    } | found
    answer = hypotheses(given, PUBLISHED)
    assert sum(each["probability"] for each in answer) == pytest.approx(1.0)
    assert all(TERMS.issuperset(each["terms"]) for each in answer)
    return {frozenset(each["terms"]): each["probability"] for each in answer}


def terms(*names: str) -> frozenset[str]:
    return frozenset(names)


def test_the_posterior_is_passed_on_beside_what_held_out_breaths_accept() -> None:
    accepted, sure = CALIBRATION.accepted, 1.0 - CALIBRATION.unsure
    silent = told("nothing_missing")
    assert silent[terms()] == pytest.approx(sure)
    assert silent[terms("unknown:lung")] == pytest.approx((1.0 - sure) / 9)
    two = [
        {"terms": ["leak", "recoil_shape"], "probability": 0.2},
        {"terms": ["valve_dead_band"], "probability": 0.6},
    ]
    both = told("named", "leak", posterior=two)
    assert both[terms("leak")] == pytest.approx(sure * accepted)
    assert both[terms("valve_dead_band")] == pytest.approx(sure * (1.0 - accepted) * 0.75)
    ratio = both[terms("valve_dead_band")] / both[terms("leak", "unknown:lung")]
    assert ratio == pytest.approx(3.0)
    changed = told("named", changes=[{"of": "gain", "drifts": False}], saturated={})
    assert changed[terms("gain_step", "saturation")] == pytest.approx(sure)


@pytest.mark.parametrize("searched", [{"valve_lag"}, set()])
def test_a_rival_of_an_effect_of_some_breaths_has_its_share(searched: set[str]) -> None:
    """Whether the search has found what held-out breaths accept beside it, or not."""
    share = (1.0 - CALIBRATION.unsure) * CALIBRATION.accepted
    lost = named("lost_commands", 0.6, "late_commands", affected=[2, 5])
    lag = named("valve_lag", 0.4, "valve_delay")
    beside = with_effect({frozenset(searched): 1.0}, "lost_commands", 0.6, ["late_commands"])
    weighed = [{"terms": list(each), "probability": p} for each, p in beside.items()]
    answer = told("named", mechanisms=[lost, lag], posterior=weighed)
    for effect, confidence in (("lost_commands", 0.6), ("late_commands", 0.4)):
        posterior = (1.0 - CALIBRATION.unsure) * (1.0 - CALIBRATION.accepted) * confidence
        expected = confidence * share + ("valve_lag" in searched) * posterior
        assert answer[terms(effect, "valve_lag")] == pytest.approx(expected)
    assert not answer.get(terms("lost_commands", "valve_delay"))  # its share is the posterior's


def test_rivals_of_a_name_share_what_held_out_breaths_accept() -> None:
    """Held-out breaths want one of two; which one, only the search has weighed."""
    weighed = [
        {"terms": list(each), "probability": probability}
        for each, probability in (((), 0.9), (("gain_step",), 0.06), (("gain_drift",), 0.03))
    ]
    step = named("gain_step", 0.06, "gain_drift")
    answer = told("named", mechanisms=[step], posterior=weighed)
    accepted = (1.0 - CALIBRATION.unsure) * CALIBRATION.accepted
    beside = (1.0 - CALIBRATION.unsure) * (1.0 - CALIBRATION.accepted) / 0.99
    assert answer[terms("gain_step")] == pytest.approx(2.0 / 3.0 * accepted + 0.06 * beside)
    assert answer[terms("gain_drift")] == pytest.approx(1.0 / 3.0 * accepted + 0.03 * beside)


def test_an_effect_without_a_name_is_at_its_places() -> None:
    slot = {"name": "f(t) at the supply", "places": {"f(t) at the supply": 3.0, "f(Q)": 1.0}}
    where = told("unnamed", slot=slot, posterior=[{"terms": ["supply_memory"], "probability": 1}])
    assert where[terms("unknown:supply")] > 3.0 * where[terms("unknown:airway")]
    nowhere = told("unnamed")
    assert nowhere[terms("unknown:lung")] == nowhere[terms("unknown:supply")]


def test_an_answer_is_not_longer_than_may_be() -> None:
    names = sorted(VOCABULARY)
    many = [{"terms": [one, other], "probability": 1.0} for one in names for other in names[:9]]
    assert len(told("nothing_missing", posterior=many)) == 100


@pytest.mark.slow
@pytest.mark.parametrize("name", built_in())
def test_every_diagnoser_answers_a_case(name: str, tmp_path) -> None:
    folder = ChallengeFolder(tmp_path / "c")
    make("rivals", folder.path, "masked", 1, record=partial(record, steps=8))
    assert answer(folder, find(name), limits=Limits(600.0, 16.0)) == {}
    (case,) = reveal([folder], ["rivals"], name).cases.values()
    assert case.inspiration < 5.0
