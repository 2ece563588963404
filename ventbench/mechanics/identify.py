"""Mechanics of a lung from pressure with flow or volume, whatever the ventilator.

R and C of a regression are numbers whatever its data are. A compliance that is negative, or that no
lung has, says that the recorded flow or volume is not that of the lung: an expiratory flow that the
sensor does not see, a reversed sign, another unit, a volume that drifts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.mechanics.balance import leak
from ventbench.mechanics.labels import (
    WRONG,
    Estimate,
    LungMatch,
    fits,
    match_label,
    matching_settings,
    session_fault,
)
from ventbench.mechanics.regression import (
    BASE,
    COLUMNS,
    PARABOLIC,
    TIMES,
    CrossProducts,
    RegressionFit,
    bounded,
    columns_of,
    course,
    covariance,
    cross_products,
    effect_size,
    fit,
)
from ventbench.mechanics.segments import Segment, segments
from ventbench.mechanics.term_selection import (
    FEWEST_BREATHS,
    SelectedTerm,
    Term,
    delay,
    select_terms,
)
from ventbench.recordings.bad_samples import at_the_slowest, clean, notable
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.roles import OPPOSITE, check_roles, correlation, find_saturation
from ventbench.system_id.fit import t_quantile
from ventbench.task.lungs import Lung

#: Compliances, mL/cmH2O, and resistances, cmH2O/(L/s), that lungs and test lungs have, with room
#: for errors: from a neonate's lung to a large patient's.
COMPLIANCES, RESISTANCES = (0.3, 400.0), (-2.0, 400.0)

#: Ratio of the ends of an interval of C from which C is unknown.
_WIDEST = 10.0

#: Least share of the inspired volume that must be seen to leave, and most.
_CLOSES = (0.6, 1.6)

#: Largest flow of a breath, mL/s, beyond which another unit is likely, and least.
_FLOWS = (20.0, 4000.0)


def problem_with(breaths: Breaths, resistance: Estimate, compliance: Estimate) -> str | None:
    """Why R and C of a lung are not to be trusted, as a sentence; None if they are plausible."""
    low, high = compliance.ci95
    possible = COMPLIANCES[0] <= compliance.value <= COMPLIANCES[1]
    possible &= RESISTANCES[0] <= resistance.value <= RESISTANCES[1]
    definite = math.isfinite(high) and 0.0 < low <= high and high / low < _WIDEST
    if possible and definite:
        return None
    signal = "flow" if breaths.flow is not None else "volume"
    return (
        f"No lung has the R and C that pressure and {signal} ask for, so neither is given: "
        f"{_symptom(breaths)}."
    )


def _symptom(breaths: Breaths) -> str:
    """What is wrong with flow or volume, in words."""
    signal = "flow" if breaths.flow is not None else "volume"
    for saturation in find_saturation(breaths):
        if saturation.column == signal:
            return str(saturation)
    values = breaths.flow if breaths.flow is not None else breaths.volume
    assert values is not None
    known = breaths.valid & np.isfinite(breaths.pressure) & np.isfinite(values)
    volume = values
    if breaths.flow is not None:
        volume = np.cumsum(np.where(known, values * breaths.dt, 0.0), axis=1)
    steps = np.nan_to_num(np.diff(np.where(known, volume, np.nan), axis=1))
    inspired, expired = (
        float(np.median(np.maximum(sign * steps, 0.0).sum(axis=1))) for sign in (1.0, -1.0)
    )
    if expired < _CLOSES[0] * inspired:
        return (
            f"of {inspired:.0f} mL that flow in, {expired:.0f} mL are seen to leave (median of the "
            f"breaths); the {signal} misses part of the expirations, or gas leaks, or its zero is "
            "off"
        )
    if expired > _CLOSES[1] * inspired:
        return (
            f"{inspired:.0f} mL flow in and {expired:.0f} mL are seen to leave (median of the "
            f"breaths); the {signal} misses part of the inspirations, or its zero is off"
        )
    if correlation(np.cov(breaths.pressure[known], volume[known])[None], 0, 1) < OPPOSITE:
        return f"volume falls while pressure rises; the sign of the {signal} is reversed"
    if breaths.flow is not None:
        peak = float(np.nanmedian(np.nanmax(np.where(breaths.valid, breaths.flow, np.nan), axis=1)))
        if not _FLOWS[0] < peak < _FLOWS[1]:
            return f"the peak flow is {peak:.3g} mL/s; its unit may be another one"
    return f"pressure and {signal} do not move together as those of one lung do"


#: Residual, cmH2O, above which a note warns the reader.
_NOTED_NOISE = 1.0

#: Peak flow, L/s, below which a note says that R is known at small flow only.
_SMALL_FLOW = 0.2

#: Relative error of the quadratic part beyond the largest measured flow: resistors are not exactly
#: parabolic.
_EXTRAPOLATION_ERROR = 0.5

#: Least degrees of freedom of an interval; with fewer it would say nothing.
_LEAST_FREEDOM = 4

#: Faults of a sensor that may be those of a session, in words, and share of the lungs of a sound
#: session that seem to have one: rigs have inertance and leaks, which look like the last two.
FAULTS = {
    "unsound": ("flow or volume that no lung has", 0.05),
    "clipped": ("flow that is clipped", 0.05),
    "late": ("flow that is late", 0.2),
    "zero": ("a zero of the flow that is off", 0.2),
}

#: Terms by which a fit allows for a fault where it shows.
_FITTED = {"late": "inertance", "zero": "leak"}

#: Faults of the flow sensor that look like an effect.
_SENSORS = {
    "inertance": ("flow_sensor_lag",),
    "direction_resistance": ("expiratory_flow_calibration",),
}

#: What expiration has more, linear in the flow or quadratic.
_DIRECTIONS = (("difference", "cmH2O/(L/s)"), ("quadratic", "cmH2O s2/L2"))


@dataclass(frozen=True, eq=False)
class Mechanics:
    """Mechanics of a lung."""

    label: str  #: label of the lung in the recording.
    R: Estimate  #: inspiratory resistance at small flow, cmH2O/(L/s).
    C: Estimate  #: compliance over the tidal volume, mL/cmH2O.
    offset: Estimate  #: pressure at the start of a breath without the effect of flow, cmH2O.
    terms: tuple[Term, ...]  #: effects beyond R and C, the most important first.
    match: LungMatch  #: comparison with the label, with R at the flow for which the label holds.
    noise: float  #: standard deviation of the residual, cmH2O.
    breaths: int  #: number of breaths that were used.
    samples: int  #: number of smoothed samples.
    notes: tuple[str, ...]  #: warnings to the reader.
    faults: tuple[str, ...] = ()  #: what may be wrong with the sensors, of :data:`FAULTS`.


def identify(
    breaths: Breaths,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[Mechanics, ...]:
    """Identify each lung of a recording with flow or volume; they are one session.

    Args:
        breaths: the recording.
        progress: called after each lung with how many breaths are done, and of how many.

    Raises:
        InputError: if neither is recorded, or too little of a lung to tell R from C, or more than
            a fifth of the readings are none.
    """
    breaths, lungs, completed = at_the_slowest(clean(breaths)), [], 0
    notable(breaths)
    for name, part in breaths.by_lung().items():
        lungs.append(_identify_lung(name, part))
        completed += len(part)
        if progress is not None:
            progress(completed, len(breaths))
    return share_faults(lungs)


def share_faults(lungs: Sequence[Mechanics]) -> tuple[Mechanics, ...]:
    """Let lungs of one session share what is wrong with its sensors.

    A lung that does not match its label has another setting, or a sensor is at fault. Where a
    fault is likelier than a wrong label, by what the others show (:func:`~.labels.session_fault`),
    the lung's setting is unknown. A label that holds all the same is not doubted.

    Args:
        lungs: all lungs that were recorded with the same sensors, of one or several recordings.
    """
    counts = {fault: sum(fault in lung.faults for lung in lungs) for fault in FAULTS}
    return tuple(_doubted(lung, counts, len(lungs)) for lung in lungs)


def _doubted(lung: Mechanics, counts: dict[str, int], count: int) -> Mechanics:
    match = lung.match
    if match.label_matches or not match.informative or not math.isfinite(match.fitted_C):
        return lung
    likely = {
        fault: 1.0
        if fault in lung.faults
        else session_fault(counts[fault], count, FAULTS[fault][1])
        for fault in FAULTS
        if not (fault in _FITTED and fault in lung.faults)
    }
    fault = max(likely, key=lambda name: likely[name])
    if likely[fault] <= WRONG:
        return lung
    evidence = "It shows"
    if fault not in lung.faults:
        evidence = f"{counts[fault]} of the {count} lungs of its session show"
    doubt = (
        f"{evidence} {FAULTS[fault][0]}, which is likelier than a wrong label, so that whether "
        f"{lung.label} holds is unknown."
    )
    match = replace(match, settings=(), informative=False, doubt=doubt)
    return replace(lung, match=match, notes=(*lung.notes, doubt))


def _identify_lung(name: str, breaths: Breaths) -> Mechanics:
    measured = segments(breaths)
    if not measured:
        raise InputError(
            f"{name}: no piece of a breath has pressure with flow or volume for about a second; "
            "record longer pieces"
        )
    without_leak, leaks = leak(measured)
    at_lung, delayed_by = delay(without_leak)
    table = bounded(cross_products(at_lung))
    lag = None if delayed_by is None else delayed_by.parameters.get("tau")
    selected = select_terms(table, 0.0 if lag is None else 0.5 * float(np.ptp(lag.ci95)))
    full = _fit_lung(table, [term.column for term in selected], at_lung, breaths)
    plain = _fit_lung(table, _quadratic_resistance(table), at_lung, breaths)
    label = Lung(float(breaths.R[0]), float(breaths.C[0]))
    best = _best_for_label(full, plain, label)
    source = "pressure and flow" if breaths.flow is not None else "pressure and volume"
    noise = float(np.sqrt(full.fitted.variance))
    notes = _notes(breaths, at_lung, table, noise)
    R, C = best.resistance(0.0), best.compliance()
    problem = problem_with(breaths, R, C)
    terms = (
        *(term for term in (leaks, delayed_by) if term is not None),
        *(full.term(term) for term in selected),
    )
    shows = {fault: term in [t.name for t in terms] for fault, term in _FITTED.items()}
    shows |= {
        "unsound": problem is not None,
        "clipped": any(saturation.column == "flow" for saturation in find_saturation(breaths)),
    }
    faults = tuple(fault for fault in FAULTS if shows[fault])
    if problem is None:
        match = match_label(label, best.resistance, C, source)
    else:
        R, C = (Estimate(math.nan, x.unit, (math.nan, math.nan)) for x in (R, C))
        match = LungMatch(name, R.value, C.value, R.ci95, C.ci95, False, source)
        terms, notes = (), (problem, *notes)
    offset, count, samples = full.offset(), len(table), sum(map(len, at_lung))
    return Mechanics(name, R, C, offset, terms, match, noise, count, samples, notes, faults)


def _fit_lung(
    table: CrossProducts,
    further: Sequence[int],
    segments: tuple[Segment, ...],
    breaths: Breaths,
) -> LungFit:
    fitted = fit(table, np.ones(len(table), bool), (*range(len(BASE)), *further))
    # A flow may jump between two samples, which a measured volume shows.
    blur, jump = 0.0, 0.0
    if breaths.volume is None and breaths.flow is not None:
        steps = np.abs(np.diff(np.where(breaths.valid, breaths.flow, np.nan), axis=1))
        finite = np.isfinite(steps).any(axis=1)
        blur = 0.5 * float(np.median(breaths.dt[breaths.valid]))
        jump = 0.001 * float(np.median(np.nanmax(steps[finite], axis=1)))
    return LungFit(fitted, covariance(table, fitted), table, segments, blur, jump)


def _quadratic_resistance(table: CrossProducts) -> tuple[int, ...]:
    """Column of the quadratic resistance, which a label leaves open, unless it is negative."""
    fitted = fit(table, np.ones(len(table), bool), PARABOLIC)
    return PARABOLIC[len(BASE) :] if fitted.coefficients[-1] > 0.0 else ()


def _best_for_label(full: LungFit, plain: LungFit, label: Lung) -> LungFit:
    """The fit whose R and C the label is compared with.

    Further terms take over part of R and C, rightly (creep) or wrongly (what only looks like
    creep). The lung may therefore match a setting by either fit.
    """
    for lung in (full, plain):
        if fits(lung.resistance, lung.compliance(), label):
            return lung
    for lung in (full, plain):
        if matching_settings(lung.resistance, lung.compliance()):
            return lung
    return plain


def _notes(
    breaths: Breaths, segments: tuple[Segment, ...], table: CrossProducts, noise: float
) -> tuple[str, ...]:
    issues, first = check_roles(breaths), notable(breaths)
    notes = [] if first is None else [f"{first}."]
    notes += [str(finding) for finding in issues]
    if len(table) < FEWEST_BREATHS:
        notes.append(
            f"Fewer than {FEWEST_BREATHS} breaths: R and C alone, nothing else could be tested."
        )
    if lost := len(breaths) - len(table):
        notes.append(f"{lost} of {len(breaths)} breaths have no piece long enough to be used.")
    peak = max(float(segment.flow.max()) for segment in segments)
    if peak < _SMALL_FLOW and not any(finding.column == "flow" for finding in issues):
        notes.append(f"The flow stays below {1000 * peak:.0f} mL/s: R is known at small flow only.")
    if noise > _NOTED_NOISE:
        notes.append(
            f"{noise:.1f} cmH2O are left unexplained, such as a valve that chatters: R and C are "
            "rough."
        )
    return tuple(notes)


@dataclass(frozen=True, eq=False)
class LungFit:
    """Coefficients of a regression, and the quantities of a lung that follow from them."""

    fitted: RegressionFit  #: the regression.
    covariance: Floats  #: covariance of its coefficients, ``(k, k)``.
    table: CrossProducts  #: cross products of its breaths.
    segments: tuple[Segment, ...]  #: segments of the breaths.
    blur: float  #: most by which the time of a jump of the flow is off, s.
    jump: float  #: largest step of the flow from one sample to the next, median of breaths, L/s.

    def resistance(self, flow: float) -> Estimate:
        """Inspiratory resistance at a flow, L/s, and at half of the tidal volume, cmH2O/(L/s)."""
        half = 0.5 * self._tidal_volume()

        def value(x: Callable[[str], float]) -> float:
            quadratic = x("turbulent_resistance") * flow
            return x("resistance") + quadratic + x("volume_resistance") * half

        estimate = self._derived(value, "cmH2O/(L/s)")
        peak = max(float(segment.flow.max()) for segment in self.segments)
        quadratic = abs(self._coefficient("turbulent_resistance"))
        extrapolated = _EXTRAPOLATION_ERROR * quadratic * max(flow - peak, 0.0)
        jumps = self.blur * abs(self._coefficient("elastance"))
        half_width = 0.5 * (estimate.ci95[1] - estimate.ci95[0])
        reach = float(np.hypot(half_width, extrapolated)) + jumps  # the same in every breath
        ends = (estimate.value - reach, estimate.value + reach)
        return Estimate(estimate.value, estimate.unit, ends)

    def compliance(self) -> Estimate:
        """Compliance over the tidal volume, mL/cmH2O."""
        tidal = self._tidal_volume()
        elastance = self._derived(lambda x: x("elastance") + x("nonlinear_compliance") * tidal, "")
        half_width = 0.5 * (elastance.ci95[1] - elastance.ci95[0])
        jumps = abs(elastance.value) * self.blur * self.jump / tidal
        reach = half_width + jumps
        low, high = (max(elastance.value + side * reach, 1e-3) for side in (-1.0, 1.0))
        return Estimate(1000.0 / elastance.value, "mL/cmH2O", (1000.0 / high, 1000.0 / low))

    def offset(self) -> Estimate:
        """Median initial pressure of the segments that begin where their breath does, cmH2O."""
        values = []
        for segment in (s for s in self.segments if s.first):
            rows = course(segment, [COLUMNS[c] for c in self.fitted.columns])[segment.rows]
            residual = segment.pressure - rows @ self.fitted.coefficients
            line = np.polyfit(segment.time[segment.rows], residual, 1)
            values.append(float(np.polyval(line, 0.0)))
        if not values:
            return Estimate(float("nan"), "cmH2O", (float("nan"), float("nan")))
        median, count = float(np.median(values)), len(values)
        # Robust standard error of a median: a breath that was cut off must not count for much.
        spread = 1.25 * 1.4826 * float(np.median(np.abs(np.array(values) - median)))
        factor = t_quantile(max(count - 1, _LEAST_FREEDOM))
        reach = factor * spread / np.sqrt(count) if count > 1 else np.inf
        return Estimate(median, "cmH2O", (median - reach, median + reach))

    def term(self, selected: SelectedTerm) -> Term:
        """The term with its parameters, in the units of the library if the library has it."""
        name = selected.name
        alternatives = selected.alternatives + _SENSORS.get(name, ())
        size = effect_size(self.table, self.fitted, selected.column)
        return Term(
            name, self._parameters(name, selected.column), selected.nats, size, alternatives
        )

    def _parameters(self, name: str, column: int) -> dict[str, Estimate]:
        coefficients = {
            "turbulent_resistance": ("quadratic", "cmH2O s2/L2"),
            "inertance": ("inertance", "cmH2O s2/L"),
            "direction_resistance": _DIRECTIONS[column == columns_of("direction_resistance")[1]],
            "volume_resistance": ("slope", "cmH2O s/L2"),
        }
        if name in coefficients:
            short, unit = coefficients[name]
            return {short: self._derived(lambda x: x(name), unit)}
        if name == "nonlinear_compliance":
            stiffening = self._derived(lambda x: 2.0 * x(name) / x("elastance") ** 2, "1/cmH2O")
            return {"stiffening": stiffening}
        time = COLUMNS[column].time
        assert time is not None
        low = max((t for t in TIMES if t < time), default=time)
        high = min((t for t in TIMES if t > time), default=time)
        return {
            "ratio": self._derived(lambda x: x(name) / x("elastance"), "1"),
            "time": Estimate(time, "s", (low, high)),
        }

    def _derived(self, value: Callable[[Callable[[str], float]], float], unit: str) -> Estimate:
        """A function of the coefficients, with its interval by linear error propagation."""
        x = self.fitted.coefficients
        terms = [COLUMNS[c].term for c in self.fitted.columns]

        def at(point: Floats) -> float:
            named = {term: float(v) for term, v in zip(terms, point, strict=True)}
            return float(value(lambda name: named.get(name, 0.0)))

        step = 1e-4 * np.maximum(np.abs(x), 1e-6)
        slopes = [
            (at(x + h * direction) - at(x - h * direction)) / (2.0 * h)
            for h, direction in zip(step, np.eye(len(x)), strict=True)
        ]
        sd = float(np.sqrt(max(np.array(slopes) @ self.covariance @ np.array(slopes), 0.0)))
        reach, centre = t_quantile(max(len(self.table) - 1, _LEAST_FREEDOM)) * sd, at(x)
        return Estimate(centre, unit, (centre - reach, centre + reach))

    def _coefficient(self, term: str) -> float:
        terms = [COLUMNS[c].term for c in self.fitted.columns]
        return float(self.fitted.coefficients[terms.index(term)]) if term in terms else 0.0

    def _tidal_volume(self) -> float:
        """Range of the volume, median over the segments, L."""
        return float(np.median([np.ptp(segment.volume) for segment in self.segments]))
