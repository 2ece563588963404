"""How far the unknowns of a fit may lie from where it ended."""

from __future__ import annotations

import numpy as np

from ventbench.system_id.data import Floats
from ventbench.system_id.least_squares import Minimum
from ventbench.system_id.problem import Problem

#: Breaths beyond the shared unknowns from which the spread between breaths is believed.
_ENOUGH = 10

#: Most of an unknown that one breath is taken to decide.
_TAKEN = 0.98


def covariance(problem: Problem, minimum: Minimum) -> Floats:
    """Covariance of the unknowns in coordinates, ``(U, U)``.

    The inverse Hessian holds if noise and model are right. The sandwich, whose filling is the
    spread of the breaths' gradients, holds if the breaths are independent, whatever happens within
    them (coloured noise, an effect that is not in the model). Each unknown gets the larger variance
    of the two; correlations are those of the inverse Hessian.
    """
    floor = 1e-9 * np.maximum(np.diag(minimum.hessian), 1e-9)
    bread = np.asarray(np.linalg.inv(minimum.hessian + np.diag(floor)), np.float64)
    index = problem.unknowns.index
    own = np.array([len(np.unique(column)) == len(index) for column in index.T])
    common = np.unique(index[:, ~own])
    if len(index) - len(common) < _ENOUGH:
        return bread
    sandwich = _sandwich(problem, minimum, own, common, bread[np.ix_(common, common)])
    grown = np.ones(len(bread))
    grown[common] = np.sqrt(np.maximum(sandwich / np.diag(bread)[common], 1.0))
    return np.asarray(bread * np.outer(grown, grown), np.float64)


def _sandwich(
    problem: Problem, minimum: Minimum, own: np.ndarray, common: np.ndarray, bread: Floats
) -> Floats:
    """Variances of the unknowns that breaths share, from the spread between breaths, ``(s,)``.

    A breath that decides much by itself hides its own deviation: each gradient is blown up by what
    the breath took of it, as leaving the breath out would (the jackknife of clusters, CR3).
    """
    _, gradients, curvatures = problem.scores(minimum.x)
    layout = problem.unknowns
    if own.any():  # what is a breath's own has been fitted to it and takes its share
        known = problem.precision[layout.index[:, own]][:, :, None] * np.eye(int(own.sum()))
        inner = curvatures[:, own][:, :, own] + known
        inner = inner + 1e-9 * np.maximum(inner.max(axis=(1, 2), keepdims=True), 1e-9) * np.eye(
            inner.shape[1]
        )
        across = np.linalg.solve(inner, curvatures[:, own][:, :, ~own]).swapaxes(1, 2)
        gradients, curvatures = (
            gradients[:, ~own] - np.matmul(across, gradients[:, own, None])[:, :, 0],
            curvatures[:, ~own][:, :, ~own] - np.matmul(across, curvatures[:, own][:, :, ~own]),
        )
    else:
        gradients, curvatures = gradients[:, ~own], curvatures[:, ~own][:, :, ~own]
    rows, place = np.arange(len(gradients)), np.searchsorted(common, layout.index[:, ~own])
    forces = np.zeros((len(rows), len(common)))
    np.add.at(forces, (rows[:, None], place), gradients)
    shares = np.zeros((len(rows), len(common), len(common)))
    np.add.at(shares, (rows[:, None, None], place[:, :, None], place[:, None, :]), curvatures)
    forces -= forces.mean(axis=0)
    left = np.eye(len(common)) - _TAKEN * np.matmul(shares, bread)
    spread = np.linalg.solve(left, forces[:, :, None])[:, :, 0] @ bread
    return np.asarray(np.sum(spread**2, axis=0) * (1.0 - 1.0 / len(rows)), np.float64)


def quantile(freedom: float) -> float:
    """The 97.5 % quantile of Student's t, by its expansion around the normal's."""
    z = 1.959964
    first = (z**3 + z) / 4.0
    second = (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0
    return z + first / freedom + second / freedom**2
