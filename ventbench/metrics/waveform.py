"""The score: mean absolute error of the pressure over scored inspirations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench import protocol


def run_error(pressure: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """Error of one run of three breaths: mean of ``|p - p*|`` over scored inspiratory steps.

    Args:
        pressure: true airway pressure at each inspiratory step, cmH2O, shape
            ``(..., BREATHS, INSPIRATION_STEPS)``.
        target: target pressure, cmH2O, broadcast against ``pressure``.

    Returns:
        Mean over breaths 2 and 3, cmH2O, shape ``(...)``; NaN if a scored pressure is NaN.

    Raises:
        ValueError: if the last two axes are not those of a run.
    """
    pressure = np.asarray(pressure, float)
    expected = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    if pressure.shape[-2:] != expected:
        raise ValueError(f"inspirations of shape {pressure.shape} do not end in {expected}")
    error = np.abs(pressure - np.asarray(target, float))
    return np.mean(error[..., protocol.SCORED_BREATHS, :], axis=(-2, -1))


def lung_score(errors: ArrayLike) -> NDArray[np.float64]:
    """Score on each lung: mean of :func:`run_error` over PIPs.

    Args:
        errors: cmH2O, shape ``(..., P)``.

    Returns:
        cmH2O, shape ``(...)``; NaN if one of the errors is.
    """
    return np.mean(np.asarray(errors, float), axis=-1)
