"""Does pressure rise with the valve? The first thing to ask of a learned plant."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.interfaces import Plant


@flax.struct.dataclass
class ControlSensitivity:
    """Answers of :func:`control_sensitivity`.

    Attributes:
        derivative: of the next pressure with respect to the command now, cmH2O per %, shape
            ``(n, T - 1)``.
        inspiratory: where the expiratory valve is closed, same shape.
        falling: share of inspiratory steps at which pressure falls as the valve opens.
    """

    derivative: Array
    inspiratory: Array
    falling: Array


@jax.jit
def control_sensitivity(
    plant: Plant, start: Array, u_in: Array, u_out: Array, dt: Array
) -> ControlSensitivity:
    """Derivative of each next pressure with respect to its command, along open-loop runs.

    In closed-loop recordings ``u_in`` is a law of the measured pressure (high pressure, small
    command), so that a network may learn to read the pressure from the command; its derivative
    is then negative though no lung's is.

    Args:
        plant: any plant.
        start: first pressure, cmH2O, shape ``(n,)``.
        u_in: inspiratory valve, %, shape ``(n, T)``.
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``.
    """

    def step(state: Any, command: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        u, valve, interval = command
        # The state's tangents are unused, so that XLA drops them.
        (state, _), (_, slope) = jax.jvp(
            lambda u: plant.step(state, u, valve, interval), (u,), (jnp.ones_like(u),)
        )
        return state, slope

    commands = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), (u_in, u_out, dt))
    _, slopes = jax.lax.scan(step, plant.init(start), commands)
    slopes = jnp.moveaxis(slopes, 0, 1)
    inspiratory = u_out[:, :-1] < 0.5
    falling = jnp.sum(inspiratory & (slopes < 0)) / jnp.maximum(jnp.sum(inspiratory), 1)
    return ControlSensitivity(slopes, inspiratory, falling)
