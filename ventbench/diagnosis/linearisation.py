"""A fitted model to first order: what a refit of its parameters can absorb, and what it cannot.

Residuals are whitened by the noise. What each breath's own parameters absorb, and then what the
shared parameters absorb, is projected out. What is left of a change of the prediction is a
template: its inner product with what is left of the residual tells how much log-likelihood the
change gains after a refit, without doing one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.diagnosis.settings import ScreeningSettings
from ventbench.system_id.data import Floats
from ventbench.system_id.problem import Problem


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A fitted model to first order, with m whitened samples in each of n breaths.

    Attributes:
        problem: the model's breaths and noise.
        values: physical values of all parameters and of the start, ``(n, P + 1)``.
        prediction: simulated readings, ``(n, c, T)``.
        residual: simulated minus measured, whitened and projected, ``(n, m)``.
        own_basis: orthonormal directions that each breath absorbs by itself, ``(n, j, m)``.
        shared_basis: orthonormal directions that all breaths absorb together, ``(s, n m)``.
    """

    problem: Problem
    values: Floats
    prediction: Floats
    residual: Floats
    own_basis: Floats
    shared_basis: Floats

    def whiten(self, difference: Floats) -> Floats:
        """Whiten differences of predictions, ``(n, ..., c, T)`` to ``(n, ..., m)``."""
        white = self.problem.noise.whiten(
            difference * self.problem.data.weight[(slice(None), *(None,) * (difference.ndim - 3))],
            self.problem.data.weight,
        )
        return white.reshape(*white.shape[:-2], -1)

    def without_own(self, white: Floats) -> Floats:
        """Project out what each breath absorbs by itself, ``(n, q, m)``."""
        basis = self.own_basis
        return white - np.matmul(np.matmul(white, basis.swapaxes(1, 2)), basis)

    def without_shared(self, white: Floats) -> Floats:
        """Project out what all breaths absorb together, ``(n, q, m)``."""
        n, q, m = white.shape
        flat = white.swapaxes(0, 1).reshape(q, n * m)
        flat = flat - (flat @ self.shared_basis.T) @ self.shared_basis
        return flat.reshape(q, n, m).swapaxes(0, 1)

    def template(self, prediction: Floats) -> Floats:
        """Part of another prediction ``(n, c, T)`` that no refit can absorb, ``(n, m)``."""
        white = self.without_own(self.whiten(prediction - self.prediction)[:, None])
        return self.without_shared(white)[:, 0]

    def gain(self, template: Floats) -> tuple[float, float]:
        """Log-likelihood that the best multiple of a template gains, nats, and that multiple.

        The multiple is negative if the opposite effect would help.
        """
        power = float(np.sum(template**2))
        if power < 1e-12:
            return 0.0, 0.0
        share = -float(np.sum(self.residual * template)) / power
        return 0.5 * share**2 * power, share


def linearise(
    problem: Problem, x: Floats, settings: ScreeningSettings, *, clip: float | None = None
) -> Linearisation:
    """Linearise a problem at its unknowns.

    Args:
        problem: breaths and noise.
        x: unknowns in coordinates, ``(U,)``.
        settings: settings of the projections.
        clip: whitened residuals are cut off here; as the settings have it if None.
    """
    clip = settings.clip if clip is None else clip
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
    own = _orthonormal(rows[:, breath], settings.ridge)
    values = problem.values(x)
    partial = Linearisation(problem, values, residual, white, own, np.zeros((0, white.size)))
    columns = []
    for k in np.flatnonzero(~breath):
        left = partial.without_own(rows[:, [k]])[:, 0]
        for unknown in np.unique(layout.index[:, k]):
            columns.append(np.where((layout.index[:, k] == unknown)[:, None], left, 0.0).ravel())
    shared = partial.shared_basis
    if columns:
        shared = _orthonormal(np.asarray(columns)[None], settings.ridge)[0]
    whole = Linearisation(problem, values, problem.predict(x), white, own, shared)
    clean = whole.without_shared(whole.without_own(white[:, None]))[:, 0]
    return Linearisation(problem, values, whole.prediction, clean, own, shared)


def _orthonormal(rows: Floats, ridge: float) -> Floats:
    """Orthonormal bases of the row spaces, ``(n, j, m)``; dependent rows become zero."""
    if rows.shape[1] == 0:
        return rows
    gram = np.matmul(rows, rows.swapaxes(1, 2))
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / scale[:, :, None] / scale[:, None, :])
    kept = values > ridge * np.maximum(values[:, -1:], 1e-300)
    size = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
    return np.matmul((vectors * size[:, None, :]).swapaxes(1, 2), rows / scale[:, :, None])
