"""Regression of pressure on flow and volume: columns, cross products, fits, likelihoods.

Each segment of a breath has an offset of its own, a drift, and first-order autoregressive noise.
The drifts scatter around that of a flow sensor whose zero is off. Both have normal priors, the
second of which is a constant (:data:`ZERO`), so that a leak, which also makes the volume drift, can
be told where a flow sensor could not be so far off. For each noise of a grid, all columns are
whitened and projected off the offsets once; every fit of any columns then needs only sums of small
matrices.

A lag of the pressure sensor delays the columns, and not the measured pressure back: a derivative of
the measured pressure would have its noise, which makes a lag look shorter than it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import solve_banded

from ventbench.base.arrays import Bools, Floats
from ventbench.base.linear import inverse, solve
from ventbench.mechanics.segments import Segment

#: Autocorrelations between neighbouring smoothed samples.
_AUTOCORRELATIONS = (0.0, 0.2, 0.4, 0.55, 0.7, 0.8, 0.88, 0.94)

#: Standard deviations of the drift between segments, over that of the noise's innovations, 1/s.
_DRIFTS = (0.05, 0.25, 1.0, 4.0, 16.0)

#: Standard deviation of what a lag has in it from before a segment, over that of the innovations.
_START = 30.0

#: Models of the noise to choose from: autocorrelation, and scatter of the drift.
GRID = tuple(product(_AUTOCORRELATIONS, _DRIFTS))

#: Standard deviation of the zero of flow sensors, L/s. In the clean public runs, none of which has
#: a known leak, it is 1 to 8 mL/s, and twice that in few.
ZERO = 0.005

#: Least elastance from which the drift of a flow sensor's zero is computed, cmH2O/L.
_LEAST_ELASTANCE = 2.5

#: Smallest standard deviation of the noise, cmH2O; a smaller one is an artefact of rounding.
_LEAST_SIGMA = 0.005

#: Relaxation times to choose from, s.
TIMES = tuple(float(x) for x in np.geomspace(0.3, 3.0, 11))


@dataclass(frozen=True)
class RegressionColumn:
    """A column of the regression; a term may have several columns to choose from."""

    term: str  #: name of the effect.
    #: values of the column at the m samples of a segment, ``(m,)``.
    values: Callable[[Segment], Floats]
    time: float | None = None  #: relaxation time, s, or None.


def _driven(decay: Floats, added: Floats) -> Floats:
    """Course of ``x[k + 1] = decay[k] x[k] + added[k]`` from zero, ``(m,)`` or ``(m, c)``."""
    bands = np.stack([np.ones(len(decay) + 1), -np.append(decay, 0.0)])
    return solve_banded((1, 0), bands, np.concatenate([np.zeros_like(added[:1]), added]))


def _relaxing_volume(time: float, periodic: bool) -> Callable[[Segment], Floats]:
    """Solution of dS/dt = Q - S / time, from rest or as if the same breath came before."""

    def values(segment: Segment) -> Floats:
        step = np.diff(segment.time)
        decay = np.exp(-step / time)
        # Exact for a flow that is constant within a step.
        gain = (1.0 - decay) * time / step * np.diff(segment.volume)
        relaxed = _driven(decay, gain)
        if periodic:
            relaxed = relaxed + relaxed[-1] * np.exp(-(segment.time - segment.time[0]) / time)
        return relaxed

    return values


#: Columns that every fit has: R, 1/C, and the drift by a flow sensor's zero.
BASE = (
    RegressionColumn("resistance", lambda s: s.flow),
    RegressionColumn("elastance", lambda s: s.volume),
    RegressionColumn("flow_zero", lambda s: s.time),
)

_ELASTANCE, _FLOW_ZERO = 1, 2

#: All columns.
COLUMNS = (
    *BASE,
    RegressionColumn("turbulent_resistance", lambda s: s.flow * np.abs(s.flow)),
    RegressionColumn("nonlinear_compliance", lambda s: s.volume**2),
    RegressionColumn("inertance", lambda s: s.slope),
    RegressionColumn("direction_resistance", lambda s: np.minimum(s.flow, 0.0)),
    RegressionColumn("direction_resistance", lambda s: np.minimum(s.flow, 0.0) * np.abs(s.flow)),
    RegressionColumn("volume_resistance", lambda s: s.flow * s.volume),
    *(
        RegressionColumn("viscoelasticity", _relaxing_volume(time, periodic), time)
        for periodic in (False, True)
        for time in TIMES
    ),
)

#: Columns of a lung behind a parabolic resistor, as airways and test lungs have.
PARABOLIC = tuple(range(len(BASE) + 1))

#: Terms beyond R and C, in the order of their columns.
TERMS = tuple(dict.fromkeys(column.term for column in COLUMNS[len(BASE) :]))

#: Terms whose coefficient must be positive.
POSITIVE = ("turbulent_resistance", "viscoelasticity", "inertance")


def columns_of(term: str) -> tuple[int, ...]:
    """Indices of the columns of a term."""
    return tuple(i for i, column in enumerate(COLUMNS) if column.term == term)


def lagged(time: Floats, values: Floats, lag: float) -> Floats:
    """Response of a lag, s, to signals ``(m, k)`` at increasing times, s, ``(m,)``, from rest.

    Exact for signals that are linear between the samples.
    """
    step = np.diff(time)[:, None]
    decay = np.exp(-step / lag)
    falls = lag * np.diff(values, axis=0) / step * (1.0 - decay)
    return values - _driven(decay[:, 0], falls)


def course(segment: Segment, columns: Sequence[RegressionColumn]) -> Floats:
    """Columns at all samples of a segment, as late as its pressure, ``(m, k)``."""
    values = np.stack([column.values(segment) for column in columns], axis=1)
    return lagged(segment.time, values, segment.lag) if segment.lag else values


@dataclass(frozen=True, eq=False)
class CrossProducts:
    """Cross products of the columns and the pressure, of b breaths."""

    #: ``(b, g, K + 1, K + 1)`` for the g models of noise of :data:`GRID` and K columns; the last
    #: row and column belong to the pressure.
    products: Floats
    freedom: Floats  #: number of samples less offsets, ``(b,)``.
    #: part of the log-likelihood that depends on the model of noise alone, ``(b, g)``.
    constant: Floats

    def __len__(self) -> int:
        """Number of breaths b."""
        return len(self.freedom)


@dataclass(frozen=True, eq=False)
class RegressionFit:
    """A fit of k columns."""

    columns: tuple[int, ...]  #: indices of the columns.
    coefficients: Floats  #: ``(k,)``.
    sigma: float  #: standard deviation of the innovations of the noise, cmH2O.
    grid: int  #: index of the model of noise in :data:`GRID`.

    @property
    def variance(self) -> float:
        """Variance of the noise, autocorrelation included, cmH2O2."""
        return self.sigma**2 / (1.0 - GRID[self.grid][0] ** 2)

    @property
    def zero_precision(self) -> float:
        """Prior precision, 1 / variance, of the drift by the flow sensor's zero, s2/cmH2O2."""
        return float(_zero_precision(self.coefficients[_ELASTANCE]))

    @property
    def log_prior(self) -> float:
        """Logarithm of the prior density of the flow sensor's zero, up to a constant."""
        return -0.5 * self.zero_precision * float(self.coefficients[_FLOW_ZERO]) ** 2


