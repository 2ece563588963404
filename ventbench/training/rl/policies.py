"""What is learned, as pure controllers: the PID plus what a network makes of the features."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench.interfaces import Observation
from ventbench.training.rl import features
from ventbench.training.rl.networks import Dense, Parameters

#: Correction that an output of 1 stands for, %.
SCALE = 20.0

#: Corrections that DQN chooses from, %: fine about zero, coarse to the whole range of the valve.
CHOICES = (
    -90.0, -60.0, -40.0, -25.0, -15.0, -9.0, -5.0, -2.5, -1.0,
    0.0, 1.0, 2.5, 5.0, 9.0, 15.0, 25.0, 40.0, 60.0, 90.0,
)  # fmt: skip


@flax.struct.dataclass
class Corrected:
    """The PID plus the network's output, times :data:`SCALE`: the mean of a Gaussian policy.

    Attributes:
        parameters: of the network.
        network: one output.
    """

    parameters: Parameters
    network: Dense = flax.struct.field(pytree_node=False)

    def init(self, shape: tuple[int, ...]) -> features.Memory:
        """State at the start of a run."""
        return features.init(shape)

    def step(
        self, state: features.Memory, observation: Observation
    ) -> tuple[features.Memory, Array]:
        """Return the next state and ``u_in``, %."""
        state, x, base = features.see(state, observation)
        mean: Array = self.network.apply(self.parameters, x)  # type: ignore[assignment]
        return state, base + SCALE * mean[..., 0]


@flax.struct.dataclass
class Greedy:
    """The PID plus the choice of the highest value.

    Attributes:
        parameters: of the network.
        network: one output for each of :data:`CHOICES`.
    """

    parameters: Parameters
    network: Dense = flax.struct.field(pytree_node=False)

    def init(self, shape: tuple[int, ...]) -> features.Memory:
        """State at the start of a run."""
        return features.init(shape)

    def step(
        self, state: features.Memory, observation: Observation
    ) -> tuple[features.Memory, Array]:
        """Return the next state and ``u_in``, %."""
        state, x, base = features.see(state, observation)
        values: Array = self.network.apply(self.parameters, x)  # type: ignore[assignment]
        return state, base + jnp.asarray(CHOICES, base.dtype)[jnp.argmax(values, axis=-1)]
