"""Untrained learned plants."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from ventbench.plants.learned.architecture import Architecture, Normalisation
from ventbench.plants.learned.boundary import Boundary
from ventbench.plants.learned.plant import Learned
from ventbench.plants.mlp import layer_sizes, mlp


def learned(
    key: Array, architecture: Architecture, normalisation: Normalisation | None = None
) -> Learned:
    """Draw an untrained learned plant; :func:`ventbench.training.learned.fit` trains one.

    Args:
        key: a JAX key that is used for nothing else.
        architecture: its shape.
        normalisation: its constants; the recordings' typical ones if not given.

    Returns:
        The plant with float32 leaves.
    """
    shape, n = architecture, normalisation or Normalisation()
    inputs = shape.pressures + shape.controls
    general_key, hidden_key, output_key = jax.random.split(key, 3)
    general = mlp(
        general_key,
        layer_sizes(inputs, shape.width, shape.depth, 2),
        shape.activation,
        last_scale=0.1,
    )
    boundary = None
    if shape.boundaries:
        units = shape.boundaries * shape.boundary_width
        hidden = jax.random.normal(hidden_key, (inputs, units), jnp.float32)
        output = jax.random.normal(output_key, (units, 2), jnp.float32)
        boundary = Boundary(
            hidden * inputs**-0.5,
            jnp.zeros(units, jnp.float32),
            output * 0.1 * shape.boundary_width**-0.5,
            jnp.zeros((shape.boundaries, 2), jnp.float32),
        )
    constants = (
        n.pressure_mean,
        n.pressure_scale,
        n.control_mean,
        n.control_scale,
        n.jump_scale,
        n.rate_scale,
        n.tau,
        1.0,
        1.0,
    )
    return Learned(
        general,
        boundary,
        *(jnp.asarray(x, jnp.float32) for x in constants),
        windows=(shape.pressures, shape.controls),
    )
