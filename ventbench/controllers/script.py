"""Commands written down beforehand: replays a run, whichever controller made it."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench.task.interfaces import Observation


@flax.struct.dataclass
class Script:
    """A controller that ignores what it observes.

    Attributes:
        u_in: commands of a run in order, %, shape ``(BREATHS * INSPIRATION_STEPS,)`` or
            ``(..., BREATHS * INSPIRATION_STEPS)`` for different ones in each cell of a batch.
    """

    u_in: Array

    def init(self, shape: tuple[int, ...]) -> Array:
        """Return the index of the first command."""
        return jnp.zeros((), int)

    def step(self, state: Array, observation: Observation) -> tuple[Array, Array]:
        """Return the index of the next command, and the present command, %, shape ``(...)``."""
        command = jnp.take(self.u_in, state, axis=-1)
        return state + 1, jnp.broadcast_to(command, jnp.shape(observation.pressure))
