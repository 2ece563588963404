"""Which terms a recording needs beyond R and C, tested on breaths that did not select them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ventbench.mechanics.labels import Estimate
from ventbench.mechanics.regression import (
    BASE,
    GRID,
    POSITIVE,
    TERMS,
    CrossProducts,
    RegressionFit,
    columns_of,
    covariance,
    cross_products,
    effect_size,
    fit,
    log_likelihood,
)
from ventbench.mechanics.segments import Segment
from ventbench.system_id.fit import t_quantile

#: Log-likelihood ratio on held-out breaths that a term needs: one false term in a hundred.
LEAST_NATS = 4.6

#: Share of the held-out breaths whose likelihood must rise.
_LEAST_AGREEMENT = 0.6

#: Least effect of a term, cmH2O, and as a share of the noise.
_LEAST_EFFECT, _LEAST_EFFECT_SHARE = 0.03, 0.1

#: Share of the best term's gain by which another term may fall short and still be an alternative.
_ALTERNATIVE_SHARE = 0.1

#: Relative standard deviation of 1/C above which a term has replaced the compliance.
_MOST_UNCERTAINTY = 0.1

#: Fewest breaths that can be split, and most terms.
FEWEST_BREATHS, MOST_TERMS = 4, 5

#: Circuit compliances to choose from, mL/cmH2O.
_COMPLIANCES = tuple(float(c) for c in np.arange(0.0, 4.01, 0.25))

#: Least circuit compliance that is reported, mL/cmH2O, and its least standard deviation.
_LEAST_COMPLIANCE, _LEAST_DEVIATION = 0.1, 0.02


@dataclass(frozen=True)
class SelectedTerm:
    """A term of the model.

    Attributes:
        name: name of the effect.
        column: index of its column.
        nats: log-likelihood ratio on held-out breaths.
        alternatives: other terms that would have gained nearly as much.
    """

    name: str
    column: int
    nats: float
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class _Trial:
    name: str
    column: int
    nats: float
    gain: float
    passes: bool


def select_terms(table: CrossProducts) -> tuple[SelectedTerm, ...]:
    """Select the terms that are needed beyond R and C, forward, with backward checks."""
    selected: list[SelectedTerm] = []
    dropped: set[str] = set()
    while len(table) >= FEWEST_BREATHS and len(selected) < MOST_TERMS:
        columns = _columns(selected)
        excluded = {term.name for term in selected} | dropped
        trials = [_trial(table, columns, name) for name in TERMS if name not in excluded]
        passing = [trial for trial in trials if trial.passes]
        if not passing:
            break
        most = max(trial.gain for trial in passing)
        near = [t for t in passing if t.gain >= most - max(LEAST_NATS, _ALTERNATIVE_SHARE * most)]
        best = near[0]  # TERMS are in the order of how common they are
        others = tuple(trial.name for trial in near[1:])
        selected.append(SelectedTerm(best.name, best.column, best.nats, others))
        # The new term may make an earlier one superfluous.
        for term in selected[:-1]:
            rest = [other for other in selected if other is not term]
            if not _trial(table, _columns(rest), term.name).passes:
                selected = rest
                dropped.add(term.name)
    return tuple(selected)


def _columns(selected: list[SelectedTerm]) -> tuple[int, ...]:
    return (*range(len(BASE)), *(term.column for term in selected))


def _trial(table: CrossProducts, columns: tuple[int, ...], name: str) -> _Trial:
    """Try one more term: its best column on all breaths, and its gain on held-out breaths."""
    every = np.ones(len(table), bool)
    column = _best_column(table, every, columns, name)
    whole = fit(table, every, (*columns, column))
    ratios, gains = [], []
    for train in splits(len(table)):
        trained = _best_column(table, train, columns, name)
        richer = fit(table, train, (*columns, trained))
        # Split likelihood ratio: since the null hypothesis is fitted to the held-out breaths
        # themselves, a ratio above 1 / alpha has a probability below alpha, whatever the model.
        null = fit(table, ~train, columns)
        ratio = log_likelihood(table, richer) - log_likelihood(table, null)
        ratios.append(float(ratio[~train].sum()) if _allowed(name, richer) else -np.inf)
        known = log_likelihood(table, richer) - log_likelihood(table, fit(table, train, columns))
        gains.append(np.where(train, np.nan, known))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    by_breath = np.nanmean(gains, axis=0)
    size = effect_size(table, whole, column)
    passes = (
        nats > LEAST_NATS
        and float(np.mean(by_breath > 0)) >= _LEAST_AGREEMENT
        and size > max(_LEAST_EFFECT, _LEAST_EFFECT_SHARE * whole.sigma)
        and _allowed(name, whole)
        and _plausible(table, whole)
    )
    return _Trial(name, column, nats, float(by_breath.sum()), passes)


def _plausible(table: CrossProducts, fitted: RegressionFit) -> bool:
    """Whether R and C are still distinct from the other terms, and not negative."""
    sd = np.sqrt(np.diag(covariance(table, fitted))[: len(BASE)])
    resistance, elastance = fitted.coefficients[: len(BASE)]
    return resistance > -2.0 * sd[0] and elastance > 0.0 and sd[1] < _MOST_UNCERTAINTY * elastance


def _best_column(
    table: CrossProducts, which: NDArray[np.bool_], columns: tuple[int, ...], name: str
) -> int:
    """The column of a term with the highest likelihood on some breaths."""
    options = columns_of(name)
    if len(options) == 1:
        return options[0]

    def value(column: int) -> float:
        fitted = fit(table, which, (*columns, column))
        if not _allowed(name, fitted):
            return -np.inf
        return float(log_likelihood(table, fitted)[which].sum())

    return max(options, key=value)


def _allowed(name: str, fitted: RegressionFit) -> bool:
    return name not in POSITIVE or fitted.coefficients[-1] > 0.0


def splits(count: int) -> list[NDArray[np.bool_]]:
    """Training breaths, bool ``(count,)``: alternate ones and halves, and their complements."""
    index = np.arange(count)
    first = [index % 2 == 0, index < count // 2]
    return [train for half in first for train in (half, ~half)]


@dataclass(frozen=True)
class CircuitEstimate:
    """Compliance of the circuit between flow sensor and lung.

    Attributes:
        compliance: mL/cmH2O.
        nats: log-likelihood ratio on held-out breaths.
        effect: root mean square of what it alone explains, cmH2O.
    """

    compliance: Estimate
    nats: float
    effect: float


def circuit_compliance(segments: Sequence[Segment]) -> CircuitEstimate | None:
    """Estimate the compliance of the circuit; None if the breaths do not need it.

    The lung's flow is that of the sensor less the circuit's compliance times the rise of the
    pressure. Since this changes flow and volume in every other term, it is estimated first, on a
    grid.
    """
    columns = (*range(len(BASE)), *columns_of("turbulent_resistance"))
    tables = [
        cross_products([behind_circuit(s, c) for s in segments], columns) for c in _COMPLIANCES
    ]
    null, count = tables[0], len(tables[0])
    if count < FEWEST_BREATHS:
        return None
    ratios = []
    for train in splits(count):
        best = max(tables, key=lambda table: _value(table, train))
        with_circuit = fit(best, train, range(len(columns)))
        without_circuit = fit(null, ~train, range(len(columns)))
        gain = log_likelihood(best, with_circuit) - log_likelihood(null, without_circuit)
        ratios.append(float(gain[~train].sum()))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    every = np.ones(count, bool)
    value = _peak(tables, every)
    if nats <= LEAST_NATS or value < _LEAST_COMPLIANCE:
        return None
    jackknife = [_peak(tables, np.arange(count) != i) for i in range(count)]
    sd = float(np.sqrt((count - 1) * np.var(jackknife)))
    reach = t_quantile(max(count - 1, 4)) * max(sd, _LEAST_DEVIATION)
    ends = (max(value - reach, 0.0), value + reach)
    nearest = tables[round(value / (_COMPLIANCES[1] - _COMPLIANCES[0]))]
    variances = [_residual_variance(table, every) for table in (null, nearest)]
    effect = float(np.sqrt(max(variances[0] - variances[1], 0.0)))
    return CircuitEstimate(Estimate(value, "mL/cmH2O", ends), nats, effect)


def behind_circuit(segment: Segment, compliance: float) -> Segment:
    """The segment with flow and volume of the lung behind a circuit of ``compliance`` mL/cmH2O."""
    if compliance == 0.0:
        return segment
    c = compliance / 1000.0
    return replace(
        segment,
        flow=segment.flow - c * segment.rise,
        slope=segment.slope - c * segment.bend,
        volume=segment.volume - c * (segment.pressure - segment.pressure[0]),
    )


def _value(table: CrossProducts, which: NDArray[np.bool_]) -> float:
    fitted = fit(table, which, range(table.products.shape[-1] - 1))
    return float(log_likelihood(table, fitted)[which].sum())


def _residual_variance(table: CrossProducts, which: NDArray[np.bool_]) -> float:
    """Variance of the residual, autocorrelation included, cmH2O2."""
    fitted = fit(table, which, range(table.products.shape[-1] - 1))
    return fitted.sigma**2 / (1.0 - GRID[fitted.grid] ** 2)


def _peak(tables: Sequence[CrossProducts], which: NDArray[np.bool_]) -> float:
    """Compliance of the largest likelihood, by a parabola through the best of the grid."""
    values = np.array([_value(table, which) for table in tables])
    k = int(np.argmax(values))
    if k in (0, len(values) - 1):
        return _COMPLIANCES[k]
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return _COMPLIANCES[k] + float(np.clip(shift, -0.5, 0.5)) * (_COMPLIANCES[1] - _COMPLIANCES[0])
