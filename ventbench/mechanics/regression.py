"""Regression of pressure on flow and volume: columns, cross products, fits, likelihoods.

Each segment of a breath has an offset and a drift of its own, and first-order autoregressive noise.
For each autocorrelation of a grid, all columns are whitened and projected off offset and drift
once; every fit of any columns then needs only sums of small matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.mechanics.segments import Segment

Floats = NDArray[np.float64]

#: Autocorrelations between neighbouring smoothed samples.
GRID = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.88, 0.94)

#: Smallest standard deviation of the noise, cmH2O; a smaller one is an artefact of rounding.
_LEAST_SIGMA = 0.005

#: Relaxation times to choose from, s.
TIMES = tuple(float(x) for x in np.geomspace(0.3, 3.0, 11))


@dataclass(frozen=True)
class RegressionColumn:
    """A column of the regression; a term may have several columns to choose from.

    Attributes:
        term: name of the effect.
        values: values of the column in a segment, ``(n,)``.
        time: relaxation time, s, or None.
    """

    term: str
    values: Callable[[Segment], Floats]
    time: float | None = None


def _relaxing_volume(time: float, periodic: bool) -> Callable[[Segment], Floats]:
    """Solution of dS/dt = Q - S / time, from rest or as if the same breath came before."""

    def values(segment: Segment) -> Floats:
        t, v = segment.time, segment.volume
        decay = np.exp(-np.diff(t) / time)
        # Exact for a flow that is constant within a step.
        gain = (1.0 - decay) * time / np.diff(t) * np.diff(v)
        steps = list(zip(decay.tolist(), gain.tolist(), strict=True))
        relaxed = [0.0]
        for _ in range(2 if periodic else 1):
            relaxed = [relaxed[-1]]
            for kept, added in steps:
                relaxed.append(relaxed[-1] * kept + added)
        return np.array(relaxed)

    return values


#: Columns of R and 1/C, which every fit has.
BASE = (
    RegressionColumn("resistance", lambda s: s.flow),
    RegressionColumn("elastance", lambda s: s.volume),
)

#: All columns.
COLUMNS = (
    *BASE,
    RegressionColumn("turbulent_resistance", lambda s: s.flow * np.abs(s.flow)),
    RegressionColumn("nonlinear_compliance", lambda s: s.volume**2),
    RegressionColumn("inertance", lambda s: s.slope),
    RegressionColumn("leak", lambda s: -s.dose),
    RegressionColumn("direction_resistance", lambda s: np.minimum(s.flow, 0.0)),
    RegressionColumn("volume_resistance", lambda s: s.flow * s.volume),
    RegressionColumn("expiratory_flow", lambda s: np.minimum(s.flow, 0.0) * np.abs(s.flow)),
    *(
        RegressionColumn("viscoelasticity", _relaxing_volume(time, periodic), time)
        for periodic in (False, True)
        for time in TIMES
    ),
)

#: Terms beyond R and C, in the order of their columns.
TERMS = tuple(dict.fromkeys(column.term for column in COLUMNS[len(BASE) :]))

#: Terms whose coefficient must be positive.
POSITIVE = ("turbulent_resistance", "viscoelasticity", "leak")


def columns_of(term: str) -> tuple[int, ...]:
    """Indices of the columns of a term."""
    return tuple(i for i, column in enumerate(COLUMNS) if column.term == term)


@dataclass(frozen=True, eq=False)
class CrossProducts:
    """Cross products of the columns and the pressure, of b breaths.

    Attributes:
        products: ``(b, g, K + 1, K + 1)`` for the g autocorrelations of :data:`GRID` and K columns;
            the last row and column belong to the pressure.
        freedom: number of samples less offsets and drifts, ``(b,)``.
        constant: part of the log-likelihood that depends on the autocorrelation alone, ``(b, g)``.
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
class RegressionFit:
    """A fit of k columns.

    Attributes:
        columns: indices of the columns.
        coefficients: ``(k,)``.
        sigma: standard deviation of the innovations of the noise, cmH2O.
        grid: index of the autocorrelation in :data:`GRID`.
    """

    columns: tuple[int, ...]
    coefficients: Floats
    sigma: float
    grid: int


