"""A hypothesis, the breaths that it is fitted to, the fitted model, and that to first order.

To first order: what a refit of the parameters can absorb, and what it cannot.
Residuals are whitened by the noise. What each breath's own parameters absorb, and then what the
shared parameters absorb, is projected out. What is left of a change of the prediction is a
template: its inner product with what is left of the residual tells how much log-likelihood the
change gains after a refit, without doing one.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ventbench.base.linear import solve
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.physics.catalogue import (
    basis_terms,
    intermittent,
    library,
    mechanism,
    paths,
    strength_path,
)
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.fit import Fit
from ventbench.system_id.predictor import Predictor
from ventbench.system_id.problem import Partition, Problem, free_paths

#: Steps towards the likeliest sizes under noise with tails.
_STEPS = 6

#: Breaths that are simulated by functions of their own: those of a batch would be mostly idle.
_FEW = 16


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A fitted model to first order, with m whitened samples in each of n breaths."""

    problem: Problem  #: the model's breaths and noise.
    values: Floats  #: physical values of all parameters and of the start, ``(n, P + 1)``.
    prediction: Floats  #: simulated readings, ``(n, c, T)``.
    residual: Floats  #: simulated minus measured, whitened and projected, ``(n, m)``.
    #: orthonormal directions that each breath absorbs by itself, ``(n, j, m)``.
    breath_basis: Floats
    shared_basis: Floats  #: orthonormal directions that all breaths absorb together, ``(s, n m)``.

    def whiten(self, difference: Floats) -> Floats:
        """Whiten differences of predictions, ``(n, ..., c, T)`` to ``(n, ..., m)``."""
        white = self.problem.noise.whiten(
            difference * self.problem.data.weight[(slice(None), *(None,) * (difference.ndim - 3))],
            self.problem.data.weight,
        )
        return white.reshape(*white.shape[:-2], -1)

    def project_out_breath(self, white: Floats) -> Floats:
        """Project out what each breath absorbs by itself, ``(n, q, m)``."""
        basis = self.breath_basis
        return white - np.matmul(np.matmul(white, basis.swapaxes(1, 2)), basis)

    def project_out_shared(self, white: Floats) -> Floats:
        """Project out what all breaths absorb together, ``(n, q, m)``."""
        n, q, m = white.shape
        flat = white.swapaxes(0, 1).reshape(q, n * m)
        flat = flat - (flat @ self.shared_basis.T) @ self.shared_basis
        return flat.reshape(q, n, m).swapaxes(0, 1)

    def template(self, prediction: Floats) -> Floats:
        """Part of another prediction ``(n, c, T)`` that no refit can absorb, ``(n, m)``."""
        white = self.project_out_breath(self.whiten(prediction - self.prediction)[:, None])
        return self.project_out_shared(white)[:, 0]

    def integrate_out(self, columns: Floats, sd: Floats) -> tuple[Floats, Floats]:
        """Integrate out changes that have a size of their own in each breath.

        Noise has tails, so that the sizes are those where Laplace's method is exact to second
        order: the likeliest, by reweighted least squares.

        Args:
            columns: changes of the pressure by the k sizes, ``(n, k, T)``.
            sd: prior standard deviations of the sizes, ``(k,)``.

        Returns:
            Log-likelihood that each breath gains, nats, ``(n,)``, and the sizes, ``(n, k)``.
        """
        X = sd[:, None] * self.project_out_breath(self.whiten(columns[:, :, None]))  # (n, k, m)
        noise, error = self.problem.noise, self.residual
        sizes, left, eye = np.zeros(X.shape[:2]), error, np.eye(len(sd))
        for _ in range(_STEPS):
            weighted = X * noise.influence(left)[:, None]
            curvature = weighted @ X.swapaxes(1, 2) + eye
            sizes = -solve(curvature, weighted @ error[:, :, None])[:, :, 0]
            left = error + np.einsum("nk,nkm->nm", sizes, X)
        lost = noise.loss(left).sum(axis=1) + 0.5 * np.sum(sizes**2, axis=1)
        volume = 0.5 * np.linalg.slogdet(curvature)[1]
        return noise.loss(error).sum(axis=1) - lost - volume, sd * sizes


