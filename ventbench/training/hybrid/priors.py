"""What is believed before any recording: Gaussian widths around where the fit starts."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.training.hybrid.parameters import Pooled, direction, initial

#: Standard deviation of each field around its start; fields not named are free.
WIDTHS = {
    "slopes_rig": 0.2,
    "stiffening": 0.3,
    "offset": 1.0,
    "valve_delay": 1.0,
    "valve_lag": 1.0,
    "sensor_lag": 1.0,
    "closing_delay": 1.0,
    "opening_delay": 1.0,
    "circuit_compliance": 0.7,
    "conductance": 1.0,
    "closing_conductance": 1.0,
    "session_gain": 0.3,
    "session_R": 0.5,
    "session_K2": 0.5,
    "session_E": 0.4,
    "session_offset": 0.5,
    "session_conductance": 0.3,
    "session_closing_conductance": 0.3,
}

#: Likewise between neighbouring slopes of the valve's curve, and of what a rig adds to them.
SMOOTHNESS, SMOOTHNESS_RIG = 0.5, 0.15

#: Likewise of the plays' weights, and of the effects on the reading, cmH2O, around zero.
DIRECTION, READING = 0.2, 0.5


def penalty(pooled: Pooled) -> Array:
    """Negative logarithm of the prior, up to a constant."""
    start = initial()
    squares = [
        jnp.sum(((getattr(pooled, name) - getattr(start, name)) / width) ** 2)
        for name, width in WIDTHS.items()
    ]
    squares += [
        jnp.sum((jnp.diff(pooled.slopes) / SMOOTHNESS) ** 2),
        jnp.sum((jnp.diff(pooled.slopes_rig, axis=-1) / SMOOTHNESS_RIG) ** 2),
        jnp.sum((direction(pooled) / DIRECTION) ** 2),
        jnp.sum((jnp.exp(pooled.rising) / READING) ** 2),
        jnp.sum((jnp.exp(pooled.falling) / READING) ** 2),
    ]
    return 0.5 * sum(squares, start=jnp.zeros(()))
