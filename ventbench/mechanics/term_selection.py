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
    influence,
    log_likelihood,
    weighted,
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
    """A term of the model, or one that is tried."""

    name: str  #: name of the effect.
    column: int  #: index of its column.
    nats: float  #: log-likelihood ratio on held-out breaths.
    gain: float  #: what it adds to the log-likelihood of held-out breaths.
    passes: bool  #: whether the breaths need it.
    alternatives: tuple[str, ...] = ()  #: other terms that would have gained nearly as much.


def select_terms(table: CrossProducts, timing: float = 0.0) -> tuple[SelectedTerm, ...]:
    """Select the terms that are needed beyond R, C and a delay, forward, with backward checks.

    The quadratic part of the resistance stands while others are tried: airways and test lungs have
    it, and terms that look alike would stand for it. It stays if it passes beside them.

    ``timing`` is the error of the delay that was taken out, s: an inertance must exceed what that
    error looks like.
    """
    if len(table) < FEWEST_BREATHS:
        return ()
    standing = _trial(table, timing, _columns([]), _STANDING)
    selected = [standing] if standing.gain > 0.0 else []
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
        selected.append(replace(best, alternatives=alternatives))
        # The new term may make an earlier one superfluous.
        for term in selected[:-1]:
            rest = [other for other in selected if other is not term]
            if term is not standing and not _trial(table, timing, _columns(rest), term.name).passes:
                selected = rest
                dropped.add(term.name)
    rest = [term for term in selected if term is not standing]
    trial = _trial(table, timing, _columns(rest), _STANDING)
    if trial.passes and len(rest) < len(selected):
        return (trial, *rest)
    return tuple(rest)


def _columns(selected: list[SelectedTerm]) -> tuple[int, ...]:
    return (*range(len(BASE)), *(term.column for term in selected))


@dataclass(frozen=True)
class _Model:
    """Columns that are fitted together."""

    table: CrossProducts  #: cross products of b breaths.
    columns: tuple[int, ...]  #: indices of the columns.
    positive: bool = False  #: whether the coefficient of the last one must be positive.

    def fit(self, which: Bools) -> RegressionFit:
        """Fit some breaths, bool ``(b,)``."""
        return fit(self.table, which, self.columns)

    def value(self, fitted: RegressionFit, which: Bools) -> float:
        """Log-likelihood of some breaths, with the prior; -inf if it is not allowed."""
        if self.positive and fitted.coefficients[-1] <= 0.0:
            return -np.inf
        return float(log_likelihood(self.table, fitted)[which].sum()) + fitted.log_prior


def _values(models: Sequence[_Model], which: Bools) -> Floats:
    """Largest log-likelihood of each model on some breaths, ``(n,)``."""
    return np.array([model.value(model.fit(which), which) for model in models])


def _held_out(models: Sequence[_Model], null: _Model) -> tuple[float, Floats]:
    """Log-likelihood ratio of the best of some models on held-out breaths, and its gain in each."""
    ratios, gains = [], []
    for train in splits(len(null.table)):
        best = models[int(np.argmax(_values(models, train)))] if len(models) > 1 else models[0]
        richer, plain = best.fit(train), null.fit(~train)
        values = log_likelihood(best.table, richer)
        # Split likelihood ratio: since the null hypothesis is fitted to the held-out breaths
        # themselves, a ratio above 1 / alpha has a probability below alpha, whatever the model.
        ratio = float((values - log_likelihood(null.table, plain))[~train].sum()) - plain.log_prior
        ratios.append(ratio if np.isfinite(best.value(richer, train)) else -np.inf)
        gain = values - log_likelihood(null.table, null.fit(train))
        gains.append(np.where(train, np.nan, gain))
    return float(np.logaddexp.reduce(ratios) - np.log(len(ratios))), np.nanmean(gains, axis=0)


