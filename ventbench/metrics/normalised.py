"""The normalised score of protocol version 2: how much of what is attainable a controller misses.

0 is the best that any commands attain in a cell, everything known; 100 is the best PID of the lung
in that cell. The first step of an inspiration is left out: no command can change its pressure.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench import protocol

#: Least distance between the best PID and the best attainable, cmH2O, by which errors are divided:
#: about one step of the sensor's converter (0.07) and half of its noise (0.20 to 0.25). Where the
#: PID is closer than that, a cell tells controllers apart no better.
LEAST_HEADROOM = 0.1

Floats = NDArray[np.float64]


def controllable_error(pressure: ArrayLike, target: ArrayLike) -> Floats:
    """Error of one run without the first step of each inspiration.

    Args:
        pressure: airway pressure at each inspiratory step, cmH2O, shape
            ``(..., BREATHS, INSPIRATION_STEPS)``.
        target: target pressure, cmH2O, broadcast against ``pressure``.

    Returns:
        Mean of ``|p - p*|`` over steps 2 to 34 of breaths 2 and 3, cmH2O, shape ``(...)``.
    """
    error = np.abs(np.asarray(pressure, float) - np.asarray(target, float))
    return np.mean(error[..., protocol.SCORED_BREATHS, 1:], axis=(-2, -1))


def normalised(error: ArrayLike, attainable: ArrayLike, pid: ArrayLike) -> Floats:
    """Normalised score of cells.

    Args:
        error: :func:`controllable_error` of the controller, cmH2O, shape ``(...)``.
        attainable: least error of any commands, cmH2O, shape ``(...)``.
        pid: error of the lung's best PID, cmH2O, shape ``(...)``.

    Returns:
        ``100 (error - attainable) / max(pid - attainable, LEAST_HEADROOM)``, shape ``(...)``; NaN
        where the error is.
    """
    error, attainable, pid = (np.asarray(x, float) for x in (error, attainable, pid))
    result: Any = 100.0 * (error - attainable) / np.maximum(pid - attainable, LEAST_HEADROOM)
    return result
