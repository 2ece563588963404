"""Which terms a recording needs beyond R and C, tested on breaths that did not select them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.mechanics.labels import Estimate
from ventbench.mechanics.regression import (
    BASE,
    COLUMNS,
    PARABOLIC,
    POSITIVE,
    TERMS,
    CrossProducts,
    RegressionFit,
    columns_of,
    course,
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

#: Least effect of a term as a share of the pressure's standard deviation within a breath: sensors
#: of flow and pressure are linear to 2 % of what they read, and a term without dynamics that
#: explains less may be the sensor.
_LINEARITY, _DYNAMIC = 0.02, ("inertance", "viscoelasticity")

#: Least inertance that is named, cmH2O s2/L: tubes and airways have 0.01 to 0.02, and a flow sensor
#: that is a thousandth of a second late looks like 0.02 in an R20.
_LEAST_INERTANCE = 0.03

#: Share of the best term's gain by which another term may fall short and still be an alternative.
_ALTERNATIVE_SHARE = 0.1

#: Relative standard deviation of 1/C above which a term has replaced the compliance.
_MOST_UNCERTAINTY = 0.1

#: Term that stands while others are tried.
_STANDING = "turbulent_resistance"

#: Fewest breaths that can be split, and most terms.
FEWEST_BREATHS, MOST_TERMS = 4, 5


@dataclass(frozen=True)
class SelectedTerm:
    """A term of the model."""

    name: str  #: name of the effect.
    column: int  #: index of its column.
    nats: float  #: log-likelihood ratio on held-out breaths.
    alternatives: tuple[str, ...]  #: other terms that would have gained nearly as much.


@dataclass(frozen=True)
class _Trial:
    name: str
    column: int
    nats: float
    gain: float
    passes: bool


def select_terms(table: CrossProducts, timing: float = 0.0) -> tuple[SelectedTerm, ...]:
    """Select the terms that are needed beyond R, C and a delay, forward, with backward checks.

    The quadratic part of the resistance stands while others are tried: airways and test lungs have
    it, and terms that look alike would stand for it. It stays if it passes beside them.

    ``timing`` is the error of the delay that was taken out, s: an inertance must exceed what that
    error looks like.
    """
    if len(table) < FEWEST_BREATHS:
        return ()
    parabolic = SelectedTerm(_STANDING, PARABOLIC[-1], 0.0, ())
    selected = [parabolic] if _trial(table, timing, _columns([]), _STANDING).gain > 0.0 else []
    dropped: set[str] = set()
    while len(selected) < MOST_TERMS:
        columns = _columns(selected)
        excluded = {term.name for term in selected} | dropped
        trials = [_trial(table, timing, columns, name) for name in TERMS if name not in excluded]
        passing = [trial for trial in trials if trial.passes]
        if not passing:
            break
        most = max(trial.gain for trial in passing)
        contenders = [
            t for t in passing if t.gain >= most - max(LEAST_NATS, _ALTERNATIVE_SHARE * most)
        ]
        best = contenders[0]  # TERMS are in the order of how common they are
        alternatives = tuple(trial.name for trial in contenders[1:])
        selected.append(SelectedTerm(best.name, best.column, best.nats, alternatives))
        # The new term may make an earlier one superfluous.
        for term in selected[:-1]:
            rest = [term_left for term_left in selected if term_left is not term]
            if (
                term is not parabolic
                and not _trial(table, timing, _columns(rest), term.name).passes
            ):
                selected = rest
                dropped.add(term.name)
    rest = [term for term in selected if term is not parabolic]
    trial = _trial(table, timing, _columns(rest), _STANDING)
    if trial.passes and len(rest) < len(selected):
        return (replace(parabolic, nats=trial.nats), *rest)
    return tuple(rest)


def _columns(selected: list[SelectedTerm]) -> tuple[int, ...]:
    return (*range(len(BASE)), *(term.column for term in selected))


def _trial(table: CrossProducts, timing: float, columns: tuple[int, ...], name: str) -> _Trial:
    """Try one more term: its best column on all breaths, and its gain on held-out breaths."""
    every = np.ones(len(table), bool)
    column = _best_column(table, every, columns, name)
    fitted = fit(table, every, (*columns, column))
    ratios, gains = [], []
    for train in splits(len(table)):
        trained = _best_column(table, train, columns, name)
        richer = fit(table, train, (*columns, trained))
        # Split likelihood ratio: since the null hypothesis is fitted to the held-out breaths
        # themselves, a ratio above 1 / alpha has a probability below alpha, whatever the model.
        null = fit(table, ~train, columns)
        ratio = log_likelihood(table, richer) - log_likelihood(table, null)
        ratio_of_all = float(ratio[~train].sum()) - null.log_prior
        ratios.append(ratio_of_all if _allowed(name, richer) else -np.inf)
        gains_of_breaths = log_likelihood(table, richer) - log_likelihood(
            table, fit(table, train, columns)
        )
        gains.append(np.where(train, np.nan, gains_of_breaths))
    nats = float(np.logaddexp.reduce(ratios) - np.log(len(ratios)))
    by_breath = np.nanmean(gains, axis=0)
    size = effect_size(table, fitted, column)
    gain = float(by_breath.sum())
    swing = float(np.sqrt(table.products[:, 0, -1, -1].sum() / table.freedom.sum()))
    nonlinear = 0.0 if name in _DYNAMIC else _LINEARITY * swing
    strengths = dict(zip(fitted.columns, fitted.coefficients, strict=True))
    at_1 = strengths[0] + strengths.get(PARABOLIC[-1], 0.0)
    least = max(_LEAST_INERTANCE, timing * at_1) if name == "inertance" else 0.0
    passes = bool(
        nats > LEAST_NATS
        and float(np.mean(by_breath > 0)) >= _LEAST_AGREEMENT
        and size > max(_LEAST_EFFECT, _LEAST_EFFECT_SHARE * fitted.sigma, nonlinear)
        and _allowed(name, fitted)
        and abs(fitted.coefficients[-1]) >= least
        and _plausible(table, fitted)
    )
    return _Trial(name, column, nats, gain, passes)


def _plausible(table: CrossProducts, fitted: RegressionFit) -> bool:
    """Whether R and C are still distinct from the other terms, and not negative."""
    sd = np.sqrt(np.diag(covariance(table, fitted))[:2])
    resistance, elastance = fitted.coefficients[:2]
    return resistance > -2.0 * sd[0] and elastance > 0.0 and sd[1] < _MOST_UNCERTAINTY * elastance


def _best_column(table: CrossProducts, which: Bools, columns: tuple[int, ...], name: str) -> int:
    """The column of a term with the highest likelihood on some breaths."""
    options = columns_of(name)
    if len(options) == 1:
        return options[0]

    def value(column: int) -> float:
        fitted = fit(table, which, (*columns, column))
        if not _allowed(name, fitted):
            return -np.inf
        return float(log_likelihood(table, fitted)[which].sum()) + fitted.log_prior

    return max(options, key=value)


def _allowed(name: str, fitted: RegressionFit) -> bool:
    return name not in POSITIVE or fitted.coefficients[-1] > 0.0


def splits(count: int) -> list[Bools]:
    """Training breaths, bool ``(count,)``: alternate ones and halves, and their complements."""
    index = np.arange(count)
    first = [index % 2 == 0, index < count // 2]
    return [train for half in first for train in (half, ~half)]


@dataclass(frozen=True)
class Term:
    """An effect that a lung needs beyond R and C."""

    name: str  #: name of the effect.
    parameters: dict[str, Estimate]  #: estimated parameters by short name.
    nats: float  #: log-likelihood ratio on held-out breaths.
    effect: float  #: root mean square of what the term alone explains, cmH2O.
    alternatives: tuple[str, ...]  #: names of effects that would explain nearly as much.


def delay(segments: Sequence[Segment]) -> tuple[tuple[Segment, ...], Term | None]:
    """Estimate what delays the pressure behind a change of the flow, and take it into account.

    Since a delay changes the signals of every other term, it is estimated first, on a grid.

    Behind a circuit of compliance c, a linear lung has ``p (1 + c / C) + R c dp/dt = R Q + V / C``;
    with a sensor that lags by tau, it has ``p + tau dp/dt = R Q + V / C``. One linear lung cannot
    tell them apart: then the circuit, which every ventilator has, is named. The quadratic part of
    the resistance tells them apart, and so does a lag for which no circuit is large enough.

    Neither is computed from derivatives of the measured pressure, whose noise would make both look
    smaller than they are. A lag delays the signals of the lung; what a circuit takes up is computed
    from the pressure that the best lag predicts, which has no noise (an instrumental variable).

    Returns the segments with the sensor's lag, or with flow and volume behind the circuit, and the
    delay; None if the breaths do not need it. A lag that is too small to be named is taken out of
    the segments all the same, so that no other term has to make up for it.
    """
    if len({segment.breath for segment in segments}) < FEWEST_BREATHS:
        return tuple(segments), None

    def tables_of(family: _DelayFamily, change: _Change) -> list[CrossProducts]:
        tables = []
        for strength in family.grid:
            changed = [change(k, strength) for k in range(len(segments))]
            tables.append(cross_products(changed, _COLUMNS))
        return tables

    sensor = tables_of(_SENSOR, lambda k, lag: replace(segments[k], lag=lag))
    every = np.ones(len(sensor[0]), bool)
    best = max(range(len(sensor)), key=lambda k: _value(sensor[k], every))
    smooth = predicted(segments, sensor[best], _SENSOR.grid[best])
    circuit = tables_of(_CIRCUIT, lambda k, c: behind_circuit(segments[k], smooth[k], c))
    candidates = {
        family.name: estimate
        for family, tables in ((_CIRCUIT, circuit), (_SENSOR, sensor))
        if (estimate := _delay(family, tables)) is not None
    }
    if not candidates:
        small = _peak(_SENSOR, sensor, every)
        return tuple(replace(segment, lag=small) for segment in segments), None
    gains = {
        _CIRCUIT.name: max(_value(table, every) for table in circuit),
        _SENSOR.name: max(_value(table, every) for table in sensor),
    }
    none, most = _value(circuit[0], every), max(gains[name] for name in candidates)
    least = most - max(LEAST_NATS, _ALTERNATIVE_SHARE * (most - none))
    chosen = next(estimate for name, estimate in candidates.items() if gains[name] >= least)
    alternatives = tuple(name for name in gains if name != chosen.name and gains[name] >= least)
    value = next(iter(chosen.parameters.values())).value
    if chosen.name == _SENSOR.name:
        delayed = tuple(replace(segment, lag=value) for segment in segments)
    else:
        pairs = zip(segments, smooth, strict=True)
        delayed = tuple(behind_circuit(segment, smoothed, value) for segment, smoothed in pairs)
    return delayed, replace(chosen, alternatives=alternatives)


def predicted(
    segments: Sequence[Segment], table: CrossProducts, lag: float
) -> list[tuple[Floats, Floats]]:
    """Pressures of the lung that fits best if its sensor lags, and their derivatives, ``(m,)``.

    ``table`` has the cross products of the segments with that lag, s.
    """
    fitted = fit(table, np.ones(len(table), bool), range(len(_COLUMNS)))
    columns = [COLUMNS[c] for c in _COLUMNS]
    result = []
    for segment in segments:
        late = course(replace(segment, lag=lag), columns)
        rises = np.gradient(late, segment.time, axis=0)
        since = segment.time - segment.time[0]
        nuisances, nuisance_rises = (
            [np.ones(len(since)), since],
            [np.zeros(len(since)), np.ones(len(since))],
        )
        if lag > 0.0:  # then the derivative is known: it drives the lag
            rises = (course(segment, columns) - late) / lag
            nuisances.append(np.exp(-since / lag))
            nuisance_rises.append(-nuisances[-1] / lag)
        lung, nuisance = late @ fitted.coefficients, np.stack(nuisances, axis=1)
        residual = segment.pressure - lung[segment.rows]
        size = np.linalg.lstsq(nuisance[segment.rows], residual)[0]
        rise = rises @ fitted.coefficients + np.stack(nuisance_rises, axis=1) @ size
        result.append((lung + nuisance @ size, rise))
    return result


def behind_circuit(segment: Segment, smooth: tuple[Floats, Floats], compliance: float) -> Segment:
    """The segment with flow and volume of the lung behind a circuit of a compliance, mL/cmH2O.

    ``smooth`` are its pressure without noise, cmH2O, and the derivative of it, cmH2O/s, ``(m,)``.
    """
    if compliance == 0.0:
        return segment
    c, (pressure, rise) = compliance / 1000.0, smooth
    return replace(
        segment,
        flow=segment.flow - c * rise,
        slope=segment.slope - c * np.gradient(rise, segment.time),
        volume=segment.volume - c * (pressure - pressure[0]),
    )


#: A segment, by its number, with a delay of some strength.
_Change = Callable[[int, float], Segment]

#: Relaxation times of the creep that may be there beside a delay, s: columns of two times make up
#: for all of the others.
_CREEP = (0.4, 1.5)

#: Columns with which delays are estimated: R, C, and slow effects that are left out would look like
#: delays otherwise.
_COLUMNS = (
    *range(len(BASE)),
    *columns_of("turbulent_resistance"),
    *(
        min(columns_of("viscoelasticity"), key=lambda c: abs((COLUMNS[c].time or np.inf) - time))
        for time in _CREEP
    ),
)


@dataclass(frozen=True)
class _DelayFamily:
    """A cause of a delay, and the strengths to choose from."""

    name: str  #: name of the effect.
    parameter: str  #: name of its strength.
    unit: str  #: unit of its strength.
    grid: tuple[float, ...]  #: strengths, equally spaced from zero on.
    least: float  #: least strength that is reported.
    deviation: float  #: least standard deviation of a strength.


#: Circuits from 0 to 4 mL/cmH2O, and sensors from 0 to 150 ms. A lag shorter than a sample at
#: 100 Hz cannot be told from clocks that differ, so that it is not reported.
_CIRCUIT = _DelayFamily(
    "circuit_compliance",
    "compliance",
    "mL/cmH2O",
    tuple(np.arange(0.0, 4.01, 0.25).tolist()),
    least=0.1,
    deviation=0.02,
)
_SENSOR = _DelayFamily(
    "sensor_lag",
    "tau",
    "s",
    tuple(np.arange(0.0, 0.1501, 0.01).tolist()),
    least=0.01,
    deviation=0.001,
)


def _delay(family: _DelayFamily, tables: Sequence[CrossProducts]) -> Term | None:
    """The strength of a delay; None if held-out breaths do not need it."""
    null, count = tables[0], len(tables[0])
    columns = range(null.products.shape[-1] - 1)
    ratios = []
    for train in splits(count):
        best = max(tables, key=lambda table: _value(table, train))
        ratio = log_likelihood(best, fit(best, train, columns))
        null_fit = fit(null, ~train, columns)
        ratio = ratio - log_likelihood(null, null_fit)
        ratios.append(float(ratio[~train].sum()) - null_fit.log_prior)
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
    strength = {family.parameter: Estimate(value, family.unit, ends)}
    return Term(family.name, strength, nats, effect, ())


def _value(table: CrossProducts, which: Bools) -> float:
    fitted = fit(table, which, range(table.products.shape[-1] - 1))
    return float(log_likelihood(table, fitted)[which].sum()) + fitted.log_prior


def _residual_variance(table: CrossProducts, which: Bools) -> float:
    """Variance of the residual, autocorrelation included, cmH2O2."""
    fitted = fit(table, which, range(table.products.shape[-1] - 1))
    return fitted.sigma**2 / (1.0 - fitted.autocorrelation**2)


def _peak(family: _DelayFamily, tables: Sequence[CrossProducts], which: Bools) -> float:
    """Strength of the largest likelihood, by a parabola through the best of the grid."""
    values = np.array([_value(table, which) for table in tables])
    k = int(np.argmax(values))
    if k in (0, len(values) - 1):
        return family.grid[k]
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return family.grid[k] + float(np.clip(shift, -0.5, 0.5)) * family.grid[1]
