"""Whitened residuals, templates and what the refitted parameters can absorb of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.system_id.data import Floats
from ventbench.system_id.problem import Problem

#: Whitened residuals count up to here.
CLIP = 4.0

#: Relative ridge of the projections.
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A fitted hypothesis seen as linear: m whitened samples in each of n breaths.

    Attributes:
        problem: of the breaths that count.
        values: physical values of everything, ``(n, P + 1)``.
        seen: what is predicted there, ``(n, c, T)``.
        residual: simulated minus measured, whitened, what the unknowns can absorb taken out,
            ``(n, m)``.
        own: orthonormal directions that each breath absorbs for itself, ``(n, j, m)``.
        shared: orthonormal directions that all breaths absorb together, ``(s, n m)``.
    """

    problem: Problem
    values: Floats
    seen: Floats
    residual: Floats
    own: Floats
    shared: Floats

    def whitened(self, difference: Floats) -> Floats:
        """Whiten differences of predictions, ``(n, ..., c, T)`` to ``(n, ..., m)``."""
        white = self.problem.noise.whiten(
            difference * self.problem.data.weight[(slice(None), *(None,) * (difference.ndim - 3))],
            self.problem.data.weight,
        )
        return white.reshape(*white.shape[:-2], -1)

    def without_own(self, white: Floats) -> Floats:
        """Take out what each breath absorbs for itself, ``(n, q, m)``."""
        return white - np.matmul(np.matmul(white, self.own.swapaxes(1, 2)), self.own)

    def without_shared(self, white: Floats) -> Floats:
        """Take out what all breaths absorb together, ``(n, q, m)``."""
        n, q, m = white.shape
        flat = white.swapaxes(0, 1).reshape(q, n * m)
        flat = flat - (flat @ self.shared.T) @ self.shared
        return flat.reshape(q, n, m).swapaxes(0, 1)

    def template(self, seen: Floats) -> Floats:
        """What another prediction adds that no refit can absorb, ``(n, m)``."""
        white = self.without_own(self.whitened(seen - self.seen)[:, None])
        return self.without_shared(white)[:, 0]


def linearise(problem: Problem, x: Floats, clip: float = CLIP) -> Linearisation:
    """Linearise a problem at its unknowns.

    Args:
        problem: of the breaths that count.
        x: unknowns in coordinates.
        clip: whitened residuals beyond are cut off, so that no single sample decides.
    """
    residual, slopes = problem.jacobian(x)
    weight, noise = problem.data.weight, problem.noise
    white = np.clip(noise.whiten(residual, weight), -clip, clip)
    white = white.reshape(len(white), -1)
    rows = noise.whiten(slopes, weight)
    rows = rows.reshape(*rows.shape[:2], -1)
    layout = problem.unknowns
    breath = np.array([item.scope == "breath" for item in layout.parameters])
    # A shared parameter by grouping may also be one of each breath (its valve's gain).
    counts = [len(np.unique(layout.index[:, k])) for k in range(len(layout.paths))]
    breath |= np.array([count == len(white) and count > 1 for count in counts])
    own = _orthonormal(rows[:, breath])
    values = problem.values(x)
    found = Linearisation(problem, values, residual, white, own, np.zeros((0, white.size)))
    columns = []
    for k in np.flatnonzero(~breath):
        left = found.without_own(rows[:, [k]])[:, 0]
        for unknown in np.unique(layout.index[:, k]):
            columns.append(np.where((layout.index[:, k] == unknown)[:, None], left, 0.0).ravel())
    shared = _orthonormal(np.asarray(columns)[None])[0] if columns else found.shared
    found = Linearisation(problem, values, problem.predict(x), white, own, shared)
    clean = found.without_shared(found.without_own(white[:, None]))[:, 0]
    return Linearisation(problem, values, found.seen, clean, own, shared)


def gain(local: Linearisation, template: Floats) -> tuple[float, float]:
    """Nats that the best multiple of a template gains, and that multiple (negative: none)."""
    power = float(np.sum(template**2))
    if power < 1e-12:
        return 0.0, 0.0
    share = -float(np.sum(local.residual * template)) / power
    return 0.5 * share**2 * power, share


def _orthonormal(rows: Floats) -> Floats:
    """Orthonormal bases of the row spaces, ``(n, j, m)``; dependent rows become zero."""
    if rows.shape[1] == 0:
        return rows
    gram = np.matmul(rows, rows.swapaxes(1, 2))
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / scale[:, :, None] / scale[:, None, :])
    kept = values > _RIDGE * np.maximum(values[:, -1:], 1e-300)
    size = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
    return np.matmul((vectors * size[:, None, :]).swapaxes(1, 2), rows / scale[:, :, None])
