"""Whether flow or volume can give R and C at all, and if not, what is wrong with them.

R and C of a regression are numbers whatever its data are. A compliance that is negative, or that no
lung has, says that the recorded flow or volume is not that of the lung: an expiratory flow that the
sensor does not see, a reversed sign, another unit, a volume that drifts.
"""

from __future__ import annotations

import math

import numpy as np

from ventbench.mechanics.labels import Estimate
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.roles import find_saturation

#: Compliances, mL/cmH2O, and resistances, cmH2O/(L/s), that lungs and test lungs have, with room
#: for errors: from a neonate's lung to a large patient's.
COMPLIANCES, RESISTANCES = (0.3, 400.0), (-2.0, 400.0)

#: Ratio of the ends of an interval of C from which C is unknown.
_WIDEST = 10.0

#: Least share of the inspired volume that must be seen to leave, and most.
_CLOSES = (0.6, 1.6)

#: Correlation of pressure and volume below which they do not belong to one lung.
_TOGETHER = 0.2

#: Largest flow of a breath, mL/s, beyond which another unit is likely, and least.
_FLOWS = (20.0, 4000.0)


def problem_with(breaths: Breaths, resistance: Estimate, compliance: Estimate) -> str | None:
    """Why R and C of a lung are not to be trusted, as a sentence; None if they are plausible.

    Args:
        breaths: breaths of the lung, with flow or volume.
        resistance: R, cmH2O/(L/s).
        compliance: C, mL/cmH2O.
    """
    low, high = compliance.ci95
    possible = COMPLIANCES[0] <= compliance.value <= COMPLIANCES[1]
    possible &= RESISTANCES[0] <= resistance.value <= RESISTANCES[1]
    definite = math.isfinite(high) and 0.0 < low <= high and high / low < _WIDEST
    if possible and definite:
        return None
    what = "flow" if breaths.flow is not None else "volume"
    return (
        f"No lung has the R and C that pressure and {what} ask for, so neither is given: "
        f"{_symptom(breaths)}."
    )


def _symptom(breaths: Breaths) -> str:
    """What is wrong with flow or volume, in words."""
    what = "flow" if breaths.flow is not None else "volume"
    for saturation in find_saturation(breaths):
        if saturation.column == what:
            return str(saturation)
    into, out, together = [], [], []
    for i in range(len(breaths)):
        known = breaths.valid[i] & np.isfinite(breaths.pressure[i])
        if breaths.flow is not None:
            known = known & np.isfinite(breaths.flow[i])
            flow = np.where(known, np.nan_to_num(breaths.flow[i]), 0.0)
            steps = flow * breaths.dt[i]
            volume = np.cumsum(steps)
        else:
            assert breaths.volume is not None
            known = known & np.isfinite(breaths.volume[i])
            volume = np.nan_to_num(breaths.volume[i])
            steps = np.where(known[1:] & known[:-1], np.diff(volume), 0.0)
        if known.sum() < 3:
            continue
        into.append(float(steps[steps > 0].sum()))
        out.append(float(-steps[steps < 0].sum()))
        p, v = breaths.pressure[i, known], volume[known]
        if np.ptp(p) > 0 and np.ptp(v) > 0:
            together.append(float(np.corrcoef(p, v)[0, 1]))
    if not into:
        return f"{what} and pressure are hardly ever known together"
    inspired, expired = float(np.median(into)), float(np.median(out))
    if expired < _CLOSES[0] * inspired:
        return (
            f"of {inspired:.0f} mL that flow in, {expired:.0f} mL are seen to leave (median of the "
            f"breaths); the {what} misses part of the expirations, or gas leaks, or its zero is off"
        )
    if expired > _CLOSES[1] * inspired:
        return (
            f"{inspired:.0f} mL flow in and {expired:.0f} mL are seen to leave (median of the "
            f"breaths); the {what} misses part of the inspirations, or its zero is off"
        )
    if together and float(np.median(together)) < -_TOGETHER:
        return f"volume falls while pressure rises; the sign of the {what} is reversed"
    if breaths.flow is not None:
        peak = float(np.nanmedian(np.nanmax(np.where(breaths.valid, breaths.flow, np.nan), axis=1)))
        if not _FLOWS[0] < peak < _FLOWS[1]:
            return f"the peak flow is {peak:.3g} mL/s; its unit may be another one"
    return f"pressure and {what} do not move together as those of one lung do"
