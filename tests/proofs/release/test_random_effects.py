"""Mixed model of units: known truth, the textbook's closed form, and left-out units."""

from __future__ import annotations

import numpy as np
import pytest

from proofs.release.population import Prior, Units, fit_mixed, surprise


def prior(p: int, q: int, *, units: float = 0.0, uncorrelated: float = 0.0) -> Prior:
    return Prior(np.ones(p), np.full(p, units), uncorrelated, np.zeros(q), np.full(q, 1e3))


def units_of(estimates: np.ndarray, errors: np.ndarray, groups: int = 1) -> Units:
    count, p = estimates.shape
    information = np.linalg.inv(errors)
    design = np.zeros((count, p, groups * p))
    for j in range(count):
        at = (j % groups) * p
        design[j, :, at : at + p] = np.eye(p)
    return Units(information, (information @ estimates[..., None])[..., 0], design)


def drawn(rng, count: int, truth: np.ndarray, groups: int = 1) -> tuple[Units, np.ndarray]:
    p = len(truth)
    theta = rng.multivariate_normal(np.zeros(p), truth, count)
    theta += 3.0 * (np.arange(count) % groups)[:, None]
    root = rng.normal(size=(count, p, p))
    errors = 0.3 * root @ root.transpose(0, 2, 1) + 0.1 * np.eye(p)
    noise = np.array([rng.multivariate_normal(np.zeros(p), own) for own in errors])
    return units_of(theta + noise, errors, groups), theta


def test_equal_errors_give_the_textbooks_variance():
    # Balanced case: restricted maximum likelihood is the sample variance less that of the errors.
    rng = np.random.default_rng(0)
    estimates = rng.normal(2.0, 1.5, (12, 1))
    found = fit_mixed(units_of(estimates, np.full((12, 1, 1), 0.4)), prior(1, 1), iterations=2000)
    assert found.beta[0] == pytest.approx(estimates.mean(), rel=1e-5)
    assert found.covariance[0, 0] == pytest.approx(estimates.var(ddof=1) - 0.4, rel=1e-4)


def test_truth_is_found_where_naive_covariance_is_too_wide():
    truth = np.array([[1.0, 0.6], [0.6, 0.8]])
    units, theta = drawn(np.random.default_rng(1), 600, truth, groups=3)
    found = fit_mixed(units, prior(2, 6))
    np.testing.assert_allclose(found.covariance, truth, atol=0.15)
    error = np.sqrt(found.beta_covariance.diagonal())
    assert np.all(np.abs(found.beta - np.repeat([0.0, 3.0, 6.0], 2)) < 4.0 * error)
    estimates = np.linalg.solve(units.information, units.weighted[..., None])[..., 0]
    apart = estimates - (units.design @ found.beta)
    assert np.trace(np.cov(apart.T)) > 1.25 * np.trace(truth)
    # Posterior means are nearer to the truth than the estimates.
    assert np.mean((found.units - theta) ** 2) < 0.8 * np.mean((estimates - theta) ** 2)


def test_marginal_likelihood_is_stationary():
    # Independent oracle: the restricted likelihood itself, by numpy, falls in every direction.
    units, _ = drawn(np.random.default_rng(2), 40, np.diag([1.0, 0.5]))
    found = fit_mixed(units, prior(2, 2), iterations=3000)

    def restricted(covariance: np.ndarray) -> float:
        errors = np.linalg.inv(units.information)
        estimates = (errors @ units.weighted[..., None])[..., 0]
        weight = np.linalg.inv(errors + covariance)
        normal = weight.sum(axis=0) + 1e-6 * np.eye(2)
        beta = np.linalg.solve(normal, (weight @ estimates[..., None])[..., 0].sum(axis=0))
        off = estimates - beta
        value = np.linalg.slogdet(errors + covariance)[1].sum() + np.linalg.slogdet(normal)[1]
        return -0.5 * (value + np.einsum("jp,jpq,jq->", off, weight, off))

    best = restricted(found.covariance)
    for direction in (np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])):
        for sign in (-0.03, 0.03):
            assert restricted(found.covariance + sign * direction) < best


def test_a_direction_without_information_keeps_its_given_scale():
    units, _ = drawn(np.random.default_rng(3), 30, np.eye(2))
    blind = units.information.copy()
    blind[:, 1], blind[:, :, 1] = 0.0, 0.0
    weighted = units.weighted * [1.0, 0.0]
    given = Prior(np.array([1.0, 0.2]), np.array([2.0, np.inf]), 3.0, np.zeros(2), np.ones(2))
    found = fit_mixed(Units(blind, weighted, units.design), given)
    assert np.sqrt(found.covariance[1, 1]) == pytest.approx(0.2)
    assert abs(found.covariance[0, 1]) < 1e-6


def test_few_units_give_a_covariance_of_full_rank_with_correlations_shrunk():
    rng = np.random.default_rng(4)
    truth = np.full((5, 5), 0.9) + 0.1 * np.eye(5)
    units, _ = drawn(rng, 4, truth)
    weak, strong = (fit_mixed(units, prior(5, 5, units=2.0, uncorrelated=k)) for k in (1.0, 1e6))
    for found in (weak, strong):
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    off = strong.covariance - np.diag(strong.covariance.diagonal())
    assert (
        np.abs(off).max()
        < 1e-3
        < np.abs(weak.covariance - np.diag(weak.covariance.diagonal())).max()
    )


def test_left_out_units_are_inside_as_often_as_said_and_odd_ones_are_not():
    units, _ = drawn(np.random.default_rng(5), 150, np.array([[1.0, 0.3], [0.3, 0.5]]))
    everything = fit_mixed(units, prior(2, 2), iterations=60)
    shares = [surprise(units, j, everything) for j in range(150)]
    assert np.mean(np.array(shares) < 0.9) == pytest.approx(0.9, abs=0.06)
    odd = units.weighted.copy()
    odd[7] += units.information[7] @ [8.0, -8.0]
    moved = Units(units.information, odd, units.design)
    assert surprise(moved, 7, fit_mixed(moved.excluding(7), prior(2, 2), iterations=60)) > 0.999
