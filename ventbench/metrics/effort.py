"""Effort: the commands that a controller gives to the inspiratory valve."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ventbench import protocol


def mean_command(u_in: ArrayLike) -> NDArray[np.float64]:
    """Mean of the applied command over an inspiration, %.

    Args:
        u_in: as applied, %, shape ``(..., T)``.

    Returns:
        Shape ``(...)``; NaN if a command is.
    """
    return np.mean(np.asarray(u_in, float), axis=-1)


def mean_change(u_in: ArrayLike) -> NDArray[np.float64]:
    """Wear of the valve: mean over steps of ``|u_t - u_(t-1)|``, % a step.

    The valve is closed before the first command, so that ``u_(-1) = 0``.

    Args:
        u_in: as applied, %, shape ``(..., T)``.

    Returns:
        Shape ``(...)``; NaN if a command is.
    """
    return np.mean(np.abs(np.diff(np.asarray(u_in, float), axis=-1, prepend=0.0)), axis=-1)


def clipped_share(requested: ArrayLike) -> NDArray[np.float64]:
    """Share of commands outside the valve's range of 0 to 100 %, which were clipped, 0..1.

    Args:
        requested: what the controller asked for, %, shape ``(..., T)``.

    Returns:
        Shape ``(...)``; NaN if a command is.
    """
    requested = np.asarray(requested, float)
    outside = (requested < 0.0) | (requested > protocol.U_MAX)
    return np.where(np.any(np.isnan(requested), axis=-1), np.nan, np.mean(outside, axis=-1))