def _trial(
    table: CrossProducts, timing: float, columns: tuple[int, ...], name: str
) -> SelectedTerm:
    """Try one more term: its best column on all breaths, and its gain on held-out breaths."""
    every = np.ones(len(table), bool)
    models = [_Model(table, (*columns, c), name in POSITIVE) for c in columns_of(name)]
    best = models[int(np.argmax(_values(models, every)))]
    fitted, column = best.fit(every), best.columns[-1]
    nats, by_breath = _held_out(models, _Model(table, columns))
    size = effect_size(table, fitted, column)
    swing = float(np.sqrt(table.products[:, 0, -1, -1].sum() / table.freedom.sum()))
    nonlinear = 0.0 if name in _DYNAMIC else _LINEARITY * swing
    strengths = dict(zip(fitted.columns, fitted.coefficients, strict=True))
    at_1 = strengths[0] + strengths.get(PARABOLIC[-1], 0.0)
    least = max(_LEAST_INERTANCE, timing * at_1) if name == "inertance" else 0.0
    passes = bool(
        nats > LEAST_NATS
        and float(np.mean(by_breath > 0)) >= _LEAST_AGREEMENT
        and size > max(_LEAST_EFFECT, _LEAST_EFFECT_SHARE * fitted.sigma, nonlinear)
        and np.isfinite(best.value(fitted, every))
        and abs(fitted.coefficients[-1]) >= least
        and _plausible(table, fitted)
    )
    return SelectedTerm(name, column, nats, float(by_breath.sum()), passes)


def _plausible(table: CrossProducts, fitted: RegressionFit) -> bool:
    """Whether R and C are still distinct from the other terms, and not negative."""
    sd = np.sqrt(np.diag(covariance(table, fitted))[:2])
    resistance, elastance = fitted.coefficients[:2]
    return resistance > -2.0 * sd[0] and elastance > 0.0 and sd[1] < _MOST_UNCERTAINTY * elastance


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

    weight = influence(cross_products(segments, PARABOLIC))

    def models_of(family: _DelayFamily, change: _Change) -> list[_Model]:
        tables = (
            cross_products([change(k, x) for k in range(len(segments))], _COLUMNS)
            for x in family.grid
        )
        columns = tuple(range(len(_COLUMNS)))
        return [_Model(weighted(table, weight), columns) for table in tables]

    sensor = models_of(_SENSOR, lambda k, lag: replace(segments[k], lag=lag))
    every = np.ones(len(sensor[0].table), bool)
    of_sensor = _values(sensor, every)
    best = int(np.argmax(of_sensor))
    smooth = predicted(segments, sensor[best].fit(every), _SENSOR.grid[best])
    circuit = models_of(_CIRCUIT, lambda k, c: behind_circuit(segments[k], smooth[k], c))
    of_circuit = _values(circuit, every)
    candidates = {
        family.name: estimate
        for family, models in ((_CIRCUIT, circuit), (_SENSOR, sensor))
        if (estimate := _delay(family, models)) is not None
    }
    if not candidates:
        small = _peak(_SENSOR, of_sensor)
        return tuple(replace(segment, lag=small) for segment in segments), None
    gains = {_CIRCUIT.name: of_circuit.max(), _SENSOR.name: of_sensor.max()}
    none, most = of_circuit[0], max(gains[name] for name in candidates)
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
    segments: Sequence[Segment], fitted: RegressionFit, lag: float
) -> list[tuple[Floats, Floats]]:
    """Pressures of the lung that fits best if its sensor lags, and their derivatives, ``(m,)``.

    ``fitted`` is the fit of :data:`_COLUMNS` with that lag, s.
    """
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


def _delay(family: _DelayFamily, models: Sequence[_Model]) -> Term | None:
    """The strength of a delay; None if held-out breaths do not need it."""
    count = len(models[0].table)
    every = np.ones(count, bool)
    nats = _held_out(models, models[0])[0]
    value = _peak(family, _values(models, every))
    if nats <= LEAST_NATS or value < family.least:
        return None
    jackknife = [_peak(family, _values(models, np.arange(count) != i)) for i in range(count)]
    sd = float(np.sqrt((count - 1) * np.var(jackknife)))
    reach = t_quantile(max(count - 1, 4)) * max(sd, family.deviation)
    ends = (max(value - reach, 0.0), value + reach)
    nearest = models[round(value / family.grid[1])]
    explained = models[0].fit(every).variance - nearest.fit(every).variance
    effect = float(np.sqrt(max(explained, 0.0)))
    strength = {family.parameter: Estimate(value, family.unit, ends)}
    return Term(family.name, strength, nats, effect, ())


def _peak(family: _DelayFamily, values: Floats) -> float:
    """Strength of the largest of values on its grid, by a parabola through the best."""
    k = int(np.argmax(values))
    if k in (0, len(values) - 1):
        return family.grid[k]
    left, middle, right = values[k - 1 : k + 2]
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return family.grid[k] + float(np.clip(shift, -0.5, 0.5)) * family.grid[1]