def _zero_precision(elastance: Floats | float) -> Floats:
    """Prior precision of the drift by the flow sensor's zero, by elastances, cmH2O/L."""
    return (np.maximum(elastance, _LEAST_ELASTANCE) * ZERO) ** -2.0


def cross_products(
    segments: Sequence[Segment], columns: Sequence[int] | None = None
) -> CrossProducts:
    """Cross products of the breaths that have segments, of some columns (as of `fit`) or all."""
    chosen = COLUMNS if columns is None else [COLUMNS[c] for c in columns]
    indices = sorted({segment.breath for segment in segments})
    size = len(chosen) + 1
    products = np.zeros((len(indices), len(GRID), size, size))
    freedom, constant = np.zeros(len(indices)), np.zeros((len(indices), len(GRID)))
    rho = np.array(_AUTOCORRELATIONS)
    for segment in segments:
        row = indices.index(segment.breath)
        time = segment.time[segment.rows]
        targets = np.stack([segment.pressure, time - time.mean(), np.ones(len(time))], axis=1)
        signals = np.concatenate([course(segment, chosen)[segment.rows], targets], axis=1)
        freedom[row] += len(segment) - 1
        white = _whiten(signals, segment.begins)
        constants_of_grid = 0.5 * segment.begins.sum() * np.log(1.0 - rho**2)
        if segment.lag > 0.0:
            start = np.exp(-(time - segment.time[0]) / segment.lag)[:, None]
            white, factor = _project_start(white, _whiten(start, segment.begins)[..., 0])
            constants_of_grid = constants_of_grid - factor
        length = np.linalg.norm(white[..., -1], axis=1)
        level = white[..., -1] / length[:, None]
        white = white[..., :-1] - level[..., None] * (level[:, None] @ white[..., :-1])
        ramp, white = white[..., -1], white[..., :-1]
        squares = white.mT @ white
        along = (ramp[:, None] @ white)[:, 0]  # (r, K + 1)
        size_of_ramp = np.vecdot(ramp, ramp)
        constants_of_grid = constants_of_grid - np.log(length)
        # A drift of scatter s adds s2 times the outer product of the ramp to the covariance.
        scatter = np.square(_DRIFTS)
        grown = 1.0 + scatter * size_of_ramp[:, None]  # (r, d)
        outer = along[:, :, None] * along[:, None, :]
        shrinkage = (scatter / grown)[..., None, None] * outer[:, None]
        products[row] += (squares[:, None] - shrinkage).reshape(len(GRID), size, size)
        constant[row] += (constants_of_grid[:, None] - 0.5 * np.log(grown)).reshape(-1)
    return CrossProducts(products, freedom, constant)


