"""Which terms a recording needs beyond R and C, tested on breaths that did not select them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def select_terms(
    table: CrossProducts, delayed_by: DelayEstimate | None = None
) -> tuple[SelectedTerm, ...]:
    """Select the terms that are needed beyond R and C, forward, with backward checks.

    Args:
        table: cross products of the breaths, without the delay.
        delayed_by: the delay. A lag of the sensor is not sought twice, as negative inertance.
    """
    positive = POSITIVE
    if delayed_by is not None and delayed_by.name == _SENSOR.name:
        positive = (*positive, "inertance")
    selected: list[SelectedTerm] = []
    dropped: set[str] = set()
    while len(table) >= FEWEST_BREATHS and len(selected) < MOST_TERMS:
        columns = _columns(selected)
        excluded = {term.name for term in selected} | dropped
        trials = [_trial(table, columns, name, positive) for name in TERMS if name not in excluded]
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
            if not _trial(table, _columns(rest), term.name, positive).passes:
                selected = rest
                dropped.add(term.name)
    return tuple(selected)


def _columns(selected: list[SelectedTerm]) -> tuple[int, ...]:
    return (*range(len(BASE)), *(term.column for term in selected))


def _trial(
    table: CrossProducts, columns: tuple[int, ...], name: str, positive: tuple[str, ...]
) -> _Trial:
    """Try one more term: its best column on all breaths, and its gain on held-out breaths."""
    every = np.ones(len(table), bool)
    column = _best_column(table, every, columns, name, positive)
    whole = fit(table, every, (*columns, column))
    ratios, gains = [], []
    for train in splits(len(table)):
        trained = _best_column(table, train, columns, name, positive)
        richer = fit(table, train, (*columns, trained))
        # Split likelihood ratio: since the null hypothesis is fitted to the held-out breaths
        # themselves, a ratio above 1 / alpha has a probability below alpha, whatever the model.
        null = fit(table, ~train, columns)
        ratio = log_likelihood(table, richer) - log_likelihood(table, null)
        ratios.append(float(ratio[~train].sum()) if _allowed(name, richer, positive) else -np.inf)
        known = log_likelihood(table, richer) - log_likelihood(table, fit(table, train, columns))
        gains.append(np.where(train, np.nan, known))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    by_breath = np.nanmean(gains, axis=0)
    size = effect_size(table, whole, column)
    passes = (
        nats > LEAST_NATS
        and float(np.mean(by_breath > 0)) >= _LEAST_AGREEMENT
        and size > max(_LEAST_EFFECT, _LEAST_EFFECT_SHARE * whole.sigma)
        and _allowed(name, whole, positive)
        and _plausible(table, whole)
    )
    return _Trial(name, column, nats, float(by_breath.sum()), passes)


def _plausible(table: CrossProducts, fitted: RegressionFit) -> bool:
    """Whether R and C are still distinct from the other terms, and not negative."""
    sd = np.sqrt(np.diag(covariance(table, fitted))[: len(BASE)])
    resistance, elastance = fitted.coefficients[: len(BASE)]
    return resistance > -2.0 * sd[0] and elastance > 0.0 and sd[1] < _MOST_UNCERTAINTY * elastance


def _best_column(
    table: CrossProducts,
    which: NDArray[np.bool_],
    columns: tuple[int, ...],
    name: str,
    positive: tuple[str, ...],
) -> int:
    """The column of a term with the highest likelihood on some breaths."""
    options = columns_of(name)
    if len(options) == 1:
        return options[0]

    def value(column: int) -> float:
        fitted = fit(table, which, (*columns, column))
        if not _allowed(name, fitted, positive):
            return -np.inf
        return float(log_likelihood(table, fitted)[which].sum())

    return max(options, key=value)


def _allowed(name: str, fitted: RegressionFit, positive: tuple[str, ...]) -> bool:
    return name not in positive or fitted.coefficients[-1] > 0.0


def splits(count: int) -> list[NDArray[np.bool_]]:
    """Training breaths, bool ``(count,)``: alternate ones and halves, and their complements."""
    index = np.arange(count)
    first = [index % 2 == 0, index < count // 2]
    return [train for half in first for train in (half, ~half)]


@dataclass(frozen=True)
class DelayEstimate:
    """What delays the pressure behind a change of the flow: the circuit, or the pressure sensor.

    Attributes:
        name: ``circuit_compliance`` or ``sensor_lag``.
        value: compliance of the circuit between flow sensor and lung, mL/cmH2O, or time constant of
            the pressure sensor, s.
        nats: log-likelihood ratio on held-out breaths.
        effect: root mean square of what it alone explains, cmH2O.
        alternatives: the other name if it would explain nearly as much.
    """

    name: str
    value: Estimate
    nats: float
    effect: float
    alternatives: tuple[str, ...]


def delay(
    segments: Sequence[Segment], progress: Callable[[float], object] = lambda share: None
) -> DelayEstimate | None:
    """Estimate what delays the pressure; None if the breaths do not need it.

    Since a delay changes the signals of every other term, it is estimated first, on a grid.

    Behind a circuit of compliance c, a linear lung has ``p (1 + c / C) + R c dp/dt = R Q + V / C``;
    with a sensor that lags by tau, it has ``p + tau dp/dt = R Q + V / C``. One linear lung cannot
    tell them apart: then the circuit, which every ventilator has, is named. The quadratic part of
    the resistance tells them apart, and so does a lag for which no circuit is large enough.

    Args:
        segments: pieces of the recording.
        progress: called with the share of the grids that is done.
    """
    if len({segment.breath for segment in segments}) < FEWEST_BREATHS:
        return None
    steps, done = len(_CIRCUIT.grid) + len(_SENSOR.grid), 0

    def step() -> None:
        nonlocal done
        done += 1
        progress(done / steps)

    circuit, sensor = (_likelihoods(segments, family, step) for family in (_CIRCUIT, _SENSOR))
    candidates = {
        family.name: estimate
        for family, tables in ((_CIRCUIT, circuit), (_SENSOR, sensor))
        if (estimate := _delay(family, tables)) is not None
    }
    if not candidates:
        return None
    every = np.ones(len(circuit[0]), bool)
    gains = {
        _CIRCUIT.name: max(map(_scaled_value, circuit, _CIRCUIT.grid)),
        _SENSOR.name: max(_value(table, every) for table in sensor),
    }
    none, most = _value(circuit[0], every), max(gains[name] for name in candidates)
    least = most - max(LEAST_NATS, _ALTERNATIVE_SHARE * (most - none))
    best = next(estimate for name, estimate in candidates.items() if gains[name] >= least)
    others = tuple(name for name in gains if name != best.name and gains[name] >= least)
    return replace(best, alternatives=others)


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


def before_sensor(segment: Segment, lag: float) -> Segment:
    """The segment with the pressure in front of a sensor of time constant ``lag``, s."""
    if lag == 0.0:
        return segment
    return replace(
        segment,
        pressure=segment.pressure + lag * segment.rise,
        rise=segment.rise + lag * segment.bend,
        dose=segment.dose + lag * (segment.pressure - segment.pressure[0]),
    )


@dataclass(frozen=True)
class _DelayFamily:
    """A cause of a delay: the strengths to choose from, and what it does to the signals.

    Attributes:
        name: name of the effect.
        unit: unit of its strength.
        grid: strengths, equally spaced from zero on.
        undo: the signals without a delay of some strength.
        least: least strength that is reported.
        deviation: least standard deviation of a strength.
    """

    name: str
    unit: str
    grid: tuple[float, ...]
    undo: Callable[[Segment, float], Segment]
    least: float
    deviation: float


#: Circuits from 0 to 4 mL/cmH2O, and sensors from 0 to 150 ms. A lag shorter than a sample at
#: 100 Hz cannot be told from clocks that differ, so that it is not reported.
_CIRCUIT = _DelayFamily(
    "circuit_compliance", "mL/cmH2O", tuple(np.arange(0.0, 4.01, 0.25).tolist()), behind_circuit,
    least=0.1, deviation=0.02,
)  # fmt: skip
_SENSOR = _DelayFamily(
    "sensor_lag", "s", tuple(np.arange(0.0, 0.1501, 0.01).tolist()), before_sensor,
    least=0.01, deviation=0.001,
)  # fmt: skip


def without_delay(segment: Segment, estimate: DelayEstimate | None) -> Segment:
    """The segment as it would be without the delay."""
    if estimate is None:
        return segment
    undo = _CIRCUIT.undo if estimate.name == _CIRCUIT.name else _SENSOR.undo
    return undo(segment, estimate.value.value)


def _likelihoods(
    segments: Sequence[Segment], family: _DelayFamily, step: Callable[[], None]
) -> list[CrossProducts]:
    """Cross products of R, C and the quadratic part of the resistance, for each strength."""
    columns = (*range(len(BASE)), *columns_of("turbulent_resistance"))
    tables = []
    for strength in family.grid:
        undone = [family.undo(segment, strength) for segment in segments]
        tables.append(cross_products(undone, columns))
        step()
    return tables


def _delay(family: _DelayFamily, tables: Sequence[CrossProducts]) -> DelayEstimate | None:
    """The strength of a delay; None if held-out breaths do not need it."""
    null, count = tables[0], len(tables[0])
    columns = range(null.products.shape[-1] - 1)
    ratios = []
    for train in splits(count):
        best = max(tables, key=lambda table: _value(table, train))
        ratio = log_likelihood(best, fit(best, train, columns))
        ratio = ratio - log_likelihood(null, fit(null, ~train, columns))
        ratios.append(float(ratio[~train].sum()))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    every = np.ones(count, bool)
    value = _peak(family, tables, every)
    if nats <= LEAST_NATS or value < family.least:
        return None
    jackknife = [_peak(family, tables, np.arange(count) != i) for i in range(count)]
    sd = float(np.sqrt((count - 1) * np.var(jackknife)))
    reach = t_quantile(max(count - 1, 4)) * max(sd, family.deviation)
    ends = (max(value - reach, 0.0), value + reach)
    nearest = tables[round(value / family.grid[1])]
    variances = [_residual_variance(table, every) for table in (null, nearest)]
    effect = float(np.sqrt(max(variances[0] - variances[1], 0.0)))
    return DelayEstimate(family.name, Estimate(value, family.unit, ends), nats, effect, ())


def _value(table: CrossProducts, which: NDArray[np.bool_]) -> float:
    fitted = fit(table, which, range(table.products.shape[-1] - 1))
    return float(log_likelihood(table, fitted)[which].sum())


def _scaled_value(table: CrossProducts, compliance: float) -> float:
    """Log-likelihood behind a circuit, for residuals of the measured pressure.

    The residuals of a lung behind a circuit are larger by ``1 + c / C``, which says nothing about
    the circuit, but would decide between it and a sensor.
    """
    every = np.ones(len(table), bool)
    elastance = fit(table, every, range(table.products.shape[-1] - 1)).coefficients[1]
    scale = 1.0 + max(elastance, 0.0) * compliance / 1000.0
    return _value(table, every) + float(table.freedom.sum() * np.log(scale))


def _residual_variance(table: CrossProducts, which: NDArray[np.bool_]) -> float:
    """Variance of the residual, autocorrelation included, cmH2O2."""
    fitted = fit(table, which, range(table.products.shape[-1] - 1))
    return fitted.sigma**2 / (1.0 - GRID[fitted.grid] ** 2)


def _peak(family: _DelayFamily, tables: Sequence[CrossProducts], which: NDArray[np.bool_]) -> float:
    """Strength of the largest likelihood, by a parabola through the best of the grid."""
    values = np.array([_value(table, which) for table in tables])
    k = int(np.argmax(values))
    if k in (0, len(values) - 1):
        return family.grid[k]
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return family.grid[k] + float(np.clip(shift, -0.5, 0.5)) * family.grid[1]
