"""Numbers as a person reads them: rounded by what is known of them, in units that fit."""

from __future__ import annotations

import math

from ventbench.diagnosis.result import Estimate

#: Parameters without a unit that are shares: shown in %.
SHARES = frozenset({"valve_curve.loss", "supply_droop.drop", "sensor_drift.gain"})

#: Times below this are shown in ms, s.
_SHORT = 0.5


def quantity(estimate: Estimate, path: str = "") -> str:
    """A value with the ends of its interval, such as ``41 ms [38, 44]``.

    Args:
        estimate: to be shown.
        path: of the parameter, ``valve_curve.loss``, by which shares are known.
    """
    factor, unit = _scale(estimate, path)
    value, low, high = (factor * x for x in (estimate.value, *estimate.ci95))
    places = decimals(value, low, high)
    name = f" {unit}" if unit else ""
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{rounded(value, places)}{name}"
    return f"{rounded(value, places)}{name} [{rounded(low, places)}, {rounded(high, places)}]"


def like(value: float, estimate: Estimate, path: str = "") -> str:
    """Another value of the same parameter, in the same unit and with as many digits."""
    factor, unit = _scale(estimate, path)
    places = decimals(*(factor * x for x in (estimate.value, *estimate.ci95)))
    return f"{rounded(factor * value, places)}{f' {unit}' if unit else ''}"


def decimals(value: float, low: float, high: float) -> int:
    """Digits after the point, so that half the interval shows one or two digits."""
    half = 0.5 * (high - low)
    if not (math.isfinite(half) and half > 0):
        half = abs(value) / 100 if math.isfinite(value) and value else 1.0
    return min(max(0, -math.floor(math.log10(half))), 6)


def rounded(value: float, places: int) -> str:
    """Fixed decimals, with zero never negative."""
    if not math.isfinite(value):
        return "unknown"
    text = f"{value:.{places}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def span(low: float, high: float, unit: str) -> str:
    """A range with its unit, ``0 to 0.2 s``."""
    name = "" if unit in ("1", "") else f" {unit}"
    return f"{low:.6g} to {high:.6g}{name}"


def probability(p_value: float) -> str:
    """A p-value as a person writes it."""
    return "p < 0.01" if p_value < 0.01 else f"p = {p_value:.2f}"


def _scale(estimate: Estimate, path: str) -> tuple[float, str]:
    largest = max(
        (abs(x) for x in (estimate.value, *estimate.ci95) if math.isfinite(x)), default=0.0
    )
    if estimate.unit == "s" and 0.0 < largest < _SHORT:
        return 1000.0, "ms"
    if path in SHARES:
        return 100.0, "%"
    return 1.0, "" if estimate.unit == "1" else estimate.unit
