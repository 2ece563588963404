"""Commands written down beforehand: replays a run, whoever the controller was."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench.interfaces import Observation


@flax.struct.dataclass
class Script:
    """A controller that looks at nothing.

    Attributes:
        u_in: commands of a run in order, %, shape ``(..., BREATHS * INSPIRATION_STEPS)``.
    """

    u_in: Array

    def init(self, shape: tuple[int, ...]) -> Array:
        """Return the index of the first command."""
        return jnp.zeros((), int)

    def step(self, state: Array, observation: Observation) -> tuple[Array, Array]:
        """Return the index of the next command, and this one."""
        return state + 1, jnp.take(self.u_in, state, axis=-1)
