"""Marginal likelihood of breaths under a latent Gaussian process, by Laplace's method.

The noise is that of all other fits: first-order autoregressive, Gaussian with exponential tails
(:class:`~ventbench.system_id.noise.Noise`). The process is a sum of few independent components
(:func:`components`), whose response is linear. Their likeliest coefficients are found together with
what each breath has of its own, such as its starting pressure, by iteratively reweighted least
squares. The integral over the coefficients is that of the Gaussian of the same peak and curvature;
a breath's own parameters stay at their best, as in every other likelihood of the diagnosis. Without
a process the value is therefore :meth:`~ventbench.system_id.problem.Problem.log_likelihood`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem

#: Expected rise of the log posterior, nats, at which the search for coefficients ends, and its most
#: steps. Reweighting converges in a few; far from the noise's own size, it may take more.
_TOLERANCE, _STEPS = 0.01, 25

#: Share of the curvature that is added to a breath's own, so that a parameter without any effect
#: (the start of a breath whose readings are missing) makes no system singular.
_RIDGE = 1e-9


class Kernel(NamedTuple):
    """Kind and scale of a Gaussian process of unit variance."""

    periodic: bool  #: whether it has one frequency; else it is smooth.
    scale: float  #: frequency in Hz if periodic, else correlation time in s.


def components(dt: Floats, kernel: Kernel, least: float) -> Floats:
    """Components whose independent sum has a kernel's covariance, ``(n, K, T)``.

    Args:
        dt: intervals of the samples, s, ``(n, T)``.
        kernel: kind and scale.
        least: components of less variance than this are left out.
    """
    time = np.cumsum(dt, axis=1) - dt
    if kernel.periodic:
        angle = 2.0 * np.pi * kernel.scale * time
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Breaths of about equal intervals share components; jitter is far below the scale.
    steps, which = np.unique(np.round(dt.mean(axis=1), 4), return_inverse=True)
    samples = np.arange(dt.shape[1])
    lag = (samples[:, None] - samples) * steps[:, None, None]
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (lag / kernel.scale) ** 2))
    kept = int(np.max(np.sum(values > least, axis=1)))
    scaled = vectors[:, :, -kept:] * np.sqrt(np.maximum(values[:, None, -kept:], 0.0))
    return scaled.swapaxes(1, 2)[which.reshape(-1)]


@dataclass(frozen=True, eq=False)
class LinearBreaths:
    """Breaths to first order in their own parameters, of which there are j."""

    residual: Floats  #: simulated minus measured, ``(n, c, T)``.
    slopes: Floats  #: its derivatives by a breath's own parameters, ``(n, j, c, T)``.
    precision: Floats  #: prior precision of these, ``(n, j)``.
    displacement: Floats  #: their distance from the prior mean, ``(n, j)``.
    weight: Floats  #: 1 where measured, else 0, ``(n, c, T)``.

    @classmethod
    def of(cls, problem: Problem, x: Floats) -> LinearBreaths:
        """Breaths of a problem at its unknowns ``(U,)``.

        Parameters that breaths share count among the own ones of each, which bears its part of
        their prior; :meth:`only` takes them out.
        """
        residual, slopes = problem.jacobian(x)
        index, moved = problem.unknowns.index, x - problem.mean
        precision = problem.precision[index] / uses(problem)
        return cls(residual, slopes, precision, moved[index], problem.data.weight)

    def only(self, columns: Bools) -> LinearBreaths:
        """The breaths with some of the parameters alone, bool, ``(j,)``."""
        return replace(
            self, slopes=self.slopes[:, columns], precision=self.precision[:, columns],
            displacement=self.displacement[:, columns],
        )  # fmt: skip

    def whitened(self, noise: Noise, responses: Floats | None = None) -> WhitenedBreaths:
        """The breaths and a process's responses, whitened by a noise.

        Args:
            noise: model of the measurement noise.
            responses: change of the readings by each component, ``(n, K, c, T)``, or of their first
                channels alone; no process if None.
        """
        n, j = self.precision.shape
        count = 0 if responses is None else responses.shape[1]
        stack = np.zeros((n, count + j + 1, *self.residual.shape[1:]))
        if responses is not None:
            stack[:, :count, : responses.shape[2]] = responses
        stack[:, count:-1], stack[:, -1] = self.slopes, self.residual
        white = noise.whiten(stack, self.weight).reshape(n, count + j + 1, -1)
        constant = -noise.log_scale(self.weight)
        constant = constant - noise.log_norm() * self.weight.sum(axis=(1, 2))
        return WhitenedBreaths(
            noise, white[:, -1], white[:, :-1], constant, count, self.precision, self.displacement
        )


class Marginal(NamedTuple):
    """Marginal likelihood, and where the posterior has its peak."""

    nats: Floats  #: log marginal likelihood of each breath, ``(n,)``.
    #: the likeliest coefficients of the components, then the changes of a breath's own parameters,
    #: ``(n, K + j)``.
    coefficients: Floats


@dataclass(frozen=True, eq=False)
class WhitenedBreaths:
    """Whitened residuals of m samples, and how K components and j own parameters change them."""

    noise: Noise  #: model of the noise that whitened them.
    white: Floats  #: residuals, ``(n, m)``.
    rows: Floats  #: their derivatives, those by the components first, ``(n, K + j, m)``.
    constant: Floats  #: logarithm of the noise's density at zero, ``(n,)``.
    count: int  #: number of components, K.
    precision: Floats  #: see :class:`LinearBreaths`.
    displacement: Floats  #: see :class:`LinearBreaths`.

    def marginal(self, size: float, start: Floats | None = None) -> Marginal:
        """Integrate the process out.

        Args:
            size: standard deviation of the process.
            start: coefficients to start from, as of :class:`Marginal`; zero if None.
        """
        count = self.count
        prior, moved = self.prior(size)
        best = np.zeros_like(prior) if start is None else start
        left = self.left(best)
        for _ in range(_STEPS):
            influence = self.noise.influence(left)
            slope = self.slope(influence * left, prior * (best + moved))
            step = np.linalg.solve(self.curvature(influence, prior), slope[:, :, None])[:, :, 0]
            best = best - step
            left = self.left(best)
            if 0.5 * float(np.sum(slope * step)) < _TOLERANCE:
                break
        nats = self.constant - self.noise.loss(left).sum(axis=1)
        if count:
            # The loss itself is curved in its core alone. Weights of reweighting would do as well
            # for the peak, but overrate the curvature by a third of a nat a breath and more.
            curvature = self.curvature(self.noise.influence(left) == 1.0, prior)
            volume = np.linalg.slogdet(curvature)[1] + 2.0 * count * np.log(size)
            volume = volume - np.linalg.slogdet(curvature[:, count:, count:])[1]
            nats = nats - 0.5 * np.sum((best[:, :count] / size) ** 2, axis=1) - 0.5 * volume
        return Marginal(nats, best)

    def bounds(self, sizes: Floats, left: Floats) -> Floats:
        """Log marginal likelihood at several sizes, with the weights of given residuals, ``(s,)``.

        The loss lies below the parabola that touches it at a residual, so that this is a lower
        bound of the peak; it is as cheap for all sizes as for one.

        Args:
            sizes: standard deviations, ``(s,)``.
            left: whitened residuals, ``(n, m)``.
        """
        count = self.count
        influence = self.noise.influence(left)
        weighted = self.rows * influence[:, None]
        curvature = np.matmul(weighted, self.rows.swapaxes(1, 2))
        slope = np.matmul(weighted, self.white[:, :, None])
        own = curvature[:, count:, count:] + (self.precision + self._ridge)[:, :, None] * np.eye(
            self.precision.shape[1]
        )
        absorbed = np.linalg.solve(
            own, np.concatenate([curvature[:, count:, :count], slope[:, count:]], axis=2)
        )
        across = curvature[:, :count, count:]
        curvature = curvature[:, :count, :count] - np.matmul(across, absorbed[:, :, :-1])
        force = slope[:, :count] - np.matmul(across, absorbed[:, :, -1:])
        power, axes = np.linalg.eigh(curvature)
        power = np.maximum(power, 0.0)
        force = np.matmul(axes.swapaxes(1, 2), force)[:, :, 0]
        base = self.constant.sum() - self.noise.loss(left).sum()
        base += 0.5 * np.sum(influence * (left**2 - self.white**2))
        base += 0.5 * np.sum(slope[:, count:] * absorbed[:, :, -1:])
        variance = np.asarray(sizes)[:, None, None] ** 2
        grown = 1.0 + variance * power
        return base + 0.5 * np.sum(variance * force**2 / grown - np.log(grown), axis=(1, 2))

    def left(self, coefficients: Floats) -> Floats:
        """Whitened residuals that coefficients leave, ``(n, m)``."""
        return self.white + np.matmul(coefficients[:, None], self.rows)[:, 0]

    def prior(self, size: float) -> tuple[Floats, Floats]:
        """Prior precision of all coefficients, and how far they are from its mean at zero.

        Both ``(n, K + j)``; ``size`` is the standard deviation of the process.
        """
        own = self.precision + self._ridge
        precision = np.concatenate([np.full((len(own), self.count), size**-2.0), own], axis=1)
        moved = np.zeros_like(precision)
        moved[:, self.count :] = self.displacement
        return precision, moved

    def slope(self, score: Floats, prior: Floats) -> Floats:
        """Slope of minus the log posterior by all coefficients, ``(n, K + j)``.

        Args:
            score: slope of the loss by the whitened residuals, ``(n, m)``.
            prior: slope of the prior's part, ``(n, K + j)``.
        """
        return np.matmul(self.rows, score[:, :, None])[:, :, 0] + prior

    def curvature(self, influence: Floats, prior: Floats) -> Floats:
        """Curvature of the log posterior by all coefficients, ``(n, K + j, K + j)``."""
        weighted = self.rows * influence[:, None]
        own = prior[:, :, None] * np.eye(prior.shape[1])
        return np.matmul(weighted, self.rows.swapaxes(1, 2)) + own

    @property
    def _ridge(self) -> Floats:
        """Small precision of a breath's own parameters, ``(n, j)``."""
        return _RIDGE * (1.0 + np.sum(self.rows[:, self.count :] ** 2, axis=2))


