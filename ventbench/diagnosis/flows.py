"""Flow and volume of a refitted simulator, for pictures and places."""

from __future__ import annotations

import numpy as np

from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Fit
from ventbench.system_id.data import Floats


def of_fit(breaths: Breaths, fit: Fit, pressure: Floats) -> tuple[Floats, Floats]:
    """Flow into the lung, mL/s, and volume above the first sample's, mL, both ``(n, T)``.

    What the valve of the base model gives, less what leaves through the expiratory valve at the
    simulated pressure. Each sample has what flowed just before it.

    Args:
        breaths: n breaths.
        fit: gives gain, expiratory resistance and PEEP.
        pressure: simulated, cmH2O, ``(n, T)``.
    """
    gain, out, peep = (float(np.median(fit.column(name))) for name in ("gain", "R_ex", "PEEP"))
    flow = np.zeros_like(pressure)
    vented = np.maximum(pressure[:, 1:] - peep, 0.0) / out * 1e3
    flow[:, 1:] = gain * breaths.u_in[:, :-1] - np.where(breaths.u_out[:, :-1] == 1, vented, 0.0)
    volume = np.zeros_like(flow)
    volume[:, 1:] = np.cumsum(np.nan_to_num(flow[:, 1:]) * breaths.dt[:, :-1], axis=1)
    return flow, volume
