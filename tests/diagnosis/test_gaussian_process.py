"""The marginal likelihood of a latent process, against exact and numerical integrals."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from ventbench.diagnosis.gaussian_process import (
    Kernel,
    LinearBreaths,
    components,
    likeliest_beside,
)
from ventbench.system_id import Noise

BREATHS, SAMPLES = 3, 24
DT = np.full((BREATHS, SAMPLES), 0.03)
GAUSSIAN = Noise((0.3,), (0.5,), np.inf)
HUBER = dataclasses.replace(GAUSSIAN, tail=3.0)


def breaths(own: int = 0, outliers: int = 0, seed: int = 0) -> LinearBreaths:
    """Residuals with one reading missing; those of own parameters decay as a start does."""
    rng = np.random.default_rng(seed)
    residual = 0.6 * rng.standard_normal((BREATHS, 1, SAMPLES))
    for k in range(outliers):
        residual[k % BREATHS, 0, 5 + 4 * k] += 6.0
    weight = np.ones_like(residual)
    weight[1, 0, 9] = 0.0
    slopes = np.exp(-np.arange(SAMPLES) / 6.0) * weight[:, None] * np.ones((1, own, 1, 1))
    none = np.zeros((BREATHS, own))
    return LinearBreaths(residual * weight, slopes, none, none, weight)


def acting(parts: np.ndarray) -> np.ndarray:
    """Components that add to the pressure as they are, ``(n, K, 1, T)``."""
    return parts[:, :, None]


def covariance(noise: Noise, weight: np.ndarray) -> np.ndarray:
    """Of one breath's noise; a missing reading separates what is correlated."""
    sample, run = np.arange(SAMPLES), np.cumsum(weight == 0.0)
    decay = noise.ar[0] ** np.abs(sample[:, None] - sample)
    return noise.sigma[0] ** 2 * np.where(run[:, None] == run, decay, 0.0)


@pytest.mark.parametrize("kernel", [Kernel(True, 1.3), Kernel(False, 0.08)])
def test_the_components_have_the_covariance_of_their_kernel(kernel):
    parts = components(DT, kernel, 1e-9)
    lag = np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES)) * 0.03
    expected = (
        np.cos(2.0 * np.pi * kernel.scale * lag)
        if kernel.periodic
        else np.exp(-0.5 * (lag / kernel.scale) ** 2)
    )
    np.testing.assert_allclose(parts[0].T @ parts[0], expected, atol=1e-6)


@pytest.mark.parametrize("kernel", [Kernel(True, 1.3), Kernel(False, 0.08)])
@pytest.mark.parametrize("size", [0.05, 0.8])
def test_under_gaussian_noise_it_is_a_multivariate_normal(kernel, size):
    given, parts = breaths(), components(DT, kernel, 1e-9)
    found = given.whitened(GAUSSIAN, acting(parts)).marginal(size).nats
    for i in range(BREATHS):
        seen = given.weight[i, 0] > 0
        total = covariance(GAUSSIAN, given.weight[i, 0]) + size**2 * parts[i].T @ parts[i]
        exact = stats.multivariate_normal(cov=total[np.ix_(seen, seen)])
        assert found[i] == pytest.approx(exact.logpdf(given.residual[i, 0, seen]), abs=1e-6)


def test_a_start_of_its_own_is_integrated_out_of_a_breath_with_and_without_the_process():
    """Under Gaussian noise and a flat prior, both integrals have a closed form."""
    given, parts, size = breaths(own=1), components(DT, Kernel(False, 0.08), 1e-9), 0.8
    found = given.whitened(GAUSSIAN, acting(parts)).marginal(size).nats
    without = given.whitened(GAUSSIAN).marginal(size).nats
    for i in (0, 2):  # no reading is missing
        noise = covariance(GAUSSIAN, given.weight[i, 0])
        total = noise + size**2 * parts[i].T @ parts[i]
        r, s = given.residual[i, 0], given.slopes[i, 0, 0]

        def integral(covariance, r=r, s=s):
            power = s @ np.linalg.solve(covariance, s)
            left = r - s * (s @ np.linalg.solve(covariance, r)) / power
            normal = stats.multivariate_normal(cov=covariance)
            return normal.logpdf(left) + 0.5 * np.log(2.0 * np.pi / power)

        assert found[i] - without[i] == pytest.approx(integral(total) - integral(noise), abs=1e-4)


