"""Regression of pressure, breath by breath: cross products, fits, likelihoods, intervals.

Each piece of a breath has an offset and a drift of its own, and first-order autoregressive noise.
For each autocorrelation of a grid, all columns are whitened and cleared of offset and drift once;
after that every fit of any columns needs only sums of small matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.mechanics.segments import Segment
from ventbench.mechanics.terms import COLUMNS

Floats = NDArray[np.float64]

#: Autocorrelations between neighbouring smoothed samples.
GRID = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.88, 0.94)

#: Smallest standard deviation that is believed, cmH2O.
_FLOOR = 0.005


@dataclass(frozen=True, eq=False)
class Table:
    """Cross products of all columns and the pressure, of b breaths.

    Attributes:
        products: ``(b, len(GRID), K + 1, K + 1)`` for K columns; the last row belongs to the
            pressure.
        freedom: samples less offsets and drifts, ``(b,)``.
        constant: terms of the log-likelihood that depend on the autocorrelation, ``(b, grid)``.
        breaths: index of each breath in the recording, ``(b,)``.
    """

    products: Floats
    freedom: Floats
    constant: Floats
    breaths: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of breaths b."""
        return len(self.freedom)


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit of k columns.

    Attributes:
        columns: by index.
        x: coefficients, ``(k,)``.
        sigma: standard deviation of what is new in each smoothed sample, cmH2O.
        grid: index of the autocorrelation.
    """

    columns: tuple[int, ...]
    x: Floats
    sigma: float
    grid: int


def table(segments: Sequence[Segment], columns: Sequence[int] | None = None) -> Table:
    """Cross products of all breaths that have a piece, of some columns or of all."""
    chosen = COLUMNS if columns is None else [COLUMNS[c] for c in columns]
    indices = sorted({segment.breath for segment in segments})
    size = len(chosen) + 1
    products = np.zeros((len(indices), len(GRID), size, size))
    freedom, constant = np.zeros(len(indices)), np.zeros((len(indices), len(GRID)))
    for segment in segments:
        row = indices.index(segment.breath)
        full = np.stack([c.values(segment) for c in chosen] + [segment.pressure], axis=1)
        own = np.stack([np.ones(len(segment)), segment.time - segment.time.mean()], axis=1)
        freedom[row] += len(segment) - own.shape[1]
        for k, rho in enumerate(GRID):
            white, nuisance = (_whiten(x, rho, segment.begins) for x in (full, own))
            basis, upper = np.linalg.qr(nuisance)
            white = white - basis @ (basis.T @ white)
            products[row, k] += white.T @ white
            constant[row, k] += 0.5 * segment.begins.sum() * np.log(1.0 - rho**2)
            constant[row, k] -= float(np.sum(np.log(np.abs(np.diag(upper)))))
    return Table(products, freedom, constant, np.array(indices, np.int64))


def solve(table: Table, which: NDArray[np.bool_], columns: Sequence[int]) -> Solution:
    """Fit columns to some of the breaths, by restricted likelihood over the grid."""
    columns = tuple(columns)
    pick = [*columns, -1]
    total = table.products[which].sum(axis=0)[:, pick][:, :, pick]
    freedom = float(table.freedom[which].sum())
    constants = table.constant[which].sum(axis=0)
    best, reached = None, -np.inf
    for k in range(len(GRID)):
        left = _regular(total[k, :-1, :-1])
        x = np.linalg.solve(left, total[k, :-1, -1])
        square = max(float(total[k, -1, -1] - x @ total[k, :-1, -1]), 0.0)
        sigma = max(np.sqrt(square / max(freedom - len(columns), 1.0)), _FLOOR)
        value = constants[k] - freedom * np.log(sigma) - 0.5 * square / sigma**2
        if value > reached:
            best, reached = Solution(columns, x, float(sigma), k), value
    assert best is not None
    return best


def log_likelihood(table: Table, found: Solution) -> Floats:
    """Of each breath, its own offsets and drifts integrated out, ``(b,)``, up to a constant."""
    pick = [*found.columns, -1]
    products = table.products[:, found.grid][:, pick][:, :, pick]
    towards = np.append(found.x, -1.0)
    square = np.einsum("i,bij,j->b", towards, products, towards)
    return (
        table.constant[:, found.grid]
        - table.freedom * np.log(found.sigma)
        - 0.5 * square / found.sigma**2
    )


def covariance(table: Table, found: Solution) -> Floats:
    """Of the coefficients, ``(k, k)``: the larger of the model's and the spread of the breaths'.

    The breaths are the independent units: a sandwich of their scores, with the correction for few
    of them.
    """
    columns = list(found.columns)
    products = table.products[:, found.grid]
    curvature = products[:, columns][:, :, columns]
    bread = np.asarray(np.linalg.inv(_regular(curvature.sum(axis=0))), np.float64)
    model = bread * found.sigma**2
    count = len(table)
    if count < 3:
        return model
    scores = products[:, columns, -1] - curvature @ found.x
    meat = scores.T @ scores * count / (count - 1)
    sandwich = bread @ meat @ bread
    grown = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(model), 1.0))
    return model * np.outer(grown, grown)


def effect(table: Table, found: Solution, column: int) -> float:
    """Root mean square of what a column alone explains, others refitted, cmH2O."""
    others = [c for c in found.columns if c != column]
    total = table.products[:, 0].sum(axis=0)
    own = total[column, column]
    if others:
        cross = total[others, column]
        own = own - cross @ np.linalg.solve(_regular(total[np.ix_(others, others)]), cross)
    x = found.x[found.columns.index(column)]
    return float(abs(x) * np.sqrt(max(own, 0.0) / table.freedom.sum()))


def _whiten(values: Floats, rho: float, begins: NDArray[np.bool_]) -> Floats:
    out = values.copy()
    out[1:] -= rho * values[:-1]
    out[begins] = np.sqrt(1.0 - rho**2) * values[begins]
    return out


def _regular(matrix: Floats) -> Floats:
    return matrix + np.diag(1e-10 * np.diag(matrix) + 1e-30)
