"""Derivatives, likelihood, noise and search, each against something independent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy import optimize, stats

from tests.physics import cases
from ventbench.base.errors import InputError
from ventbench.system_id import Noise, Unknowns, fit, make_data, make_unknowns, robust_noise
from ventbench.system_id.fit import t_quantile
from ventbench.system_id.levenberg_marquardt import minimise

M = {"valve_lag": {"tau": 0.05}, "viscoelasticity": {"ratio": 0.4, "time": 0.8}}


@pytest.fixture(scope="module")
def found():
    return fit(make_data(cases.recording(8, M, noise=0.2, seed=4)), M)


def test_gradient_and_jacobian(found):
    problem = found.problem
    x = found.minimum.x + np.random.default_rng(0).normal(0, 0.01, len(found.minimum.x))
    _, gradient, _ = problem.normal(x)
    residual, slopes = problem.jacobian(x)
    np.testing.assert_allclose(residual, problem.residual(x), atol=1e-12)
    for unknown in (0, 1, 4, 5, 6, 9):
        step = np.zeros_like(x)
        step[unknown] = 1e-6
        numeric = (problem.cost(x + step) - problem.cost(x - step)) / 2e-6
        assert gradient[unknown] == pytest.approx(numeric, rel=1e-4, abs=1e-3)
        moved = (problem.residual(x + step) - problem.residual(x - step)) / 2e-6
        column = int(problem.unknowns.path_of[unknown])
        mine = problem.unknowns.index[:, column] == unknown
        # One-sided differences: exact to a millionth of the column's largest slope.
        atol = 1e-6 * np.abs(moved[mine]).max()
        np.testing.assert_allclose(slopes[mine, column], moved[mine], atol=atol)
        assert np.all(moved[~mine] == 0)


def test_same_optimum_as_scipy(found):
    """Gaussian noise; scipy's trust region from the labels, over the same residuals."""
    noise = Noise((0.2,), (0.0,), np.inf)
    mine = fit(found.problem.data, M, noise=noise)
    problem = mine.problem
    index = problem.unknowns.index

    def residual(x):
        prior = np.sqrt(problem.precision) * (x - problem.mean)
        white = noise.whiten(problem.residual(x), problem.data.weight)
        return np.concatenate([white.ravel(), prior])

    def jacobian(x):
        rows = noise.whiten(problem.jacobian(x)[1], problem.data.weight)
        full = np.zeros((rows.shape[0], *rows.shape[2:], len(x)))
        for i, columns in enumerate(index):
            full[i][..., columns] = np.moveaxis(rows[i], 0, -1)
        prior = np.diag(np.sqrt(problem.precision))
        return np.concatenate([full.reshape(-1, len(x)), prior])

    low, high = problem.unknowns.bounds()
    start = np.clip(mine.minimum.x * 1.05 + 0.02, low, high)
    search = cast(Any, optimize.least_squares)  # whose types know no function as `jac`
    theirs = search(residual, start, jac=jacobian, bounds=(low, high), x_scale="jac")
    assert mine.minimum.cost == pytest.approx(theirs.cost, abs=2e-3)


@pytest.mark.parametrize(("ar", "slow"), [(0.6, 1.0), (0.9, 0.7), (0.0, 1.0)])
def test_likelihood_against_the_whole_covariance(ar, slow):
    """A sample that is not measured does not count, wherever it lies."""
    rng = np.random.default_rng(1)
    noise = Noise((0.3,), (ar,), np.inf, (slow,))
    lag = np.abs(np.subtract.outer(np.arange(20), np.arange(20)))
    cov: Any = 0.09 * (slow * ar**lag + (1.0 - slow) * np.eye(20))
    residual = rng.multivariate_normal(np.zeros(20), cov, size=3)[:, None]
    for weight in (np.ones((3, 1, 20)), (rng.random((3, 1, 20)) < 0.7).astype(float)):
        expected = []
        for r, kept in zip(residual[:, 0], weight[:, 0] > 0, strict=True):
            some = cov[np.ix_(kept, kept)]
            expected.append(stats.multivariate_normal.logpdf(r[kept], np.zeros(kept.sum()), some))
        np.testing.assert_allclose(noise.log_likelihood(residual * weight, weight), expected)


def test_noise_is_a_density():
    grid = np.linspace(-60, 60, 200_001)
    for tail in (1.0, 3.0):
        noise = Noise((1.0,), (0.0,), tail)
        density = np.exp(-noise.loss(grid) - noise.log_norm())
        assert np.trapezoid(density, grid) == pytest.approx(1.0, abs=1e-6)
        slope = np.gradient(noise.loss(grid), grid)
        np.testing.assert_allclose(slope, noise.influence(grid) * grid, atol=1e-3)


