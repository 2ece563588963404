"""Fixed parts of a breath in the protocol: target waveform and commands of the expiration.

Both follow from the integer step of the breath, never from accumulated time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats
from ventbench.task import protocol

#: Bias flow that holds PEEP late in expiration, %, and its rate of rise, 1/s (paper, section 4.3;
#: authors' code).
EXPIRATORY_BIAS = 5.0
EXPIRATORY_RATE = 5.0


def shape(step: ArrayLike) -> Floats:
    """Height of the target above PEEP as a share of PIP - PEEP, at steps of any shape.

    It is 1 for the plateau, linear to 0 between 1.0 s and 1.5 s, then 0. Steps count on through
    following breaths.
    """
    t = np.mod(np.asarray(step), protocol.BREATH_STEPS) * protocol.DT
    fall = (protocol.FALL_END - t) / (protocol.FALL_END - protocol.FALL_START)
    # 1e-9: a step that lands on a key point (1.5 s = step 50) belongs to it despite rounding.
    return np.where(t < protocol.FALL_START - 1e-9, 1.0, np.clip(fall, 0.0, 1.0))


def target(step: ArrayLike, pip: ArrayLike, peep: ArrayLike = protocol.PEEP) -> Floats:
    """Target airway pressure, cmH2O, at steps of the breath; all arguments are broadcast."""
    pip, peep = np.asarray(pip, float), np.asarray(peep, float)
    return peep + (pip - peep) * shape(step)


def targets_ahead(step: int, pip: ArrayLike, peep: ArrayLike = protocol.PEEP) -> Floats:
    """The next ``TARGETS_AHEAD`` targets after ``step``, cmH2O; an axis more than ``pip`` has."""
    steps = step + 1 + np.arange(protocol.TARGETS_AHEAD)
    return target(steps, np.asarray(pip, float)[..., None], np.asarray(peep, float)[..., None])


def expiratory_command(step: ArrayLike) -> Floats:
    """Fixed command of the inspiratory valve during expiration, %, at steps of the breath.

    It is 0 until 1.5 s, then ``5 (1 - exp(5 (1.5 s - t)))``; the expiratory valve is open.
    """
    t = np.mod(np.asarray(step), protocol.BREATH_STEPS) * protocol.DT
    late = np.minimum(protocol.FALL_END - t, 0.0)
    return EXPIRATORY_BIAS * (1.0 - np.exp(EXPIRATORY_RATE * late))
