"""Comparison of a lung with its label and with all known settings.

The resistors of test lungs such as the QuickLung are parabolic: they have their nominal resistance
at one flow only. Where the quadratic part is known, R is evaluated at that flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ventbench.task.lungs import RECORDED_LUNGS, Lung

if TYPE_CHECKING:
    from ventbench.system_id import Fit

#: Factors by which R and C may differ from the label beyond their intervals in 95 % of cases:
#: calibration errors of lung and sensors.
TOLERANCE_R, TOLERANCE_C = 1.3, 1.2

#: Resistance of tubes and filters between pressure sensor and lung, by which R may be larger,
#: cmH2O/(L/s).
APPARATUS = 2.0

#: Ratio of the ends of an interval beyond which it says nothing of a label: neighbouring settings
#: of test lungs differ by no more.
INFORMATIVE = 2.5

#: Flow at which a parabolic resistor has its nominal resistance, L/s.
REFERENCE_FLOW = 1.0

#: Normal quantile of 97.5 %, and quantile of 99 % of chi square of two degrees of freedom.
_Z95, _CHI2 = 1.96, 9.21

#: Factor by which the gain of the valve may be wrong where flow is not measured.
GAIN = 1.2

#: Share of a parameter that the equations of the library miss, as a standard deviation. Lags, dead
#: times and compliances that strangers' recordings know to 1 % by their noise were 1 to 3 % off,
#: R and C 0.4 to 0.8 %: steps of time, jitter of the clock, tubes, forms of what acts beside them.
FORM_ERROR = 0.015


@dataclass(frozen=True)
class Estimate:
    """Value of a parameter with the ends of its 95 % interval, all in ``unit``."""

    value: float
    unit: str
    ci95: tuple[float, float]

    def with_error(
        self, share: float, neutral: float = 0.0, low: float = -math.inf, high: float = math.inf
    ) -> Estimate:
        """The estimate with an error of its distance from a neutral value.

        Args:
            share: standard deviation of the error, as a share of the distance.
            neutral: value that nothing is off at.
            low: least possible value.
            high: largest possible value.
        """
        first, last = self.ci95
        ends = _wider(self.value - neutral, first - neutral, last - neutral, share)
        if not all(map(math.isfinite, ends)):
            return self
        return replace(self, ci95=(max(neutral + ends[0], low), min(neutral + ends[1], high)))


def _wider(value: float, low: float, high: float, share: float) -> tuple[float, float]:
    """Ends of an interval with an error of so much of the value, as a standard deviation.

    Positive values err by factors; an interval that reaches zero errs by a sum.
    """
    if value < 0.0:
        upper, lower = _wider(-value, -high, -low, share)
        return -lower, -upper
    if low > 0.0 and math.isfinite(high):
        down, up = (math.hypot(math.log(x), _Z95 * share) for x in (value / low, high / value))
        return value * math.exp(-down), value * math.exp(up)
    down, up = (math.hypot(x, _Z95 * share * value) for x in (value - low, high - value))
    return value - down, value + up


@dataclass(frozen=True)
class LungMatch:
    """The lung that was recorded, compared with its label; R in cmH2O/(L/s), C in mL/cmH2O."""

    label: str  #: id of the lung in the recording, such as ``R20C50``.
    fitted_R: float  #: resistance.
    fitted_C: float  #: compliance.
    ci95_R: tuple[float, float]  #: ends of the 95 % interval of R.
    ci95_C: tuple[float, float]  #: ends of the 95 % interval of C.
    #: whether R and C are within tolerance of the label, and known well enough to be called a
    #: match.
    label_matches: bool
    source: str  #: ``pressure`` (given the valve's gain) or ``pressure and flow``.
    #: ids of known settings that the lung may be: the label if it holds, then the nearest.
    settings: tuple[str, ...] = ()
    #: False if the label is within tolerance only because the intervals are wide.
    informative: bool = True
    #: why the label cannot be judged although the intervals are narrow, as a sentence.
    doubt: str = ""


#: Resistance, cmH2O/(L/s), at a flow, L/s.
Resistance = Callable[[float], Estimate]


def fits(resistance: Resistance, compliance: Estimate, setting: Lung, scale: float = 1.0) -> bool:
    """Whether R and C are as near to a setting as independent errors put them in 99 % of cases.

    The logarithms of R and C are off by the tolerances of lung and sensors, by what their intervals
    say, and both together by the gain of the valve, each of which is a 95 % interval. Tubes may add
    any part of their resistance. That all are off at their ends at once is no longer chance.

    Args:
        resistance: resistance of the lung as a function of flow.
        compliance: compliance of the lung, mL/cmH2O.
        setting: lung setting to compare with.
        scale: common factor by which R and 1/C may be wrong.
    """
    (r, of_R), (c, of_C) = _off_R(resistance, setting), _off_C(compliance, setting)
    common = (math.log(scale) / _Z95) ** 2
    first, second = of_R + common, of_C + common
    if math.isinf(first) or math.isinf(second):  # one says nothing
        return min(c**2 / second if math.isinf(first) else r**2 / first, math.inf) <= _CHI2
    determinant = first * second - common**2
    return (second * r**2 - 2.0 * common * r * c + first * c**2) / determinant <= _CHI2


def _off_R(resistance: Resistance, setting: Lung) -> tuple[float, float]:
    """Logarithm of R, less the likeliest part of the tubes, over a setting's; and its variance."""
    low, high = resistance(REFERENCE_FLOW).ci95
    at = _middle(low, high)
    low, high, at = (x - min(max(at - setting.R, 0.0), APPARATUS) for x in (low, high, at))
    return _log(at / setting.R), _variance(low, high, TOLERANCE_R)


