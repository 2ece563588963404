"""What new breaths would say about two hypotheses: nats, by linear theory around both fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ventbench.physics.catalogue import parameter, strength_path
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.least_squares import Minimum
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem
from ventbench.system_id.unknowns import described

#: Share of the diagonal that keeps a Hessian invertible where data say nothing.
_RIDGE = 1e-9

#: Refits with the weights of robust noise.
_REFITS = 4


class Fitted(Protocol):
    """A hypothesis at its optimum: a fit, or anything with its problem and its minimum."""

    @property
    def problem(self) -> Problem:
        """Of the breaths recorded so far."""
        ...

    @property
    def minimum(self) -> Minimum:
        """Where its cost is least."""
        ...


def acting(fitted: Fitted) -> tuple[str, ...]:
    """Names of the mechanisms of a hypothesis: free ones, and fixed ones that are not neutral."""
    problem = fitted.problem
    free = {path.rpartition(".")[0] for path in problem.unknowns.paths}
    owners = dict.fromkeys(path.rpartition(".")[0] for path in problem.simulator.names)
    names = []
    for name in filter(None, owners):
        path = strength_path(name)
        column = problem.fixed[:, problem.simulator.names.index(path)]
        if name in free or np.any(column != parameter(path).neutral):
            names.append(name)
    return tuple(names)


@dataclass(frozen=True, eq=False)
class Forecast:
    """What a hypothesis expects of m new breaths.

    Attributes:
        white: predicted readings, whitened, ``(m, c T)``.
        rows: their derivatives by the shared unknowns, ``(m, s, c T)``.
        own: by what is a breath's own, ``(m, o, c T)``.
        own_precision: what is known of that beforehand, ``(o,)``.
        known: information of the recorded breaths on the shared unknowns, ``(s, s)``.
    """

    white: Floats
    rows: Floats
    own: Floats
    own_precision: Floats
    known: Floats


def values_of(fitted: Fitted, data: Data, lung: NDArray[np.intp], start: float) -> Floats:
    """Physical values for new breaths, ``(m, P + 1)``: those of recorded ones, in turn.

    Args:
        fitted: the hypothesis.
        data: m new breaths.
        lung: recorded breaths of the same lung.
        start: reading that the new breaths start from, cmH2O.
    """
    problem = fitted.problem
    rows = np.resize(lung, len(data))
    values = problem.values(fitted.minimum.x)[rows]
    columns = (*problem.simulator.names, START)
    if "position" in columns:
        values[:, columns.index("position")] = data.position
    values[:, -1] = start
    return values


def forecast(
    fitted: Fitted, data: Data, simulator: Simulator, lung: NDArray[np.intp], start: float,
    noise: Noise,
) -> Forecast:  # fmt: skip
    """Predict new breaths with derivatives; arguments as in :func:`values_of`."""
    problem = fitted.problem
    layout = problem.unknowns
    values = values_of(fitted, data, lung, start)
    seen, slopes = simulator.derivatives(values, problem.columns)
    slopes = slopes * layout.slopes(values[:, list(problem.columns)])[:, :, None, None]
    rows = noise.whiten(slopes, data.weight).reshape(len(data), len(layout.paths), -1)
    white = noise.whiten(seen, data.weight).reshape(len(data), -1)
    mine = np.array([_own(problem, column) for column in range(len(layout.paths))])
    index = layout.index[lung[0]]
    known = _information(fitted.minimum.hessian, index[~mine])
    return Forecast(white, rows[:, ~mine], rows[:, mine], problem.precision[index[mine]], known)


@dataclass(frozen=True, eq=False)
class Contrast:
    """One hypothesis is true and another one is refitted, in each of m new breaths.

    What is a breath's own is refitted already: rows and differences are what that leaves.

    Attributes:
        difference: whitened, ``(m, k)``.
        rows: derivatives by the shared unknowns of the refitted hypothesis, ``(m, s, k)``.
        known: information of the recorded breaths on these, ``(s, s)``.
        noise: whose loss counts.
    """

    difference: Floats
    rows: Floats
    known: Floats
    noise: Noise

    def nats(self, which: NDArray[np.intp]) -> float:
        """Expected loss of log-likelihood of the refitted hypothesis in some of the breaths."""
        rows, difference = self.rows[which], self.difference[which]
        left, step = difference, np.zeros(len(self.known))
        for _ in range(_REFITS):
            weighted = rows * self.noise.influence(left)[:, None]
            hessian = self.known + np.matmul(weighted, rows.swapaxes(1, 2)).sum(axis=0)
            gradient = np.matmul(weighted, difference[:, :, None])[:, :, 0].sum(axis=0)
            step = np.linalg.solve(_regular(hessian), gradient)
            left = difference - np.einsum("msk,s->mk", rows, step)
        return float(np.sum(self.noise.loss(left)) + 0.5 * step @ self.known @ step)


def contrast(truth: Forecast, refitted: Forecast, noise: Noise) -> Contrast:
    """How far apart two hypotheses are in each breath, if the first is true."""
    count, extra = len(truth.white), len(refitted.own_precision)
    more = np.zeros((count, extra))
    difference = np.concatenate([truth.white - refitted.white, more], axis=1)
    rows = np.concatenate(
        [refitted.rows, np.zeros((*refitted.rows.shape[:2], extra))], axis=2
    )  # fmt: skip
    # What is known of a breath's own unknowns beforehand counts as further readings of them.
    before = np.broadcast_to(np.diag(np.sqrt(refitted.own_precision)), (count, extra, extra))
    own = np.concatenate([refitted.own, before], axis=2)
    both = np.concatenate([rows, difference[:, None]], axis=1)
    inner = np.matmul(own, own.swapaxes(1, 2))
    share = np.linalg.solve(_regular(inner), np.matmul(own, both.swapaxes(1, 2)))
    both = both - np.matmul(share.swapaxes(1, 2), own)
    return Contrast(both[:, -1], both[:, :-1], refitted.known, noise)


def _own(problem: Problem, column: int) -> bool:
    """Whether a free parameter is each breath's own."""
    path = problem.unknowns.paths[column]
    if path in ("R", "C"):
        return False
    alone = len(np.unique(problem.unknowns.index[:, column])) == len(problem.data) > 1
    return alone or path == START or described(path).scope == "breath"


def _information(hessian: Floats, which: NDArray[np.int64]) -> Floats:
    """What a Hessian says of some unknowns, all others refitted."""
    covariance = np.asarray(np.linalg.inv(_regular(hessian)), np.float64)
    return np.asarray(np.linalg.inv(_regular(covariance[np.ix_(which, which)])), np.float64)


def _regular(matrix: Floats) -> Floats:
    """The matrix with a diagonal that can be divided by, ``(..., k, k)``."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    most = np.max(diagonal, axis=-1, keepdims=True, initial=1e-300)
    extra = _RIDGE * np.maximum(diagonal, _RIDGE * most)
    return matrix + extra[..., None] * np.eye(matrix.shape[-1])
