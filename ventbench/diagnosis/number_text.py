"""Numbers, ranges and errors as a person reads them: units, digits, intervals, places, lungs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ventbench.diagnosis.findings import ErrorRegion
from ventbench.diagnosis.residual_analysis import EDGE
from ventbench.mechanics.labels import GAIN, Estimate, LungMatch, tolerance_text
from ventbench.physics import parameter

#: Axes whose ranges are parts of a breath: an effect is described best by these.
PHASES = ("time since inspiration", "time since expiration")

#: How a range of time is described: what it starts from, and what it is the beginning of.
_MOMENTS = {
    PHASES[0]: ("the start of inspiration", "of each breath"),
    PHASES[1]: ("the start of expiration", "of expiration"),
    EDGE: ("an edge of a valve", "after an edge of a valve"),
}

#: Moments up to this are given in ms, s.
_SHORT_MOMENT = 0.15

#: A mean error below this share of the noise says nothing about its sign.
_NO_SIGN = 0.25

#: Parameters of time below this are given in ms, s.
_SHORT_PARAMETER = 0.5

#: Most breaths, or ranges of breaths, that a sentence lists.
_LISTED = 10


def quantity(estimate: Estimate, path: str = "") -> str:
    """A value with the ends of its interval, such as ``41 ms [38, 44]``.

    Args:
        estimate: the estimate to show.
        path: path of the parameter, such as ``valve_curve.loss``; tells shares, which are given in
            %.
    """
    factor, unit = scaled(estimate, path)
    value, low, high = (factor * x for x in (estimate.value, *estimate.ci95))
    places = _decimals(value, low, high)
    name = f" {unit}" if unit else ""
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{rounded(value, places)}{name}"
    return f"{rounded(value, places)}{name} [{rounded(low, places)}, {rounded(high, places)}]"


def quantity_like(value: float, estimate: Estimate, path: str = "") -> str:
    """Another value of a parameter, in the unit and with the digits of its estimate."""
    factor, unit = scaled(estimate, path)
    places = _decimals(*(factor * x for x in (estimate.value, *estimate.ci95)))
    return f"{rounded(factor * value, places)}{f' {unit}' if unit else ''}"


def rounded(value: float, places: int) -> str:
    """Fixed decimals; zero is never negative."""
    if not math.isfinite(value):
        return "unknown"
    text = f"{value:.{places}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def capital(text: str) -> str:
    """The text with a capital at its start."""
    return text[:1].upper() + text[1:]


def probability(p_value: float) -> str:
    """A p-value as it is written in text."""
    return "p < 0.01" if p_value < 0.01 else f"p = {p_value:.2f}"


def two_digits(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}" if value >= 0.01 else f"{value:.3f}"


def signed(value: float) -> str:
    """Two digits with a sign where it is negative."""
    return f"{'-' if value < 0 else ''}{two_digits(abs(value))}"


def _decimals(value: float, low: float, high: float) -> int:
    """Digits after the point with which half the interval shows one or two digits."""
    half = 0.5 * (high - low)
    if not (math.isfinite(half) and half > 0):
        half = abs(value) / 100 if math.isfinite(value) and value else 1.0
    return min(max(0, -math.floor(math.log10(half))), 6)


def scaled(estimate: Estimate, path: str) -> tuple[float, str]:
    """Factor and unit in which a parameter is given."""
    largest = max(
        (abs(x) for x in (estimate.value, *estimate.ci95) if math.isfinite(x)), default=0.0
    )
    if estimate.unit == "s" and 0.0 < largest < _SHORT_PARAMETER:
        return 1000.0, "ms"
    if path and parameter(path).share:
        return 100.0, "%"
    return 1.0, "" if estimate.unit == "1" else estimate.unit


def error_region(region: ErrorRegion, noise: float = 0.0) -> str:
    """One error region as a sentence.

    Args:
        region: the range to describe.
        noise: standard deviation of the measurement, cmH2O; far smaller errors have no sign.
    """
    return f"{capital(error_phrase(region, noise))}."


def error_phrase(region: ErrorRegion, noise: float) -> str:
    """Phrase on how the simulator errs in a region; errors are recorded minus simulated."""
    size = abs(region.mean_error)
    if size < max(_NO_SIGN * noise, 0.005):
        return (
            f"the simulated pressure is off {where(region)}, by errors whose sign changes from "
            "breath to breath"
        )
    side = "too low" if region.mean_error > 0 else "too high"
    return f"the simulated pressure is {two_digits(size)} cmH2O {side} {where(region)}"


def where(region: ErrorRegion) -> str:
    """A region in words that follow "the pressure is too high"."""
    if region.axis in _MOMENTS:
        after, phase = _MOMENTS[region.axis]
        if region.low == 0:
            return f"in the first {_time(region.high)} {phase}"
        ends = f"{region.low:.6g} to {region.high:.6g} s"
        if region.high <= _SHORT_MOMENT:
            ends = f"{1000 * region.low:.6g} to {1000 * region.high:.6g} ms"
        return f"from {ends} after {after}"
    if region.axis == "breath number":
        return f"in breaths {region.low:.6g} to {region.high:.6g} of the recording"
    if region.axis.startswith("lung "):
        return f"on {region.axis}"
    unit = "" if region.unit in ("1", "") else f" {region.unit}"
    return f"where the {region.axis} is {region.low:.6g} to {region.high:.6g}{unit}"


def _time(seconds: float) -> str:
    return f"{1000 * seconds:.6g} ms" if seconds <= _SHORT_MOMENT else f"{seconds:.6g} s"


def breaths_in_words(ids: Sequence[int]) -> str:
    """Ids of breaths in words; those that follow each other as a range."""
    parts = np.split(np.asarray(ids), np.flatnonzero(np.diff(ids) != 1) + 1)
    phrases = [" to ".join(map(str, dict.fromkeys((part[0], part[-1])))) for part in parts]
    if len(phrases) > _LISTED:
        phrases = [*phrases[: _LISTED - 1], f"others up to {ids[-1]}"]
    text = " and ".join(filter(None, [", ".join(phrases[:-1]), *phrases[-1:]]))
    return f"breath{'s' * (len(ids) > 1)} {text}"


def lung(match: LungMatch) -> str:
    """Whether a lung is what its label says, within which tolerance, and what else it may be."""
    values = [
        f"{name} {quantity(Estimate(value, unit, ends))}"
        for name, value, ends, unit in (
            ("R", match.fitted_R, match.ci95_R, "cmH2O/(L/s)"),
            ("C", match.fitted_C, match.ci95_C, "mL/cmH2O"),
        )
        if math.isfinite(value)
    ]
    fitted = f"{' and '.join(values)}, from {match.source}" if values else "R and C unknown"
    if not values:
        return f"Whether the lung matches its label {match.label} is unknown: {fitted}."
    gain = ""
    if match.source == "pressure":
        gain = f", and a valve gain wrong by {100 * (GAIN - 1):.0f} %"
    tolerance = f"tolerance: {tolerance_text()}{gain}"
    alternatives = [name for name in match.settings if name != match.label][:2]
    if match.label_matches:
        also = (
            f" Within the same tolerance it could be {' or '.join(alternatives)}."
            if alternatives
            else ""
        )
        return f"The lung matches its label {match.label}: {fitted} ({tolerance}).{also}"
    hint = f" It may be {' or '.join(alternatives)}." if alternatives else ""
    if not match.informative:
        why = "" if match.doubt else ", since the intervals are too wide"
        return f"Whether the lung matches its label {match.label} is unknown{why}: {fitted}.{hint}"
    return f"The lung does not match its label {match.label}: {fitted} ({tolerance}).{hint}"
