"""The fixed commands of the expiratory phase (paper, section 4.3; authors' code)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench import protocol

#: Bias flow that holds PEEP late in expiration, %, and its rate of rise, 1/s.
BIAS = 5.0
RATE = 5.0


def u_in(step: ArrayLike) -> NDArray[np.float64]:
    """Inspiratory valve during expiration, %; the expiratory valve is open throughout.

    Args:
        step: step of the breath, at least :data:`~ventbench.protocol.INSPIRATION_STEPS`; any shape.

    Returns:
        0 until 1.5 s, then ``5 (1 - exp(5 (1.5 s - t)))``.
    """
    t = np.mod(np.asarray(step), protocol.BREATH_STEPS) * protocol.DT
    return BIAS * (1.0 - np.exp(RATE * np.minimum(protocol.FALL_END - t, 0.0)))