def linearise(problem: Problem, x: Floats, *, clip: float = 4.0) -> Linearisation:
    """Linearise a problem at its unknowns.

    Args:
        problem: breaths and noise.
        x: unknowns in coordinates, ``(U,)``.
        clip: whitened residuals are cut off here, in standard deviations, so that no single sample
            decides.
    """
    residual, slopes = problem.jacobian(x)
    weight, noise = problem.data.weight, problem.noise
    white = np.clip(noise.whiten(residual, weight), -clip, clip)
    white = white.reshape(len(white), -1)
    rows = noise.whiten(slopes, weight)
    rows = rows.reshape(*rows.shape[:2], -1)
    layout = problem.unknowns
    breath = np.array([parameter.scope == "breath" for parameter in layout.parameters])
    # Groups may give a shared parameter, such as the valve's gain, one unknown for each breath.
    counts = [len(np.unique(layout.index[:, k])) for k in range(len(layout.paths))]
    breath |= np.array([count == len(white) and count > 1 for count in counts])
    breath_basis = _orthonormal(rows[:, breath])
    linear = Linearisation(
        problem,
        problem.values(x),
        problem.predict(x),
        white,
        breath_basis,
        np.zeros((0, white.size)),
    )
    columns = []
    for k in np.flatnonzero(~breath):
        residual_slope = linear.project_out_breath(rows[:, [k]])[:, 0]
        columns.extend(
            np.where((layout.index[:, k] == unknown)[:, None], residual_slope, 0.0).ravel()
            for unknown in np.unique(layout.index[:, k])
        )
    if columns:
        linear = replace(linear, shared_basis=_orthonormal(np.asarray(columns)[None])[0])
    clean = linear.project_out_shared(linear.project_out_breath(white[:, None]))[:, 0]
    return replace(linear, residual=clean)


#: Eigenvalues of a projection below this share of the largest count as zero.
_RIDGE = 1e-9


def _orthonormal(rows: Floats) -> Floats:
    """Orthonormal bases of the row spaces, ``(n, j, m)``; dependent rows become zero."""
    if rows.shape[1] == 0:
        return rows
    gram = np.matmul(rows, rows.swapaxes(1, 2))
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / scale[:, :, None] / scale[:, None, :])
    regular = values > _RIDGE * np.maximum(values[:, -1:], 1e-300)
    size = np.where(regular, 1.0 / np.sqrt(np.where(regular, values, 1.0)), 0.0)
    return np.matmul((vectors * size[:, None, :]).swapaxes(1, 2), rows / scale[:, :, None])


@dataclass(frozen=True)
class Hypothesis:
    """The base model plus terms: mechanisms, and basis terms of nonparametric components."""

    names: tuple[str, ...] = ()  #: the terms, in the order in which they were added.
    free: tuple[str, ...] = ()  #: shape parameters that are fitted as well, by path.
    #: parameters that keep a value other than their neutral one, by path.
    fixed: tuple[tuple[str, float], ...] = ()

    def plus(self, addition: Hypothesis) -> Hypothesis:
        """The union of two hypotheses; ``addition`` wins where both fix a parameter."""
        return Hypothesis(
            tuple(dict.fromkeys(self.names + addition.names)),
            tuple(dict.fromkeys(self.free + addition.free)),
            tuple(dict(self.fixed + addition.fixed).items()),
        )

    def minus(self, *names: str) -> Hypothesis:
        """The hypothesis without some terms and their parameters."""

        def remains(path: str) -> bool:
            return path.rpartition(".")[0] not in names

        return Hypothesis(
            tuple(name for name in self.names if name not in names),
            tuple(path for path in self.free if remains(path)),
            tuple((path, value) for path, value in self.fixed if remains(path)),
        )

    @property
    def breath_terms(self) -> tuple[str, ...]:
        """Terms with parameters that differ from breath to breath."""
        return tuple(name for name in self.names if varies_by_breath(name))

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """Paths of all parameters that are fitted."""
        fixed = dict(self.fixed)
        paths = dict.fromkeys((*free_paths(self.names), *self.free))
        return tuple(path for path in paths if path not in fixed)


def varies_by_breath(name: str) -> bool:
    """Whether a term has parameters that differ from breath to breath."""
    return any(parameter.scope == "breath" for parameter in mechanism(name).description.parameters)


def all_parameter_paths(
    settings: SelectionConfig, excluded: Collection[str] = ()
) -> tuple[str, ...]:
    """Paths of the parameters of all candidates: library, basis terms and events.

    Mechanisms that cannot act are left out; those that differ from breath to breath stay in any
    case, so that test lungs and patients share compiled functions.
    """
    candidates = [name for name in library() if name not in excluded or varies_by_breath(name)]
    chosen = settings.search.nonparametric_terms
    return paths((*candidates, *intermittent(), *(basis_terms() if chosen is None else chosen)))


def make_partition(
    data: Data, names: tuple[str, ...], settings: SelectionConfig = DEFAULT
) -> Partition:
    """Combine breaths with a predictor of their measurements.

    Args:
        data: the breaths.
        names: paths of the predictor's parameters.
        settings: give the number of breaths that are simulated at once, unless they are few.
    """
    return Partition(data, Predictor(data, names, sizes=(_FEW, settings.data.batch_size)))


@dataclass(frozen=True, eq=False)
class FittedModel(Fit):
    """A hypothesis at its maximum-likelihood parameters."""

    hypothesis: Hypothesis  #: the terms.

    @cached_property
    def jacobian(self) -> tuple[Floats, Floats]:
        """Residual and its derivative by the free parameters; see :meth:`Problem.jacobian`."""
        return self.problem.jacobian(self.minimum.x)

    def residual_excluding(self, name: str) -> Floats:
        """Residual with the strength of one mechanism set to zero, ``(n, c, T)``."""
        values = self.values.copy()
        values[:, self.problem.predictor.names.index(strength_path(name))] = 0.0
        return self.problem.residual_of(values)