def fit(table: CrossProducts, which: Bools, columns: Sequence[int]) -> RegressionFit:
    """Fit columns, those of :data:`BASE` first, by restricted maximum likelihood.

    ``which`` are the breaths to fit, bool ``(b,)``.
    """
    columns = tuple(columns)
    pick = [*columns, -1]
    total = table.products[which].sum(axis=0)[:, pick][:, :, pick]
    freedom = float(table.freedom[which].sum())
    constants = table.constant[which].sum(axis=0)
    left, right = _regularised(total[:, :-1, :-1]), total[:, :-1, -1]

    def sigma_of(x: Floats) -> tuple[Floats, Floats]:
        towards = np.concatenate([x, np.full((len(x), 1), -1.0)], axis=1)
        square = np.maximum(np.einsum("gi,gij,gj->g", towards, total, towards), 0.0)
        sigma = np.sqrt(square / max(freedom - len(columns), 1.0))
        return np.maximum(sigma, _LEAST_SIGMA), square

    x = solve(left, right[..., None])[..., 0]
    precision = _zero_precision(x[:, _ELASTANCE])
    left = left.copy()
    left[:, _FLOW_ZERO, _FLOW_ZERO] += sigma_of(x)[0] ** 2 * precision
    x = solve(left, right[..., None])[..., 0]
    sigma, square = sigma_of(x)
    value = constants - freedom * np.log(sigma) - 0.5 * square / sigma**2
    value -= 0.5 * precision * x[:, _FLOW_ZERO] ** 2
    best = int(np.argmax(value))
    return RegressionFit(columns, x[best], float(sigma[best]), best)


def log_likelihood(table: CrossProducts, fitted: RegressionFit) -> Floats:
    """Log-likelihood of each breath, ``(b,)``, up to a constant.

    Offsets and the scatter of drifts are integrated out.
    """
    square = _squares(table, fitted)
    return (
        table.constant[:, fitted.grid]
        - table.freedom * np.log(fitted.sigma)
        - 0.5 * square / fitted.sigma**2
    )


