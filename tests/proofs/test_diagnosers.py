"""Rivals answer what they are asked."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.answer import answer
from proofs.challenge.faults import laboratory
from proofs.challenge.faults.effects import FaultsCase
from proofs.challenge.first.rig import record
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.make import make
from proofs.challenge.reveal import reveal
from proofs.challenge.run import Limits, built_in, find
from proofs.challenge.vocabulary import PUBLISHED, TERMS, VOCABULARY
from proofs.diagnosers import classifier, evidence, lisdd
from proofs.diagnosers.common import Templates
from proofs.diagnosers.gaussian_process import _Process
from proofs.diagnosers.sindy import thresholded_least_squares
from proofs.diagnosers.ventbench import Calibration, hypotheses


def test_the_project_enters_itself_and_its_rivals() -> None:
    assert built_in() == (
        "classifier", "evidence", "forward_search", "gaussian_process", "lisdd", "refit", "sindy",
        "ventbench",
    )  # fmt: skip


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


def test_energy_is_found_in_the_region_that_has_it() -> None:
    rng = np.random.default_rng(1)
    regions = np.tile(np.repeat(np.arange(8), 25), (40, 1))
    residual = 0.1 * rng.standard_normal(regions.shape)
    residual[regions == 5] *= 3.0
    model = Templates(
        residual, residual, residual, np.ones(regions.shape), residual[None], {"leak": residual}
    )
    guilty, noise = lisdd._energy(model, regions)
    assert guilty == {5}
    assert noise == pytest.approx(0.1, rel=0.1)


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
    assert weights["terms"].tolist() == sorted(TERMS)
    assert classifier.WEIGHTS.stat().st_size < 200_000
    drift = Effect("sensor_drift", "strong", "linear", {"drift": 3.0})
    lag = Effect("clock_offset", "strong", "plain", {"offset": 0.07})
    quiet = FaultsCase("", 20.0, 50.0, (), Base(20.0, 50.0), breaths=16, samples=84)
    cases = [replace(quiet, effects=effects) for effects in ((), (drift,), (lag,))]
    rows = [classifier.summaries(laboratory.record(c, np.random.default_rng(0))) for c in cases]
    chances = classifier.probabilities(weights, np.array(rows))
    for k, name in ((1, "sensor_drift"), (2, "clock_offset")):
        at = sorted(TERMS).index(name)
        assert chances[k, at] > 10.0 * chances[0, at]


def test_evidence_of_coefficients_is_that_of_the_marginal_density() -> None:
    rng = np.random.default_rng(3)
    X, y, sd = rng.standard_normal((20, 3)), rng.standard_normal(20), np.array([0.5, 1.0, 2.0])
    value, mean, sds = evidence.gaussian(X.T @ X, X.T @ y, sd)
    spread = np.eye(20) + X * sd**2 @ X.T
    _, log_volume = np.linalg.slogdet(2.0 * np.pi * spread)
    marginal = -0.5 * (y @ np.linalg.solve(spread, y) + log_volume)
    assert value == pytest.approx(marginal - stats.norm.logpdf(y).sum())
    precision = X.T @ X + np.diag(sd**-2)
    np.testing.assert_allclose(mean, np.linalg.solve(precision, X.T @ y))
    np.testing.assert_allclose(sds, np.sqrt(np.diag(np.linalg.inv(precision))))


def test_an_event_is_found_in_the_breaths_that_it_affects() -> None:
    rng = np.random.default_rng(4)
    for acts in ([2, 5, 6], [0, 1, 2, 3, 4, 6, 7, 8, 9, 11]):
        size = np.isin(np.arange(12), acts) * rng.uniform(0.7, 1.3, 12)
        G = 40.0 * (np.eye(12) - 0.8 / 12)  # their mean is hardly known
        b = G @ size + rng.standard_normal(12)
        at, sizes = evidence.affected(G, b, 1.0, 1.0)
        assert at.tolist() == acts
        assert np.all(sizes > 0.2)
    at, _ = evidence.affected(G, rng.standard_normal(12), 1.0, 1.0)
    assert not len(at)


SHARES = Calibration(nothing=0.9, named=0.8, placed=0.7, alone=0.25, foreign=0.6, doubt=2.0)


def shares_of(verdict: str, *mechanisms: dict, **found) -> dict[frozenset[str], float]:
    given = {"verdict": verdict, "mechanisms": mechanisms, "slot": None, "changes": [],
             "saturated": None, "open_loop": {"unexplained": 0.1, "noise_floor": 0.2},
             } | found  # fmt: skip
    told = hypotheses(given, PUBLISHED, SHARES)
    assert sum(each["probability"] for each in told) == pytest.approx(1.0)
    assert all(TERMS.issuperset(each["terms"]) for each in told)
    return {frozenset(each["terms"]): each["probability"] for each in told}


def named(name: str, confidence: float = 1.0, *alternatives: str) -> dict:
    return {"name": name, "confidence": confidence, "alternatives": list(alternatives)}


def terms(*names: str) -> frozenset[str]:
    return frozenset(names)


def test_a_verdict_has_its_share_and_what_it_may_have_missed_the_rest() -> None:
    silent = shares_of("nothing_missing")
    assert silent[terms()] == pytest.approx(0.9)
    assert silent[terms("cough")] == silent[terms("lost_commands")] == pytest.approx(0.06 / 8)
    assert silent[terms("unknown:lung")] == pytest.approx(0.04 / 9)
    told = shares_of("named", named("leak", 0.75, "valve_dead_band"))
    assert told[terms("leak")] == pytest.approx(0.8 * 0.75)
    assert told[terms("valve_dead_band")] == pytest.approx(0.8 * 0.25)
    assert told[terms("leak", "cough")] == told[terms("cough")] == pytest.approx(0.1 * 0.6 / 8)
    assert terms() not in told
    alike = shares_of("named", named("viscoelasticity", 0.6, "second_compartment"))
    assert alike[terms("viscoelasticity")] == pytest.approx(0.8), "the other has no name here"
    changed = shares_of("named", changes=[{"of": "gain", "drifts": False}], saturated={})
    assert changed[terms("gain_step", "saturation")] == pytest.approx(0.8)


def test_what_stays_unexplained_speaks_against_a_verdict_that_leaves_nothing_open() -> None:
    for verdict, names, share in (("named", [named("leak")], 0.8), ("nothing_missing", [], 0.9)):
        large = {"open_loop": {"unexplained": 0.6, "noise_floor": 0.2}}
        told = shares_of(verdict, *names, **large)[terms(*(each["name"] for each in names))]
        assert told / (1.0 - told) == pytest.approx(share / (1.0 - share) / 9.0)


def test_a_place_without_a_name_may_be_a_name_without_a_hypothesis() -> None:
    slot = {"name": "f(t) at the supply", "places": {"f(t) at the supply": 3.0, "f(Q)": 1.0}}
    told = shares_of("unnamed", slot=slot)
    rest = 0.3 * 0.75  # and a quarter of it: nothing is missing
    assert told[terms()] == pytest.approx(0.3 * 0.25)
    assert told[terms("supply_ripple")] == pytest.approx(0.7 * 0.75 * 0.6 + rest * 0.6 / 8)
    assert told[terms("unknown:supply")] == pytest.approx(0.7 * 0.75 * 0.4 + rest * 0.4 / 9)
    assert told[terms("secretions")] == pytest.approx(0.7 * 0.25 * 0.6 + rest * 0.6 / 8)
    assert told[terms("cough")] == pytest.approx(rest * 0.6 / 8)
    beside = shares_of("named", named("leak"), slot={"name": "nowhere", "places": {}})
    assert beside[terms("leak")] == pytest.approx(0.3 * 0.25)
    assert beside[terms("leak", "unknown:airway")] > beside[terms("unknown:airway")]


def test_an_answer_is_not_longer_than_may_be() -> None:
    names = sorted(VOCABULARY)
    many = [named(names[k], 0.3, *names[k + 1 : k + 4]) for k in (0, 4, 8)]
    every = ("f(p)", "f(Q)", "f(V)", "measurement", "f(t) at the supply", "exhalation path")
    assert 100 < len(shares_of("named", *many, slot={"places": dict.fromkeys(every, 1.0)})) <= 500


def test_an_effect_without_name_and_place_is_a_set() -> None:
    told = shares_of("unnamed")
    assert told[terms()] == pytest.approx(0.25)
    assert told[terms("cough")] == told[terms("circuit_water")] == pytest.approx(0.75 * 0.6 / 8)


@pytest.mark.slow
@pytest.mark.parametrize("name", built_in())
def test_every_diagnoser_answers_a_case(name: str, tmp_path) -> None:
    folder = ChallengeFolder(tmp_path / "c")
    make("rivals", folder.path, "masked", 1, record=partial(record, steps=8))
    assert answer(folder, find(name), limits=Limits(600.0, 16.0)) == {}
    (case,) = reveal([folder], ["rivals"], name).cases.values()
    assert case.inspiration < 5.0
