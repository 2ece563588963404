"""Carried slopes: what they are, and that a search with them ends in the same place."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.physics.fits import Problem, fit, recorded
from ventbench.physics.fits.least_squares import minimise
from ventbench.physics.fits.secant import Secant

from . import cases

M = {"valve_lag": {"tau": 0.05}, "viscoelasticity": {"ratio": 0.4, "time": 0.8}}


@pytest.fixture(scope="module")
def found():
    return fit(recorded(cases.recording(8, M, noise=0.2, seed=4)), M)


def away(problem: Problem, x: np.ndarray, by: float) -> np.ndarray:
    """A point some way off, the same each time."""
    moved = x + by * np.random.default_rng(1).standard_normal(len(x))
    return np.clip(moved, *problem.unknowns.bounds())


def test_exact_where_nothing_is_carried(found):
    problem, x = found.problem, found.minimum.x
    carry = Secant(problem)
    assert not carry.known
    assert carry.cost(x) == problem.cost(x)
    for mine, own in zip(carry.normal(x), problem.normal(x), strict=True):
        np.testing.assert_array_equal(mine, own)
    assert carry.known


def test_carried_slopes_explain_the_last_step(found):
    """Broyden's condition: along the step, breath by breath, they are the difference quotient."""
    problem = found.problem
    before, after = found.minimum.x, away(problem, found.minimum.x, 0.05)
    carry = Secant(problem)
    carry.normal(before)
    white = carry._white
    carry.near(after)
    step = (after - before)[problem.unknowns.index]
    np.testing.assert_allclose(
        np.einsum("nk,nkm->nm", step, carry._rows), problem.white(after) - white, atol=1e-9
    )
    gradient, hessian = problem.equations(carry._white, carry._rows, after)
    exact = problem.normal(after)
    assert np.corrcoef(gradient, exact[1])[0, 1] > 0.99
    np.testing.assert_allclose(np.diag(hessian), np.diag(exact[2]), rtol=0.5)


def test_a_step_to_nowhere_changes_no_slope(found):
    problem, x = found.problem, found.minimum.x
    carry = Secant(problem)
    _, gradient, hessian = carry.normal(x)
    for again, first in zip(carry.near(x), (gradient, hessian), strict=True):
        np.testing.assert_allclose(again, first, rtol=1e-12)


def test_a_search_ends_in_the_same_minimum_with_fewer_derivatives(found):
    problem = found.problem
    start = away(problem, found.minimum.x, 0.3)
    low, high = problem.unknowns.bounds()

    def search(**more):
        carry = Secant(problem)
        counted = []

        def normal(x):
            counted.append(x)
            return carry.normal(x)

        near = {"near": carry.near} if more.pop("carried") else {}
        end = minimise(carry.cost, normal, start, low, high, tolerance=0.02, **near, **more)
        return end, len(counted)

    plain, most = search(carried=False)
    end, count = search(carried=True)
    assert end.converged
    assert count < most
    assert abs(end.cost - found.minimum.cost) < 0.1
    assert abs(plain.cost - found.minimum.cost) < 0.1


def test_a_search_nearby_starts_with_what_is_known(found):
    problem, x = found.problem, found.minimum.x
    low, high = problem.unknowns.bounds()
    carry = Secant(problem)
    carry.normal(x)
    pinned = int(problem.unknowns.of("valve_lag.tau")[0])
    low[pinned] = high[pinned] = x[pinned] + 0.2
    warm = minimise(
        carry.cost, carry.normal, x, low, high, near=carry.near, warm=True, tolerance=0.02
    )
    cold = minimise(problem.cost, problem.normal, x, low, high, tolerance=0.02)
    assert warm.cost == pytest.approx(cold.cost, abs=0.1)
    assert warm.x[pinned] == x[pinned] + 0.2
