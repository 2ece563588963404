"""The bounded Levenberg-Marquardt method against scipy's, on problems with known residuals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from ventbench.system_id.levenberg_marquardt import minimise

TIMES = np.linspace(0.0, 4.0, 25)


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def rosenbrock_jacobian(x):
    return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])


def decay(x):
    """Residuals of an exponential with an offset; the data have a small systematic error."""
    data = 3.0 * np.exp(-0.8 * TIMES) + 0.5 + 0.05 * np.sin(7.0 * TIMES)
    return x[0] * np.exp(-x[1] * TIMES) + x[2] - data


def decay_jacobian(x):
    fading = np.exp(-x[1] * TIMES)
    return np.stack([fading, -x[0] * TIMES * fading, np.ones_like(TIMES)], axis=1)


def search(residual, jacobian, start, low, high, **options):
    def cost(x):
        return 0.5 * float(residual(x) @ residual(x))

    def normal(x):
        return cost(x), jacobian(x).T @ residual(x), jacobian(x).T @ jacobian(x)

    low, high = np.array(low, float), np.array(high, float)
    return minimise(cost, normal, np.array(start, float), low, high, **options)


@pytest.mark.parametrize(
    ("residual", "jacobian", "start", "low", "high"),
    [
        (rosenbrock, rosenbrock_jacobian, [-1.2, 1.0], [-5.0, -5.0], [5.0, 5.0]),
        (rosenbrock, rosenbrock_jacobian, [-1.2, 0.3], [-5.0, -5.0], [0.6, 5.0]),
        (decay, decay_jacobian, [1.0, 0.1, 0.0], [0.0, 0.0, -1.0], [9.0, 9.0, 1.0]),
        (decay, decay_jacobian, [1.0, 0.1, 0.0], [0.0, 0.0, -1.0], [2.0, 9.0, 0.4]),
    ],
    ids=["valley", "valley with a bound", "decay", "decay with two bounds"],
)
def test_the_minimum_is_that_of_scipy(residual, jacobian, start, low, high):
    found = search(residual, jacobian, start, low, high, tolerance=1e-10, iterations=300)
    expected = optimize.least_squares(
        residual, start, jacobian, (low, high), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert found.converged
    np.testing.assert_allclose(found.x, expected.x, rtol=1e-4, atol=1e-5)
    assert found.cost == pytest.approx(expected.cost, rel=1e-6, abs=1e-9)


def test_a_start_beyond_the_bounds_is_moved_into_them():
    found = search(decay, decay_jacobian, [99.0, 99.0, 99.0], [0.0] * 3, [9.0, 9.0, 1.0])
    assert np.all(found.x <= [9.0, 9.0, 1.0])
    assert found.cost < 0.1


def test_too_few_iterations_are_reported():
    found = search(
        rosenbrock, rosenbrock_jacobian, [-1.2, 1.0], [-5.0] * 2, [5.0] * 2, iterations=3
    )
    assert not found.converged
    assert found.iterations == 3


def test_infinite_costs_are_steps_too_far():
    """A cost that is defined for positive values only."""

    def cost(x):
        return float(x[0] - np.log(x[0])) if x[0] > 0 else np.inf

    def normal(x):
        return cost(x), 1.0 - 1.0 / x, np.array([[1.0 / x[0] ** 2]])

    found = minimise(cost, normal, np.array([5.0]), np.array([-10.0]), np.array([10.0]))
    assert found.x[0] == pytest.approx(1.0, abs=0.05)


def test_a_search_that_goes_on_does_not_ask_again_where_it_starts():
    asked = []

    def cost(x):
        return 0.5 * float(decay(x) @ decay(x))

    def normal(x):
        asked.append(x.copy())
        slopes = decay_jacobian(x)
        return cost(x), slopes.T @ decay(x), slopes.T @ slopes

    low, high = np.zeros(3), np.full(3, 9.0)
    first = minimise(cost, normal, np.array([1.0, 0.1, 0.0]), low, high, iterations=3)
    asked.clear()
    other = minimise(cost, normal, first.x, low, high, warm_start=first)
    assert not any(np.array_equal(x, first.x) for x in asked)
    again = minimise(cost, normal, first.x, low, high)
    np.testing.assert_array_equal(other.x, again.x)