@pytest.mark.parametrize("outliers", [0, 3])
def test_under_tailed_noise_it_is_near_the_integral_over_one_number(outliers):
    given, size = breaths(outliers=outliers), 0.7
    response = np.sin(np.arange(SAMPLES) / 5.0) * np.ones((BREATHS, 1, 1))
    found = given.whitened(HUBER, acting(response)).marginal(size).nats
    for i in range(BREATHS):

        def density(c, i=i):
            residual = given.residual[i : i + 1] + c * response[i] * given.weight[i : i + 1]
            nats = HUBER.log_likelihood(residual, given.weight[i : i + 1])[0]
            return np.exp(nats - found[i]) * stats.norm.pdf(c, scale=size)

        integral = integrate.quad(density, -6.0, 6.0, points=(-1.0, 0.0, 1.0), limit=200)[0]
        assert np.log(integral) == pytest.approx(0.0, abs=0.1)


def test_without_a_process_it_is_the_likelihood_of_the_noise():
    given = breaths(outliers=3)
    found = given.whitened(HUBER).marginal(1.0).nats
    np.testing.assert_allclose(
        found, HUBER.log_likelihood(given.residual, given.weight), rtol=0, atol=1e-9
    )
    tiny = (
        given.whitened(HUBER, acting(components(DT, Kernel(False, 0.08), 1e-2))).marginal(1e-6).nats
    )
    np.testing.assert_allclose(tiny, found, atol=1e-6)


def test_bounds_at_several_sizes_are_exact_under_gaussian_noise_and_below_it_under_tailed():
    given, parts = breaths(own=1, outliers=3), components(DT, Kernel(False, 0.08), 1e-2)
    sizes = np.array([0.2, 0.8])
    for noise in (GAUSSIAN, HUBER):
        whitened = given.whitened(noise, acting(parts))
        found = [whitened.marginal(size) for size in sizes]
        exact = np.array([value.nats.sum() for value in found])
        own = whitened.bounds(sizes, whitened.left(found[1].coefficients))
        far = whitened.bounds(sizes, whitened.white)
        if noise is GAUSSIAN:
            np.testing.assert_allclose([own, far], [exact, exact], atol=1e-6)
        else:
            assert np.all(own < exact)
            assert np.all(far < exact)
            assert own[1] > far[1] + 1.0
            assert own[1] > exact[1] - 2.0


def test_shared_parameters_beside_a_process_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(3)
    given, parts, size = breaths(seed=5), components(DT, Kernel(False, 0.2), 1e-9), 0.8
    slopes = rng.standard_normal((BREATHS, 2, 1, SAMPLES)) * given.weight[:, None]
    none = np.zeros((BREATHS, 2))
    given = dataclasses.replace(given, slopes=slopes, precision=none, displacement=none)
    # The first parameter is shared by all breaths, the second is each breath's own.
    index = np.stack([np.zeros(BREATHS, int), 1 + np.arange(BREATHS)], axis=1)
    far = np.full(1 + BREATHS, 50.0)
    problem: Any = SimpleNamespace(
        noise=GAUSSIAN,
        unknowns=SimpleNamespace(index=index, path_of=far, bounds=lambda: (-far, far)),
    )
    x = np.zeros(1 + BREATHS)
    found = likeliest_beside(problem, x, given, acting(parts), size)
    normal, right = np.zeros((len(x), len(x))), np.zeros(len(x))
    for i in range(BREATHS):
        seen = given.weight[i, 0] > 0
        total = covariance(GAUSSIAN, given.weight[i, 0]) + size**2 * parts[i].T @ parts[i]
        inverse = np.linalg.inv(total[np.ix_(seen, seen)])
        rows = slopes[i, :, 0, seen]  # samples first
        normal[np.ix_(index[i], index[i])] += rows.T @ inverse @ rows
        right[index[i]] += rows.T @ inverse @ given.residual[i, 0, seen]
    np.testing.assert_allclose(found, -np.linalg.solve(normal, right), atol=1e-6)
    # Without the process, the same parameters are others.
    assert np.abs(likeliest_beside(problem, x, given) - found).max() > 0.01