def cross_products(
    segments: Sequence[Segment], columns: Sequence[int] | None = None
) -> CrossProducts:
    """Compute the cross products of the breaths that have segments.

    Args:
        segments: segments of the breaths.
        columns: indices of the columns; all if None.
    """
    chosen = COLUMNS if columns is None else [COLUMNS[c] for c in columns]
    indices = sorted({segment.breath for segment in segments})
    size = len(chosen) + 1
    products = np.zeros((len(indices), len(GRID), size, size))
    freedom, constant = np.zeros(len(indices)), np.zeros((len(indices), len(GRID)))
    for segment in segments:
        row = indices.index(segment.breath)
        full = np.stack([c.values(segment) for c in chosen] + [segment.pressure], axis=1)
        drift = np.stack([np.ones(len(segment)), segment.time - segment.time.mean()], axis=1)
        freedom[row] += len(segment) - drift.shape[1]
        white, nuisance = (_whiten(signals, segment.begins) for signals in (full, drift))
        basis, upper = np.linalg.qr(nuisance)
        white = white - basis @ (basis.mT @ white)
        products[row] += white.mT @ white
        constant[row] += 0.5 * segment.begins.sum() * np.log(1.0 - np.square(GRID))
        constant[row] -= np.log(np.abs(np.diagonal(upper, axis1=1, axis2=2))).sum(axis=1)
    return CrossProducts(products, freedom, constant, np.array(indices, np.int64))


def fit(table: CrossProducts, which: NDArray[np.bool_], columns: Sequence[int]) -> RegressionFit:
    """Fit columns to some of the breaths by restricted maximum likelihood.

    Args:
        table: table of the breaths.
        which: breaths to fit, bool ``(b,)``.
        columns: indices of the columns.
    """
    columns = tuple(columns)
    pick = [*columns, -1]
    total = table.products[
        np.ix_(np.flatnonzero(which).tolist(), range(len(GRID)), pick, pick)
    ].sum(axis=0)
    freedom = float(table.freedom[which].sum())
    constants = table.constant[which].sum(axis=0)
    right = total[:, :-1, -1]
    x = np.linalg.solve(_regularised(total[:, :-1, :-1]), right[..., None])[..., 0]
    square = np.maximum(total[:, -1, -1] - np.vecdot(x, right), 0.0)
    sigma = np.maximum(np.sqrt(square / max(freedom - len(columns), 1.0)), _LEAST_SIGMA)
    value = constants - freedom * np.log(sigma) - 0.5 * square / sigma**2
    best = int(np.argmax(value))
    return RegressionFit(columns, x[best], float(sigma[best]), best)


def log_likelihood(table: CrossProducts, fitted: RegressionFit) -> Floats:
    """Log-likelihood of each breath, ``(b,)``, up to a constant.

    Offsets and drifts are integrated out.
    """
    pick = [*fitted.columns, -1]
    products = table.products[:, fitted.grid][:, pick][:, :, pick]
    towards = np.append(fitted.coefficients, -1.0)
    square = np.einsum("i,bij,j->b", towards, products, towards)
    return (
        table.constant[:, fitted.grid]
        - table.freedom * np.log(fitted.sigma)
        - 0.5 * square / fitted.sigma**2
    )


def covariance(table: CrossProducts, fitted: RegressionFit) -> Floats:
    """Covariance of the coefficients, ``(k, k)``.

    Each variance is the larger of the model's and that of a sandwich estimator, whose independent
    units are the breaths, corrected for their small number.
    """
    columns = list(fitted.columns)
    products = table.products[:, fitted.grid]
    curvature = products[:, columns][:, :, columns]
    bread = np.asarray(np.linalg.inv(_regularised(curvature.sum(axis=0))), np.float64)
    model = bread * fitted.sigma**2
    count = len(table)
    if count < 3:
        return model
    scores = products[:, columns, -1] - curvature @ fitted.coefficients
    meat = scores.T @ scores * count / (count - 1)
    sandwich = bread @ meat @ bread
    grown = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(model), 1.0))
    return model * np.outer(grown, grown)


def effect_size(table: CrossProducts, fitted: RegressionFit, column: int) -> float:
    """Root mean square of what a column explains beyond the others, cmH2O."""
    others = [c for c in fitted.columns if c != column]
    total = table.products[:, 0].sum(axis=0)
    square = total[column, column]
    if others:
        cross = total[others, column]
        square = square - cross @ np.linalg.solve(
            _regularised(total[np.ix_(others, others)]), cross
        )
    x = fitted.coefficients[fitted.columns.index(column)]
    return float(abs(x) * np.sqrt(max(square, 0.0) / table.freedom.sum()))


def _whiten(values: Floats, begins: NDArray[np.bool_]) -> Floats:
    """Whiten signals ``(n, c)`` for each autocorrelation of the grid, ``(g, n, c)``."""
    rho = np.array(GRID)[:, None, None]
    white = np.repeat(values[None], len(GRID), axis=0)
    white[:, 1:] -= rho * values[:-1]
    white[:, begins] = np.sqrt(1.0 - rho**2) * values[begins]
    return white


def _regularised(matrix: Floats) -> Floats:
    """Matrices ``(..., k, k)`` with slightly larger diagonals, so that they can be inverted."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    return matrix + (1e-10 * diagonal + 1e-30)[..., None] * np.eye(matrix.shape[-1])
