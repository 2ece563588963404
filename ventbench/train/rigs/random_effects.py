r"""Linear mixed model of units whose estimates have errors of their own.

Unit j has parameters ``theta_j = X_j beta + u_j`` with ``u_j ~ N(0, Sigma)``. Its data say
``log L_j = b_j' theta - theta' A_j theta / 2``: information ``A_j``, which may be singular,
and ``b_j = A_j`` times the estimate. So what the estimates scatter by their errors alone is taken
off from what they scatter, and a direction that a unit says nothing about counts for nothing.

The maximum is found by expectation and maximisation; the error of ``beta`` is part of the
expectation (restricted maximum likelihood). Variances and correlations are shrunk: with fewer
units than parameters the data alone would say that ``Sigma`` is singular. Laird and Ware,
Biometrics 38 (1982), 963.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ventbench.base.arrays import Floats


@dataclass(frozen=True)
class Units:
    """What the data of J units say of p parameters."""

    information: Floats  #: ``A_j``, shape ``(J, p, p)``.
    weighted: Floats  #: ``b_j``, shape ``(J, p)``.
    design: Floats  #: ``X_j``, shape ``(J, p, q)``.

    def without(self, j: int) -> Units:
        """All units but one."""
        return Units(*(np.delete(part, j, axis=0) for part in vars(self).values()))


@dataclass(frozen=True)
class Prior:
    """Prior of :func:`fit`."""

    scale: Floats  #: standard deviations of the parameters between units, shape ``(p,)``.
    #: how many units each scale counts for, shape ``(p,)``; infinity for one that is given.
    units: Floats
    uncorrelated: float  #: how many units count for no correlation between parameters.
    centre: Floats  #: of ``beta``, shape ``(q,)``.
    centre_scale: Floats  #: standard deviations of ``beta`` around it, shape ``(q,)``.


@dataclass(frozen=True)
class Population:
    """Result of a fit."""

    beta: Floats  #: shape ``(q,)``.
    beta_covariance: Floats  #: shape ``(q, q)``.
    covariance: Floats  #: ``Sigma``, shape ``(p, p)``.
    units: Floats  #: posterior means of ``theta_j``, shape ``(J, p)``.

    def predictive(self, design: Floats) -> tuple[Floats, Floats]:
        """Mean and covariance of a new unit with a design ``(..., p, q)``."""
        turned = np.swapaxes(design, -1, -2)
        return design @ self.beta, self.covariance + design @ self.beta_covariance @ turned


def fit(
    units: Units, prior: Prior, *, iterations: int = 200, start: Floats | None = None
) -> Population:
    """Fit the population.

    Args:
        units: J of them.
        prior: see :class:`Prior`.
        iterations: of the expectation and maximisation.
        start: ``Sigma`` to start at; the prior's if not given.
    """
    covariance = np.diag(prior.scale**2) if start is None else start
    count = len(units.weighted)
    for _ in range(iterations):
        beta, error, means, spread = _expect(units, prior, covariance)
        apart = means - units.design @ beta
        second = apart.T @ apart + spread.sum(axis=0)
        # Variances and correlations have priors of their own (Barnard et al., 2000).
        given = np.isinf(prior.units)
        counts = np.where(given, 0.0, prior.units)
        own = (second.diagonal() + counts * prior.scale**2) / (count + counts)
        own = np.where(given, prior.scale**2, own)
        root = np.sqrt(second.diagonal())
        correlation = second / np.outer(root, root) * count / (count + prior.uncorrelated)
        np.fill_diagonal(correlation, 1.0)
        covariance = correlation * np.sqrt(np.outer(own, own))
    beta, error, means, _ = _expect(units, prior, covariance)
    return Population(beta, error, covariance, means)


def _expect(
    units: Units, prior: Prior, covariance: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Beta, its covariance, means of all units, and covariances of their deviations."""
    A, b, X = units.information, units.weighted[..., None], units.design
    inverse = np.linalg.inv(covariance)
    posterior = np.linalg.inv(A + inverse)
    turned = X.transpose(0, 2, 1)
    precision = prior.centre_scale**-2.0
    normal = (turned @ (A - A @ posterior @ A) @ X).sum(axis=0)
    normal += np.diag(precision)
    right = (turned @ (b - A @ (posterior @ b)))[..., 0].sum(axis=0) + precision * prior.centre
    error = np.linalg.inv(normal)
    beta = error @ right
    means = (posterior @ (b + inverse @ (X @ beta[:, None])))[..., 0]
    through = posterior @ A @ X
    return beta, error, means, posterior + through @ error @ through.transpose(0, 2, 1)


def surprise(units: Units, j: int, population: Population) -> float:
    """How a unit lies in a population that was fitted without it.

    Compared is what its data say, in the directions in which they say something, with what the
    population predicts, errors of the data included.

    Returns:
        Share of the predicted units that are nearer to the middle: uniform in 0..1 if all is right.
    """
    values, vectors = np.linalg.eigh(units.information[j])
    known = values > 1e-6 * values[-1]
    root = vectors[:, known] * np.sqrt(values[known])
    estimate = (vectors[:, known] / np.sqrt(values[known])).T @ units.weighted[j]
    mean, spread = population.predictive(units.design[j])
    covariance = np.eye(root.shape[1]) + root.T @ spread @ root
    off = estimate - root.T @ mean
    distance = float(off @ np.linalg.solve(covariance, off))
    return float(chi2.cdf(distance, root.shape[1]))