def _off_C(compliance: Estimate, setting: Lung) -> tuple[float, float]:
    """Logarithm of the elastance over a setting's, and its variance."""
    low, high = compliance.ci95
    return _log(setting.C / _middle(low, high)), _variance(low, high, TOLERANCE_C)


def _middle(low: float, high: float) -> float:
    """Middle of an interval of a factor; its upper end where the lower one is no factor."""
    return math.sqrt(low * high) if low > 0.0 else high


def _variance(low: float, high: float, tolerance: float) -> float:
    if not low > 0.0 or not math.isfinite(high):
        return math.inf
    return (math.log(tolerance) / _Z95) ** 2 + (0.5 * math.log(high / low) / _Z95) ** 2


def matching_settings(
    resistance: Resistance, compliance: Estimate, scale: float = 1.0
) -> tuple[Lung, ...]:
    """Return the known settings within tolerance, the nearest first; see :func:`fits`."""

    def distance(setting: Lung) -> float:
        value = resistance(REFERENCE_FLOW).value
        deviation = _log(value / setting.R) / math.log(TOLERANCE_R)
        return deviation**2 + (_log(compliance.value / setting.C) / math.log(TOLERANCE_C)) ** 2

    within = [lung for lung in RECORDED_LUNGS if fits(resistance, compliance, lung, scale)]
    return tuple(sorted(within, key=distance))


def match_label(
    label: Lung, resistance: Resistance, compliance: Estimate, source: str, scale: float = 1.0
) -> LungMatch:
    """Compare a lung with its label; see :func:`fits`.

    Args:
        label: setting that the recording states.
        resistance: resistance of the lung as a function of flow.
        compliance: compliance of the lung, mL/cmH2O.
        source: signals that R and C follow from, in words.
        scale: common factor by which R and 1/C may be wrong.
    """
    at = resistance(REFERENCE_FLOW)
    same = fits(resistance, compliance, label, scale)
    r, c = (at.ci95, APPARATUS), (compliance.ci95, 0.0)
    informative = all(_is_informative(*bounds) for bounds in (r, c))
    # A fit that cannot tell one of them is not trusted with the other, but a wide interval that
    # the label lies beyond contradicts it.
    beyond = [
        off**2 > _CHI2 * (variance + (math.log(scale) / _Z95) ** 2)
        for (off, variance), bounds in (
            (_off_R(resistance, label), r),
            (_off_C(compliance, label), c),
        )
        if not _is_informative(*bounds)
    ]
    candidates = [setting.id for setting in matching_settings(resistance, compliance, scale)]
    if same and informative:  # what holds comes first, whatever is nearer
        candidates.sort(key=lambda setting: setting != label.id)
    return LungMatch(
        label.id,
        at.value,
        compliance.value,
        at.ci95,
        compliance.ci95,
        same and informative,
        source,
        tuple(candidates),
        informative=informative or any(beyond),
    )


