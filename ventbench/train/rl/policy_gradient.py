"""Policy gradient through the simulator: the error of whole breaths, differentiated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax import Array

from ventbench.controllers import rl_policy
from ventbench.controllers.rl_policy import SCALE, GaussianPolicy, Parameters, TanhNetwork
from ventbench.task import protocol
from ventbench.train.rl import episodes


@flax.struct.dataclass
class PolicyGradientState:
    """One training: parameters, the optimiser's state, key, number of the iteration."""

    parameters: Parameters
    optimiser: Any
    key: Array
    iteration: Array


@dataclass(frozen=True)
class PolicyGradient:
    """Settings; one iteration is one update."""

    breaths: int = 6  #: breaths of an update, three an episode, PIPs in turn.
    iterations: int = 1600  #: iterations of a training, over which the learning rate falls to zero.
    learning_rate: float = 3e-3  #: initial learning rate of Adam.
    vary: bool = True  #: draw cells with noise and deviations; false for nominal ones.
    widths: tuple[int, ...] = (32, 32)  #: hidden layers of the network.

    @property
    def network(self) -> TanhNetwork:
        """One output."""
        return TanhNetwork(self.widths, 1)

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        schedule = optax.cosine_decay_schedule(self.learning_rate, self.iterations)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    def init(self, key: Array) -> PolicyGradientState:
        """Return the state at the start of a training."""
        network_key, key = jax.random.split(key)
        parameters = rl_policy.init_parameters(self.network, network_key)
        return PolicyGradientState(
            parameters, self._optimiser.init(parameters), key, jnp.zeros((), jnp.int32)
        )

    def iterate(self, state: PolicyGradientState, plants: episodes.Lungs) -> PolicyGradientState:
        """One update on lungs."""
        cells_key, roll_key, key = jax.random.split(state.key, 3)
        count = self.breaths // protocol.BREATHS
        first = state.iteration * max(count // plants.count, 1)
        drawn = episodes.draw(cells_key, plants, count, first, self.vary)

        def loss(parameters: Parameters) -> Array:
            def act(key: Array, x: Array, base: Array) -> tuple[Array, None]:
                mean: Array = self.network.apply(parameters, x)  # type: ignore[assignment]
                return base + SCALE * mean[..., 0], None

            return -jnp.mean(episodes.roll(drawn, act, roll_key)[2])

        gradient = jax.grad(loss)(state.parameters)
        updates, optimiser = self._optimiser.update(gradient, state.optimiser, state.parameters)
        parameters = optax.apply_updates(state.parameters, updates)
        return PolicyGradientState(parameters, optimiser, key, state.iteration + 1)

    def policy(self, state: PolicyGradientState) -> GaussianPolicy:
        """The learned policy."""
        return GaussianPolicy(state.parameters, self.network)
