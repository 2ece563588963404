"""Linear systems of any rank have an answer, that of NumPy where it is unique."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.base.linear import cholesky, inverse, solve


def normal(rank: int, size: int, seed: int) -> np.ndarray:
    """Normal equations of some rank."""
    rows = np.random.default_rng(seed).standard_normal((rank, size))
    return rows.T @ rows


@settings(max_examples=50)
@given(st.integers(1, 6), st.integers(0, 6), st.integers(0, 2**16))
def test_a_solution_is_one_where_there_is_any(size, rank, seed):
    matrix = normal(rank, size, seed)
    right = matrix @ np.random.default_rng(seed + 1).standard_normal(size)
    found = solve(np.round(matrix, 12), right)
    assert np.isfinite(found).all()
    if rank >= size:
        np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-4, atol=1e-6)


def test_of_exactly_singular_systems_the_shortest_solution_is_taken():
    matrix = np.array([[2.0, 2.0], [2.0, 2.0]])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(matrix, np.ones(2))
    np.testing.assert_allclose(solve(matrix, np.array([4.0, 4.0])), [1.0, 1.0])
    stack = np.stack([matrix, np.eye(2), np.zeros((2, 2))])
    found = solve(stack, np.full((3, 2, 1), 4.0))
    np.testing.assert_allclose(found[..., 0], [[1.0, 1.0], [4.0, 4.0], [0.0, 0.0]])
    np.testing.assert_allclose(inverse(matrix), np.full((2, 2), 0.125))


def test_what_is_not_finite_has_no_answer_and_no_traceback():
    stack = np.stack([np.full((2, 2), np.nan), np.ones((2, 2))])
    found = inverse(stack)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], 0.25)
    assert np.isfinite(cholesky(np.array([[1.0, np.inf], [np.inf, 1.0]]))).all()


@settings(max_examples=50)
@given(st.integers(1, 6), st.integers(0, 6), st.integers(0, 2**16))
def test_a_factor_is_triangular_and_gives_the_matrix(size, rank, seed):
    matrix = normal(rank, size, seed)
    factor = cholesky(matrix)
    np.testing.assert_array_equal(factor, np.tril(factor))
    np.testing.assert_allclose(factor @ factor.T, matrix, atol=1e-6)
    assert (np.diag(factor) > 0.0).all()