def _is_informative(ci95: tuple[float, float], apparatus: float = 0.0) -> bool:
    """Whether an interval, with tubes on top of it, tells neighbouring settings apart."""
    low, high = (max(end, 0.0) + apparatus for end in ci95)
    return high <= INFORMATIVE * low


def value_text(value: float, ci95: tuple[float, float]) -> str:
    """A value with its interval for tables, or "unknown"."""
    return f"{value:.1f} [{ci95[0]:.1f}, {ci95[1]:.1f}]" if math.isfinite(value) else "unknown"


def label_texts(match: LungMatch) -> tuple[str, str]:
    """Whether a label holds, and what else the lung may be, for tables."""
    if not math.isfinite(match.fitted_C):
        return "unknown", "unknown"
    alternatives = [setting for setting in match.settings if setting != match.label]
    if match.doubt:
        return "unknown", match.label
    if match.label_matches or not match.informative:
        holds = "yes" if match.informative else "unknown"
        return holds, f"{match.label}, or {alternatives[0]}" if alternatives else match.label
    return "no", ", ".join(alternatives[:2]) or "none known"


def tolerance_text() -> str:
    """How far each of R and C may be from a label that holds, in words."""
    return (
        f"R by a factor of {TOLERANCE_R:g} and {APPARATUS:g} cmH2O/(L/s) of tubes, "
        f"C by a factor of {TOLERANCE_C:g}"
    )


def match_labels(fit: Fit) -> tuple[LungMatch, ...]:
    """Fitted R and C of each lung of a fit to pressure alone, and whether its label can be right.

    The label is judged at the flow of its definition. The unknown gain of the valve scales R and
    1/C by a common factor of up to 1.2.
    """
    data, matches = fit.problem.data, []
    quadratics = fit.column("turbulent_resistance.quadratic")
    for group in range(int(data.lung.max()) + 1):
        breath = int((data.lung == group).argmax())
        R, compliance = (
            Estimate(
                float(fit.value(path)[group]), unit, tuple(fit.ci95(path)[group].tolist())
            ).with_error(FORM_ERROR, low=0.0)
            for path, unit in (("R", "cmH2O/(L/s)"), ("C", "mL/cmH2O"))
        )
        quadratic = float(quadratics[breath])

        def resistance(flow: float, R: Estimate = R, quadratic: float = quadratic) -> Estimate:
            more = quadratic * flow
            return Estimate(R.value + more, R.unit, (R.ci95[0] + more, R.ci95[1] + more))

        label = Lung(float(data.R[breath]), float(data.C[breath]))
        match = match_label(label, resistance, compliance, "pressure", GAIN)
        matches.append(replace(match, fitted_R=R.value, ci95_R=R.ci95))
    return tuple(matches)


def _log(ratio: float) -> float:
    return math.log(ratio) if ratio > 0.0 else -math.inf


#: Before anything is seen: share of the sessions with a fault of a kind, and of the wrong labels.
_FAULTY, WRONG = 0.05, 0.05


def session_fault(positives: int, count: int, stray: float) -> float:
    """Probability that a fault which some recordings of a session show is in all of them.

    A fault of the session shows in a share ``s`` of its recordings, uniform before it is seen, so
    that ``k`` of ``n`` show it with the probability ``1 / ((n + 1) binomial(n, k))``. In a sound
    session each recording shows it by chance.

    Args:
        positives: number k of recordings that show the fault.
        count: number n of recordings.
        stray: share of the recordings of a sound session that show it.
    """
    by_fault = 1.0 / ((count + 1) * math.comb(count, positives))
    by_chance = stray**positives * (1.0 - stray) ** (count - positives)
    return _FAULTY * by_fault / (_FAULTY * by_fault + (1.0 - _FAULTY) * by_chance)
