"""One frozen simulator against a file of commands."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import precision, protocol
from ventbench.controls import Controls
from ventbench.plants.base import Plant
from ventbench.rollout import open_loop


def simulate(
    plant: Plant, controls: Controls, *, start: float = protocol.PEEP
) -> NDArray[np.float64]:
    """Pressures that a plant answers to commands with.

    Args:
        plant: any plant.
        controls: T commands.
        start: pressure at the first sample, cmH2O; the lung is at rest there.

    Returns:
        Pressure at each sample, cmH2O, shape ``(T,)``.
    """
    with precision.float64():
        commands = (jnp.asarray(x)[None] for x in (controls.u_in, controls.u_out, controls.dt))
        return np.asarray(open_loop(plant, jnp.asarray([float(start)]), *commands))[0]
