"""The evidence of sets of terms, against exact integrals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ventbench.diagnosis.evidence import Posterior, _marginalise, evidence
from ventbench.diagnosis.in_time import EXCHANGEABLE, _affected, command_p_value, phase_p_value
from ventbench.diagnosis.linearised import Term, gaussian
from ventbench.system_id.data import Data


def test_evidence_of_coefficients_is_that_of_the_marginal_density() -> None:
    rng = np.random.default_rng(3)
    X, y, sd = rng.standard_normal((20, 3)), rng.standard_normal(20), np.array([0.5, 1.0, 2.0])
    value, mean, sds = gaussian(X.T @ X, X.T @ y, sd)
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
        at, likely = _affected(G, b, 1.0, 1.0)
        assert at.tolist() == acts
        assert np.array_equal(np.flatnonzero(likely > 0.5), acts)
    at, _ = _affected(G, rng.standard_normal(12), 1.0, 1.0)
    assert not len(at)


def _commanded(peaks: np.ndarray) -> Data:
    """Breaths of one second with constant openings, %."""
    n, zeros = len(peaks), np.zeros((len(peaks), 30))
    lung = np.full(n, 20.0)
    measured = np.zeros((n, 1, 30))
    u_in = zeros + peaks[:, None]
    return Data(
        u_in, zeros, zeros + 0.033, measured, measured + 1.0, lung, lung, np.arange(n) / n, 0 * lung
    )


def test_breaths_that_commands_predict_are_no_event() -> None:
    """Chance predicts as much in one of a hundred sessions; a threshold on the command always."""
    rng, small = np.random.default_rng(6), []
    for _ in range(100):
        peaks, acts = rng.uniform(3.0, 100.0, 40), (rng.permutation(40) < 10).astype(float)
        pressure = peaks[:, None] + np.zeros(30)
        small.append(command_p_value(acts, _commanded(peaks), pressure))
        assert (
            command_p_value(np.where(peaks > 70.0, 0.9, 0.0), _commanded(peaks), pressure)
            < EXCHANGEABLE
        )
    assert np.mean(np.array(small) <= EXCHANGEABLE) <= 0.05


def test_swings_whose_sign_the_breath_predicts_are_none() -> None:
    rng, chance = np.random.default_rng(7), []
    for _ in range(50):
        peaks = rng.uniform(3.0, 100.0, 40)
        data, pressure = _commanded(peaks), peaks[:, None] + np.zeros(30)
        phase = rng.uniform(0.0, 2.0 * np.pi, 40)
        sizes = np.stack([np.sin(phase), np.cos(phase)], axis=1) * np.sqrt(peaks)[:, None]
        chance.append(phase_p_value(sizes, data, pressure))
        for same in (np.ones(40), (peaks - 50.0) / 25.0):
            sizes[:, 0] = same + 0.5 * rng.standard_normal(40)
            assert phase_p_value(sizes, data, pressure) < EXCHANGEABLE
    assert np.mean(np.array(chance) <= EXCHANGEABLE) <= 0.06


def test_what_acts_in_time_is_integrated_out_once_for_all_sets() -> None:
    rng = np.random.default_rng(5)
    X, y = rng.standard_normal((40, 9)), rng.standard_normal(40)
    G, b = X.T @ X, X.T @ y
    wide = Term("cough", [0.5] * 6, (3, 4, 5, 6, 7, 8), odds=-1.5)
    others = (Term("leak", [1.0], (0,)), Term("flow_shape", [0.3, 0.8], (1, 2)))
    value, information, rest = _marginalise(G, b, wide)
    apart = value + evidence(information, rest, others)
    assert apart == pytest.approx(evidence(G, b, (*others, wide)), abs=1e-9)


def test_odds_of_other_names_are_those_of_sets_that_differ_in_one() -> None:
    weights = {
        ("leak", "valve_lag"): 0.5,
        ("leak", "valve_delay"): 0.2,
        ("leak",): 0.1,
        ("valve_lag", "zero_step"): 0.05,
        ("valve_delay", "zero_step"): 0.15,
    }
    named = {frozenset(names): weight for names, weight in weights.items()}
    found = Posterior((), named)
    best = frozenset({"leak", "valve_lag"})
    assert found.swaps(best, "valve_lag") == pytest.approx({"valve_delay": 0.4})
    assert found.swaps(best, "leak") == pytest.approx({"zero_step": 0.1})