def uses(problem: Problem) -> Ints:
    """Number of breaths that share the unknown behind each parameter of a breath, ``(n, k)``."""
    index = problem.unknowns.index
    return np.bincount(index.ravel(), minlength=len(problem.unknowns.path_of))[index]


def likeliest_beside(
    problem: Problem,
    x: Floats,
    breaths: LinearBreaths,
    responses: Floats | None = None,
    size: float = 1.0,
) -> Floats:
    """Unknowns of a problem that are the likeliest beside a process, to first order, ``(U,)``.

    Parameters that were fitted without the process have made up for it. Those that breaths share
    are found together with each breath's own and with the process's coefficients.

    Args:
        problem: breaths, noise and unknowns.
        x: unknowns in coordinates, ``(U,)``.
        breaths: the problem's at ``x``, with all parameters.
        responses: see :meth:`LinearBreaths.whitened`.
        size: standard deviation of the process.
    """
    index, whitened = problem.unknowns.index, breaths.whitened(problem.noise, responses)
    is_shared = (uses(problem) > 1).any(axis=0)
    columns = whitened.count + np.flatnonzero(is_shared)
    others = np.r_[: whitened.count, whitened.count + np.flatnonzero(~is_shared)]
    place = index[:, is_shared]
    used = np.unique(place)
    prior, moved = whitened.prior(size)
    best, left = np.zeros_like(prior), whitened.white
    for _ in range(_STEPS):
        influence = whitened.noise.influence(left)
        curvature = whitened.curvature(influence, prior)
        slope = whitened.slope(influence * left, prior * (best + moved))
        # What differs from breath to breath is eliminated first.
        across = curvature[:, others[:, None], columns]
        right = np.concatenate([across, slope[:, others, None]], axis=2)
        solved = np.linalg.solve(curvature[:, others[:, None], others], right)
        rest = np.matmul(across.swapaxes(1, 2), solved)
        total, force, step = np.zeros((len(x), len(x))), np.zeros(len(x)), np.zeros(len(x))
        inner = curvature[:, columns[:, None], columns] - rest[:, :, :-1]
        np.add.at(total, (place[:, :, None], place[:, None, :]), inner)
        np.add.at(force, place, slope[:, columns] - rest[:, :, -1])
        step[used] = np.linalg.solve(total[np.ix_(used, used)], force[used])
        own = solved[:, :, -1] - np.matmul(solved[:, :, :-1], step[place][:, :, None])[:, :, 0]
        best[:, columns] -= step[place]
        best[:, others] -= own
        left = whitened.left(best)
        if 0.5 * float(force @ step + np.sum(slope[:, others] * own)) < _TOLERANCE:
            break
    low, high = problem.unknowns.bounds()
    found = x.copy()
    found[index] += best[:, whitened.count :]
    return np.clip(found, low, high)
