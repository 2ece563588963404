"""Whether a lung is what its label says, and which setting it is if not.

The resistors of test lungs such as the QuickLung are parabolic: they have their nominal resistance
at one flow only. Where the quadratic part is known, R is taken at that flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from ventbench.lungs import RECORDED_LUNGS, Lung
from ventbench.mechanics.lung_match import Estimate, LungMatch
from ventbench.system_id import Fit

#: Factors by which R and C may differ from the label, beyond their intervals: what calibration of
#: lung and sensors allows.
TOLERANCE_R, TOLERANCE_C = 1.3, 1.2

#: Resistance of tubes and filters between pressure sensor and lung, cmH2O s/L: R may be more by it.
APPARATUS = 2.0

#: Flow at which a parabolic resistor is taken to have its nominal resistance, L/s.
REFERENCE_FLOW = 1.0

#: Factor by which the gain of the valve may be off where flow was not measured.
GAIN = 1.2

#: Resistance, cmH2O s/L, at a flow, L/s.
Resistance = Callable[[float], Estimate]


def fits(resistance: Resistance, compliance: Estimate, setting: Lung, scale: float = 1.0) -> bool:
    """Whether a setting is within tolerance of the intervals.

    Args:
        resistance: of the lung, by flow.
        compliance: of the lung, mL/cmH2O.
        setting: to compare with.
        scale: factor by which R and 1/C may be wrong together.
    """
    low, high = resistance(REFERENCE_FLOW).ci95
    ends = (low - APPARATUS) / TOLERANCE_R, high * TOLERANCE_R
    from_R = [_log(end / setting.R) for end in ends]
    low, high = compliance.ci95
    from_C = [_log(setting.C / end) for end in (high * TOLERANCE_C, low / TOLERANCE_C)]
    reach = math.log(scale)
    return max(from_R[0], from_C[0], -reach) <= min(from_R[1], from_C[1], reach) + 1e-12


def matching(resistance: Resistance, compliance: Estimate, scale: float = 1.0) -> tuple[Lung, ...]:
    """The known settings that a lung may be, the nearest first."""

    def distance(setting: Lung) -> float:
        value = resistance(REFERENCE_FLOW).value
        away = _log(value / setting.R) / math.log(TOLERANCE_R)
        return away**2 + (_log(compliance.value / setting.C) / math.log(TOLERANCE_C)) ** 2

    known = [item for item in RECORDED_LUNGS if fits(resistance, compliance, item, scale)]
    return tuple(sorted(known, key=distance))


def match(
    label: Lung, resistance: Resistance, compliance: Estimate, source: str, scale: float = 1.0
) -> LungMatch:
    """Compare a lung with its label."""
    at = resistance(REFERENCE_FLOW)
    same = fits(resistance, compliance, label, scale)
    return LungMatch(
        label.id, at.value, compliance.value, at.ci95, compliance.ci95, same, source
    )  # fmt: skip


def labels(fit: Fit) -> tuple[LungMatch, ...]:
    """Compare each lung of a fit to pressure alone with its label.

    The gain of the valve is a common scale of R and 1/C: it may be off by a factor of 1.2.
    """
    return tuple(
        match(setting, resistance, compliance, "pressure", GAIN)
        for setting, resistance, compliance in _of_fit(fit)
    )


def settings_of(fit: Fit) -> dict[str, tuple[Lung, ...]]:
    """The known settings that each lung of a fit to pressure alone may be, by its label."""
    return {
        setting.id: matching(resistance, compliance, GAIN)
        for setting, resistance, compliance in _of_fit(fit)
    }


def label(fit: Fit) -> LungMatch:
    """Like :func:`labels`, of the first lung."""
    return labels(fit)[0]


def _of_fit(fit: Fit) -> list[tuple[Lung, Resistance, Estimate]]:
    data, found = fit.problem.data, []
    quadratic = fit.column("turbulent_resistance.quadratic")
    for group in range(int(data.lung.max()) + 1):
        breath = int((data.lung == group).argmax())
        ends = {path: fit.ci95(path)[group] for path in ("R", "C")}
        R, C = (float(fit.value(path)[group]) for path in ("R", "C"))
        K2 = float(quadratic[breath])

        def resistance(
            flow: float, R: float = R, K2: float = K2, ci: object = ends["R"]
        ) -> Estimate:
            low, high = ci  # type: ignore[misc]
            more = K2 * flow
            return Estimate(R + more, "cmH2O s/L", (float(low) + more, float(high) + more))

        low, high = ends["C"]
        compliance = Estimate(C, "mL/cmH2O", (float(low), float(high)))
        setting = Lung(float(data.R[breath]), float(data.C[breath]))
        found.append((setting, resistance, compliance))
    return found


def _log(ratio: float) -> float:
    return math.log(ratio) if ratio > 0.0 else -math.inf