#: Residual of a breath over the median one, as a ratio of variances, beyond which it counts less.
_BOUND = 6.0


def influence(table: CrossProducts) -> Floats:
    """Weight of each breath, ``(b,)``: less than one of what no model of the others explains."""
    if len(table) < 4:
        return np.ones(len(table))
    fitted = fit(table, np.ones(len(table), bool), PARABOLIC)
    square = _squares(table, fitted) / np.maximum(table.freedom, 1.0)
    return np.minimum(1.0, _BOUND * np.median(square) / np.maximum(square, 1e-12))


def weighted(table: CrossProducts, weight: Floats) -> CrossProducts:
    """Breaths that count with their weights, ``(b,)``."""
    products = table.products * weight[:, None, None, None]
    return CrossProducts(products, table.freedom * weight, table.constant * weight[:, None])


def bounded(table: CrossProducts) -> CrossProducts:
    """Bound the influence of breaths that no model of the others explains."""
    return weighted(table, influence(table))


def parabolic(segments: Sequence[Segment]) -> RegressionFit:
    """Fit R, C and the quadratic part of the resistance, with bounded influence of breaths."""
    table = bounded(cross_products(segments, PARABOLIC))
    return fit(table, np.ones(len(table), bool), PARABOLIC)


def _squares(table: CrossProducts, fitted: RegressionFit) -> Floats:
    """Sum of the squared innovations of each breath, cmH2O2, ``(b,)``."""
    pick = [*fitted.columns, -1]
    products = table.products[:, fitted.grid][:, pick][:, :, pick]
    towards = np.append(fitted.coefficients, -1.0)
    return np.einsum("i,bij,j->b", towards, products, towards)


def covariance(table: CrossProducts, fitted: RegressionFit) -> Floats:
    """Covariance of the coefficients, ``(k, k)``.

    Each variance is the larger of the model's and that of a sandwich estimator, whose independent
    units are the breaths, corrected for their small number.
    """
    columns = list(fitted.columns)
    products = table.products[:, fitted.grid]
    curvature = products[:, columns][:, :, columns]
    total = _regularised(curvature.sum(axis=0))
    total[_FLOW_ZERO, _FLOW_ZERO] += fitted.sigma**2 * fitted.zero_precision
    bread = inverse(total)
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
    nuisance = [c for c in fitted.columns if c != column]
    total = table.products[:, 0].sum(axis=0)
    cross = total[nuisance, column]
    explained = cross @ solve(_regularised(total[np.ix_(nuisance, nuisance)]), cross)
    square = total[column, column] - explained
    x = fitted.coefficients[fitted.columns.index(column)]
    return float(abs(x) * np.sqrt(max(square, 0.0) / table.freedom.sum()))


def _whiten(values: Floats, begins: Bools) -> Floats:
    """Whiten signals ``(n, c)`` for each autocorrelation, ``(r, n, c)``."""
    rho = np.array(_AUTOCORRELATIONS)[:, None, None]
    white = np.repeat(values[None], len(rho), axis=0)
    white[:, 1:] -= rho * values[:-1]
    white[:, begins] = np.sqrt(1.0 - rho**2) * values[begins]
    return white


def _project_start(white: Floats, start: Floats) -> tuple[Floats, Floats]:
    """Whiten signals ``(r, n, c)`` for what a lag still has in it from before the segment.

    ``start`` is its whitened course, ``(r, n)``. Also returns half the logarithm of the determinant
    of the covariance, ``(r,)``.
    """
    length = np.maximum(np.linalg.norm(start, axis=1), 1e-12)
    grown = np.sqrt(1.0 + (_START * length) ** 2)
    unit = (start / length[:, None])[..., None]
    shrinkage = (1.0 - 1.0 / grown)[:, None, None]
    return white - shrinkage * unit * (unit.mT @ white), np.log(grown)


def _regularised(matrix: Floats) -> Floats:
    """Matrices ``(..., k, k)`` with slightly larger diagonals, so that they can be inverted."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    return matrix + (1e-10 * diagonal + 1e-30)[..., None] * np.eye(matrix.shape[-1])
