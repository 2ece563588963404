"""A leak by the balance of volume: gas that flows in and does not come back.

Over a breath from one rest to the next the lung gives back what it took, whatever its resistance
and its compliance are. What is missing went through a leak, or the sensor's zero is off. The shape
of the signals within a breath does not decide: a leak changes it as creep, a nonlinear resistance
and a drift do, and hundreds of samples would outvote the one number that only a leak explains.

Signals without the leak are those of the lung, so that no other term has to make up for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit

from ventbench.base.arrays import Floats
from ventbench.mechanics.labels import Estimate
from ventbench.mechanics.regression import ZERO, parabolic
from ventbench.mechanics.segments import Segment
from ventbench.mechanics.term_selection import FEWEST_BREATHS, LEAST_NATS, Term
from ventbench.system_id.fit import t_quantile

#: Relative error of the volume that a change of the pressure between the ends of segments stands
#: for, in all of them alike: segments that begin or end within a breath say little.
_STORED_ERROR = 0.2

#: Least share of the inspired volume that a sensor must see leave: one that sees less does not see
#: expirations, and what it misses is no leak.
_SEEN = 0.2

#: Relative error by which a sensor of flow reads inspiration and expiration differently.
_CALIBRATION_ERROR = 0.02

#: Degrees of freedom of the errors of single segments: a cough must not count for much.
_TAILS = 3.0

#: Least scatter of the balances of segments, L/s, and steps of the weights.
_LEAST_SCATTER, _STEPS = 0.001, 20


def leak(segments: Sequence[Segment]) -> tuple[tuple[Segment, ...], Term | None]:
    """Estimate a leak between flow sensor and lung, and take it out of flow and volume.

    The imbalance of segment i, per time, is ``k p_i + z + f s_i + c v_i + e_i``: the leak's
    conductance k, L/s per cmH2O, times the mean pressure; the zero z of the flow sensor, whose
    standard deviation is :data:`~.regression.ZERO`; relative errors f of what the lung stores
    between the ends of the segment, and c of the volume that it breathes; and an error with tails.

    Returns the segments with the lung's own flow and volume, and the leak; None where no leak is
    needed, or too few segments could tell. Its second parameter is the zero, mL/s, that would look
    alike: where all breaths have the same mean pressure, nothing that is recorded tells them apart.
    """
    breaths = len({segment.breath for segment in segments})
    if breaths < FEWEST_BREATHS:
        return tuple(segments), None
    resistance, elastance, _, quadratic = parabolic(segments).coefficients
    steps = np.concatenate([np.diff(segment.volume) for segment in segments])
    inspired, expired = steps[steps > 0.0].sum(), -steps[steps < 0.0].sum()
    if elastance <= 0.0 or expired < _SEEN * inspired:
        return tuple(segments), None
    pressures = [np.gradient(segment.dose, segment.time, edge_order=2) for segment in segments]
    rows = []
    for segment, pressure in zip(segments, pressures, strict=True):
        flow = segment.flow
        inside = pressure - (resistance + quadratic * np.abs(flow)) * flow
        stored = (inside[-1] - inside[0]) / elastance
        missing = segment.volume[-1] - segment.volume[0] - stored
        dose = segment.dose[-1] - segment.dose[0]
        # A piece of a breath ends where the lung holds gas; of a whole one, noise is left here.
        rows.append((missing, dose, stored, np.ptp(segment.volume), abs(stored)))
    times = np.array([segment.time[-1] - segment.time[0] for segment in segments])
    imbalance, mean_pressure, stored, breathed, doubt = np.array(rows).T / times
    columns = np.stack([mean_pressure, np.ones(len(rows)), stored, breathed], axis=1)
    deviations = np.array([np.inf, ZERO, _STORED_ERROR, _CALIBRATION_ERROR])
    conductance, sd = _first_coefficient(imbalance, _STORED_ERROR * doubt, columns, deviations)
    if conductance <= 0.0:
        return tuple(segments), None
    nats = 0.5 * (conductance / sd) ** 2
    reach = t_quantile(breaths - 1) * sd
    ends, each = np.array([conductance - reach, conductance + reach]), np.median(mean_pressure)
    parameters = {
        name: Estimate(size * conductance, unit, tuple((size * ends).tolist()))
        for name, unit, size in (
            ("conductance", "mL/s per cmH2O", 1000.0),
            ("zero", "mL/s", 1000.0 * float(each)),
        )
    }
    named = nats > LEAST_NATS
    # Too little to be named is taken out by its probability, so that no other term makes up for it.
    taken = conductance if named else conductance * float(expit(nats - LEAST_NATS))
    lost = np.concatenate([conductance * (s.dose - s.dose.mean()) for s in segments])
    effect = float(elastance * np.sqrt(np.mean(lost**2)))
    corrected = tuple(
        replace(
            segment,
            flow=segment.flow - taken * pressure,
            slope=segment.slope - taken * np.gradient(pressure, segment.time),
            volume=segment.volume - taken * (segment.dose - segment.dose[0]),
        )
        for segment, pressure in zip(segments, pressures, strict=True)
    )
    term = Term("leak", parameters, nats, effect, ("flow_sensor_zero",))
    return corrected, term if named else None


def _first_coefficient(
    values: Floats, errors: Floats, columns: Floats, deviations: Floats
) -> tuple[float, float]:
    """First coefficient of a regression with errors of Student's t, and its standard deviation.

    Args:
        values: ``(n,)``.
        errors: standard deviations of what each value has beside the scatter of all, ``(n,)``.
        columns: ``(n, k)``.
        deviations: prior standard deviations of the coefficients around zero, ``(k,)``.
    """
    residual = values - np.median(values)
    for _ in range(_STEPS):
        scatter = max(1.4826 * float(np.median(np.abs(residual))), _LEAST_SCATTER)
        variance = scatter**2 + errors**2
        weight = (_TAILS + 1.0) / (_TAILS * variance + residual**2)
        covariance = np.linalg.inv((columns.T * weight) @ columns + np.diag(deviations**-2.0))
        coefficients = covariance @ (columns.T @ (weight * values))
        residual = values - columns @ coefficients
    return float(coefficients[0]), float(np.sqrt(covariance[0, 0]))
