"""Linear systems that may be singular, as normal equations of unidentified parameters are.

Nothing here raises: where a system has no unique solution, the shortest one is taken, and where a
matrix is not finite, so is no answer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Floats

#: Eigenvalues below this share of the largest are raised to it, so that a factor exists.
_LEAST = 1e-12


def solve(matrix: Floats, right: Floats) -> Floats:
    """Solution ``x`` of ``matrix @ x = right``, the shortest one where there are many.

    Args:
        matrix: ``(..., k, k)``.
        right: ``(k,)`` or ``(..., k, m)``.
    """
    try:
        return np.asarray(np.linalg.solve(matrix, right), np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.matmul(inverse(matrix), right), np.float64)


def inverse(matrix: Floats) -> Floats:
    """Inverse of matrices ``(..., k, k)``; the pseudoinverse (Penrose, 1955) if one is singular."""
    try:
        return np.asarray(np.linalg.inv(matrix), np.float64)
    except np.linalg.LinAlgError:
        finite = np.isfinite(matrix).all(axis=(-2, -1), keepdims=True)
        pseudoinverse = np.linalg.pinv(np.where(finite, matrix, 0.0))
        return np.where(finite, pseudoinverse, np.nan)


def cholesky(matrix: Floats) -> NDArray[np.float64]:
    """Lower triangular factor of a symmetric matrix ``(k, k)`` that should be positive definite.

    Rounding may leave a tiny negative eigenvalue, which is raised; entries that are not finite say
    nothing and count as zero.
    """
    try:
        return np.asarray(np.linalg.cholesky(matrix), np.float64)
    except np.linalg.LinAlgError:
        symmetric = np.nan_to_num(matrix, nan=0.0, posinf=0.0, neginf=0.0)
        values, vectors = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
        values = np.maximum(values, max(_LEAST * float(values.max(initial=0.0)), _LEAST))
        upper = np.asarray(np.linalg.qr((vectors * np.sqrt(values)).T, mode="r"), np.float64)
        return (upper * np.sign(np.diag(upper))[:, None]).T
