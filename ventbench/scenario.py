"""Cells of a score: the pressures asked for, and the deviations of the ventilator from nominal."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ventbench import protocol


@flax.struct.dataclass
class Scenario:
    """A batch of cells; every field has the batch shape ``(...)``, ``noise`` two axes more.

    Attributes:
        pip: peak inspiratory pressure, cmH2O.
        peep: positive end-expiratory pressure, cmH2O.
        start: pressure at which each inspiration starts, cmH2O.
        dt: true control step, s.
        r_scale: true over nominal resistance.
        c_scale: true over nominal compliance.
        delay: additional dead time of the command, as a share of one step, 0..1.
        quantum: step of the pressure sensor's converter, cmH2O; 0 for none.
        noise: noise that is added to the measured pressure before the converter, cmH2O, shape
            ``(..., BREATHS, INSPIRATION_STEPS)``.
    """

    pip: Array
    peep: Array
    start: Array
    dt: Array
    r_scale: Array
    c_scale: Array
    delay: Array
    quantum: Array
    noise: Array


def nominal(pip: ArrayLike, peep: ArrayLike = protocol.PEEP) -> Scenario:
    """Cells without noise or deviation.

    Args:
        pip: peak inspiratory pressure, cmH2O, any shape.
        peep: positive end-expiratory pressure, cmH2O, broadcast against ``pip``.

    Raises:
        ValueError: if a PIP does not exceed its PEEP.
    """
    pip, peep = np.broadcast_arrays(np.asarray(pip, float), np.asarray(peep, float))
    if not np.all(pip > peep):
        raise ValueError(f"PIP {pip} cmH2O must exceed PEEP {peep} cmH2O")
    ones, zeros = np.ones(pip.shape), np.zeros(pip.shape)
    noise = np.zeros((*pip.shape, protocol.BREATHS, protocol.INSPIRATION_STEPS))
    arrays = (pip, peep, peep, protocol.DT * ones, ones, ones, zeros, zeros, noise)
    return Scenario(*(jnp.asarray(array) for array in arrays))
