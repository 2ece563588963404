"""The evidence of sets of terms, against exact integrals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ventbench.diagnosis.evidence import Posterior, _integrated_out, evidence
from ventbench.diagnosis.in_time import _affected
from ventbench.diagnosis.linearised import Term, gaussian


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
        at, sizes = _affected(G, b, 1.0, 1.0)
        assert at.tolist() == acts
        assert np.all(sizes > 0.2)
    at, _ = _affected(G, rng.standard_normal(12), 1.0, 1.0)
    assert not len(at)


def test_what_acts_in_time_is_integrated_out_once_for_all_sets() -> None:
    rng = np.random.default_rng(5)
    X, y = rng.standard_normal((40, 9)), rng.standard_normal(40)
    G, b = X.T @ X, X.T @ y
    wide = Term("cough", [0.5] * 6, (3, 4, 5, 6, 7, 8), odds=-1.5)
    others = (Term("leak", [1.0], (0,)), Term("flow_shape", [0.3, 0.8], (1, 2)))
    value, left, rest = _integrated_out(G, b, wide)
    apart = value + evidence(left, rest, others)
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