def test_noise_is_estimated_in_spite_of_misfits():
    rng = np.random.default_rng(2)
    apart = np.abs(np.subtract.outer(np.arange(80), np.arange(80)))
    for ar, slow in ((0.5, 1.0), (0.9, 0.6)):
        cov = 0.04 * (slow * ar**apart + (1.0 - slow) * np.eye(80))
        residual = rng.multivariate_normal(np.zeros(80), cov, size=80)[:, None]
        residual[:3] += 4.0
        noise = robust_noise(residual, np.ones_like(residual))
        assert noise.sigma[0] == pytest.approx(0.2, rel=0.15)
        for lag in (1, 2, 4):
            told = noise.slow[0] * noise.ar[0] ** lag
            assert told == pytest.approx(slow * ar**lag, abs=0.08)


def test_noise_of_every_second_sample_is_that_of_its_readings():
    rng = np.random.default_rng(2)
    apart = np.abs(np.subtract.outer(np.arange(80), np.arange(80)))
    residual = rng.multivariate_normal(np.zeros(80), 0.04 * 0.9**apart, size=80)[:, None]
    weight = np.zeros_like(residual)
    weight[..., ::2] = 1.0
    noise = robust_noise(residual * weight, weight)
    for lag in (2, 4, 8):
        assert noise.slow[0] * noise.ar[0] ** lag == pytest.approx(0.9**lag, abs=0.08)
    readings = residual[..., ::2]
    alone = robust_noise(readings, np.ones_like(readings))
    assert noise.autocorrelation_time(weight) == pytest.approx(
        alone.autocorrelation_time(np.ones_like(readings)), rel=0.2
    )


def test_outlying_breaths_do_not_move_a_robust_fit(found):
    data = found.problem.data
    seen = data.measured.copy()
    seen[3, :, 5:30] += 6.0
    spoilt = fit(replace(data, measured=seen), M, noise=found.problem.noise)
    plain = fit(replace(data, measured=seen), M, noise=replace(found.problem.noise, tail=np.inf))
    truth = found.value("C")[0]
    assert abs(spoilt.value("C")[0] - truth) < 0.5 * abs(plain.value("C")[0] - truth)


def test_minimise_stops_at_bounds():
    """Rosenbrock's valley, whose minimum (1, 1) lies outside; at x = 0.5 it is y = 0.25."""

    def residual(x):
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def normal(x):
        rows = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
        r = residual(x)
        return float(0.5 * r @ r), rows.T @ r, rows.T @ rows

    def run(high):
        low, high = np.full(2, -2.0), np.asarray(high)
        return minimise(
            lambda x: float(0.5 * residual(x) @ residual(x)),
            normal,
            np.array([-1.2, 1.0]),
            low,
            high,
            tolerance=1e-10,
            iterations=100,
        )

    free = run([3.0, 3.0])
    assert free.converged
    np.testing.assert_allclose(free.x, [1.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(run([0.5, 3.0]).x, [0.5, 0.25], atol=1e-4)


@pytest.mark.parametrize("freedom", [1, 2, 4, 5, 10, 40, 1000])
def test_quantile(freedom):
    assert t_quantile(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-12)


def test_layout_and_its_errors(found):
    data = found.problem.data
    layout = make_unknowns(data, ("R", "gain", "start"), {"gain": np.arange(8) // 4})
    assert isinstance(layout, Unknowns)
    assert len(layout.of("R")) == 1
    assert len(layout.of("gain")) == 2
    assert layout.shared.sum() == 3
    x = layout.pack({"R": 12.0, "gain": np.repeat([20.0, 25.0], 4), "start": np.arange(8.0)})
    back = layout.unpack(x)
    np.testing.assert_allclose(back[:, 0], 12.0)
    np.testing.assert_allclose(back[:, 1], np.repeat([20.0, 25.0], 4))
    np.testing.assert_allclose(back[:, 2], np.arange(8.0))
    with pytest.raises(InputError, match="freed twice"):
        make_unknowns(data, ("R", "R"))
    with pytest.raises(InputError, match="groups of R"):
        make_unknowns(data, ("R",), {"R": [0, 1]})


def test_recordings_that_cannot_be_fitted():
    breaths = cases.recording(2, {})
    with pytest.raises(InputError, match="no breaths"):
        make_data(breaths.select([]))
    with pytest.raises(InputError, match="no flow"):
        make_data(replace(breaths, flow=None), flow=True)
    with pytest.raises(InputError, match="no pressure"):
        make_data(replace(breaths, pressure=np.full_like(breaths.pressure, np.nan)))
