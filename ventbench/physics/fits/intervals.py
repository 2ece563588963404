"""How far the unknowns of a fit may lie from where it ended."""

from __future__ import annotations

import numpy as np

from ventbench.physics.fits.data import Floats
from ventbench.physics.fits.least_squares import Minimum
from ventbench.physics.fits.problem import Problem

#: Breaths beyond the shared unknowns from which the spread between breaths is believed.
_ENOUGH = 10


def covariance(problem: Problem, minimum: Minimum) -> Floats:
    """Covariance of the unknowns in coordinates, ``(U, U)``.

    The inverse Hessian holds if noise and model are right. The sandwich, whose filling is the
    spread of the breaths' gradients, holds if the breaths are independent, whatever happens within
    them (coloured noise, an effect that is not in the model). Each unknown gets the larger variance
    of the two; correlations are those of the inverse Hessian.
    """
    floor = 1e-9 * np.maximum(np.diag(minimum.hessian), 1e-9)
    bread = np.asarray(np.linalg.inv(minimum.hessian + np.diag(floor)), np.float64)
    shared = problem.unknowns.shared
    count, free = len(problem.data), int(shared.sum())
    if count - free < _ENOUGH:
        return bread
    _, by_breath, _ = problem.scores(minimum.x)
    gradients = np.zeros((count, len(minimum.x)))
    np.add.at(gradients, (np.arange(count)[:, None], problem.unknowns.index), by_breath)
    gradients -= gradients.mean(axis=0)
    spread = gradients @ bread
    sandwich = np.sum(spread**2, axis=0) * count / (count - free)
    model = np.diag(bread)
    grown = np.where(shared, np.sqrt(np.maximum(sandwich / model, 1.0)), 1.0)
    return np.asarray(bread * np.outer(grown, grown), np.float64)


def quantile(freedom: float) -> float:
    """The 97.5 % quantile of Student's t, by its expansion around the normal's."""
    z = 1.959964
    first = (z**3 + z) / 4.0
    second = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    return z + first / freedom + second / freedom**2
