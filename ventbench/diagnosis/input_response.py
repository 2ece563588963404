"""Change of the pressure by inputs that vary in time and that no command explains."""

from __future__ import annotations

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.diagnosis.hypothesis import Partition
from ventbench.physics.events import HALF_SWING

#: Public names of the places where an input may act.
ALVEOLUS, SUPPLY, CIRCUIT = "f(t) at the alveolus", "f(t) at the supply", "f(t) in the circuit"


def input_responses(partition: Partition, values: Floats, place: str) -> Floats:
    """Change of the pressure by a unit input at one sample, cmH2O.

    Only resistance, compliance and the expiratory valve are modelled. Other mechanisms are left
    out, so that an input's course is right to about 10 %.

    Args:
        partition: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
        place: pressure at the alveolus, cmH2O; flow of the supply, as a share of it; or pressure
            in the circuit at a large flow, cmH2O.

    Returns:
        ``(n, T, T)``, input first.
    """
    data, names = partition.data, partition.predictor.names
    n, samples = data.u_in.shape
    R, C, R_ex, gain = (values[:, names.index(name)] for name in ("R", "C", "R_ex", "gain"))
    C = C * 1e-3
    volume, responses = np.zeros((n, samples)), np.zeros((n, samples, samples))
    if place == CIRCUIT:
        above = values[:, -1] - values[:, names.index("PEEP")]  # pressure in the lung
        for k in range(1, samples):
            expiratory, dt = data.u_out[:, k - 1] > 0, data.dt[:, k - 1]
            above = np.where(expiratory, above * np.exp(-dt / ((R + R_ex) * C)), above)
            inwards = gain * 1e-3 * data.u_in[:, k - 1]
            flow = np.abs(np.where(expiratory, above / (R + R_ex), inwards))
            above = np.where(expiratory, above, above + inwards * dt / C)
            responses[:, k, k] = flow / (flow + HALF_SWING)
        return responses
    for k in range(1, samples):
        expiratory = data.u_out[:, k - 1] > 0
        decay = np.where(expiratory, np.exp(-data.dt[:, k - 1] / ((R + R_ex) * C)), 1.0)
        share = np.where(expiratory, R_ex / (R + R_ex), 1.0)
        volume = volume * decay[:, None]
        direct = 0.0 * R
        if place == ALVEOLUS:
            direct = direct + 1.0
            volume[:, k] -= np.where(expiratory, (1.0 - decay) * C, 0.0)
        else:
            flow = gain * 1e-3 * data.u_in[:, k - 1]
            direct = R * flow
            filled = np.where(expiratory, (1.0 - decay) * C * R_ex, data.dt[:, k - 1])
            volume[:, k] += filled * flow
        responses[:, :, k] = share[:, None] * volume / C[:, None]
        responses[:, k, k] += share * direct
    return responses
