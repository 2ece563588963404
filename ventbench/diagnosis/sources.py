"""What a source that moves in time would do to the recorded pressure, to first order."""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.solved import Side
from ventbench.system_id.data import Floats

#: Public names of the slots whose shape is a function of time, of each breath its own.
ALVEOLUS, SUPPLY, MEASUREMENT = "f(t) at the alveolus", "f(t) at the supply", "measurement"
SOURCES = (ALVEOLUS, SUPPLY, MEASUREMENT)

#: Not a place but a scatter: each breath has its own valve gain.
GAIN = "gain of each breath"


def responses(side: Side, values: Floats, source: str) -> Floats:
    """Pressures that answer to a unit source at one sample, ``(n, T, T)``: source, then pressure.

    Of a gain, ``(n, 1, T)``, to its logarithm.

    Resistance and compliance as fitted, all else left out: a source is drawn to about 10 %.

    Args:
        side: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
        source: pressure at the alveolus, cmH2O; flow of the inspiratory valve, as a share of it; or
            pressure at the sensor, cmH2O.
    """
    data, names = side.data, side.simulator.names
    n, samples = data.u_in.shape
    if source == GAIN:
        column = (side.simulator.names.index("gain"),)
        slopes = side.simulator.derivatives(values, column)[1][:, :, 0]
        return slopes * values[:, column[0], None, None]
    if source == MEASUREMENT:
        return np.broadcast_to(np.eye(samples), (n, samples, samples)).copy()
    R, C, out, gain = (values[:, names.index(name)] for name in ("R", "C", "R_ex", "gain"))
    C = C * 1e-3
    volume, found = np.zeros((n, samples)), np.zeros((n, samples, samples))
    for k in range(1, samples):
        vented = data.u_out[:, k - 1] > 0
        fading = np.where(vented, np.exp(-data.dt[:, k - 1] / ((R + out) * C)), 1.0)
        share = np.where(vented, out / (R + out), 1.0)
        volume = volume * fading[:, None]
        here = 0.0 * R
        if source == ALVEOLUS:
            here = here + 1.0
            volume[:, k] -= np.where(vented, (1.0 - fading) * C, 0.0)
        else:
            flow = gain * 1e-3 * data.u_in[:, k - 1]
            here = R * flow
            gained = np.where(vented, (1.0 - fading) * C * out, data.dt[:, k - 1])
            volume[:, k] += gained * flow
        found[:, :, k] = share[:, None] * volume / C[:, None]
        found[:, k, k] += share * here
    return found
