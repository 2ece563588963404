"""Train the networks by proximal policy optimisation, and write ``weights.npz``.

    python submissions/ppo/train.py --seeds 5         # seven networks, as the entry has them
    python submissions/ppo/train.py --lung R20C50     # one lung

Commands are sampled from a Gaussian around the network's output. Ctrl-C keeps the finished work;
the same command continues.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax import Array

from ventbench.controllers import residual
from ventbench.controllers.residual import SCALE, GaussianPolicy, TanhNetwork
from ventbench.train.rl import environment
from ventbench.train.rl.train import Recipe, State, command


@flax.struct.dataclass
class PPOBatch:
    """Steps of breaths; ``features`` ``(N, features)``, all others ``(N,)``."""

    features: Array
    action: Array
    log_probability: Array
    advantage: Array
    value: Array


def log_probability(action: Array, mean: Array, log_spread: Array) -> Array:
    """Logarithm of a Gaussian density, up to a constant."""
    return -0.5 * ((action - mean) / jnp.exp(log_spread)) ** 2 - log_spread


def clipped_loss(ratio: Array, advantage: Array, clip: float) -> Array:
    """PPO's loss of each step: no gain from going further than ``clip`` from the old policy."""
    limited = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return -jnp.minimum(ratio * advantage, limited * advantage)


@dataclass(frozen=True)
class PPO:
    """Settings of PPO; one iteration is one batch of breaths, used ``epochs`` times."""

    breaths: int = 96  #: breaths of an iteration, three an episode.
    iterations: int = 600  #: iterations of a training, over which the learning rate falls to zero.
    learning_rate: float = 1e-3  #: initial learning rate of Adam.
    widths: tuple[int, ...] = (32, 32)  #: hidden layers of both networks.
    epochs: int = 6  #: passes over a batch.
    minibatches: int = 4  #: minibatches of a pass.
    discount: float = 0.95  #: factor of a reward one step later.
    trace: float = 0.9  #: lambda of the generalised advantage estimates.
    clip: float = 0.2  #: limit of the change of the ratio of probabilities.
    spread: float = 0.3  #: initial standard deviation of the policy, in units of ``SCALE``.

    @property
    def network(self) -> TanhNetwork:
        """Network of the policy's mean."""
        return TanhNetwork(self.widths, 1)

    @property
    def _critic(self) -> TanhNetwork:
        return TanhNetwork(self.widths, 1, first=1.0)

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        updates = self.iterations * self.epochs * self.minibatches
        schedule = optax.linear_schedule(self.learning_rate, 0.0, updates)
        return optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule, eps=1e-5))

    def init(self, key: Array) -> State:
        """Return the state at the start of a training."""
        actor_key, critic_key, key = jax.random.split(key, 3)
        parameters = {
            "actor": residual.init_parameters(self.network, actor_key),
            "critic": residual.init_parameters(self._critic, critic_key),
            "log_spread": jnp.log(jnp.asarray(self.spread)),
        }
        return State(parameters, self._optimiser.init(parameters), key, jnp.zeros((), jnp.int32))

    def iterate(self, state: State, plants: environment.Lungs) -> State:
        """Collect breaths on lungs and learn from them."""
        collect_key, learn_key, key = jax.random.split(state.key, 3)
        batch = self._collect(state, plants, collect_key)

        def epoch(carry: Any, key: Array) -> tuple[Any, None]:
            order = jax.random.permutation(key, batch.action.size)
            parts = jax.tree.map(
                lambda x: x[order].reshape(self.minibatches, -1, *x.shape[1:]), batch
            )
            return jax.lax.scan(self._update, carry, parts)

        keys = jax.random.split(learn_key, self.epochs)
        (parameters, optimiser), _ = jax.lax.scan(epoch, (state.parameters, state.optimiser), keys)
        return State(parameters, optimiser, key, state.iteration + 1)

    def policy(self, state: State) -> GaussianPolicy:
        """The learned policy: its mean."""
        return GaussianPolicy(state.parameters["actor"], self.network)

    def _mean(self, parameters: Any, x: Array) -> Array:
        return self.network.apply(parameters["actor"], x)[..., 0]  # type: ignore[index]

    def _value(self, parameters: Any, x: Array) -> Array:
        return self._critic.apply(parameters["critic"], x)[..., 0]  # type: ignore[index]

    def _collect(self, state: State, plants: environment.Lungs, key: Array) -> PPOBatch:
        parameters = state.parameters
        cells_key, roll_key = jax.random.split(key)
        episodes = environment.of_iteration(cells_key, plants, self.breaths, state.iteration)

        def act(key: Array, x: Array, base: Array) -> tuple[Array, tuple[Array, Array]]:
            mean = self._mean(parameters, x)
            log_spread = parameters["log_spread"]
            action = mean + jnp.exp(log_spread) * jax.random.normal(key, mean.shape)
            return base + SCALE * action, (action, log_probability(action, mean, log_spread))

        x, (action, before), rewards = environment.roll(episodes, act, roll_key)
        value = self._value(parameters, x)
        advantage = environment.advantages(rewards, value, self.discount, self.trace)
        batch = PPOBatch(x, action, before, advantage, value)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)

    def _update(self, carry: Any, part: PPOBatch) -> tuple[Any, None]:
        parameters, optimiser = carry
        gradient = jax.grad(self._loss)(parameters, part)
        updates, optimiser = self._optimiser.update(gradient, optimiser, parameters)
        return (optax.apply_updates(parameters, updates), optimiser), None

    def _loss(self, parameters: Any, part: PPOBatch) -> Array:
        log_spread = parameters["log_spread"]
        now = log_probability(part.action, self._mean(parameters, part.features), log_spread)
        advantage = part.advantage - jnp.mean(part.advantage)
        advantage = advantage / (jnp.std(advantage) + 1e-6)
        ratio = jnp.exp(now - part.log_probability)
        policy = jnp.mean(clipped_loss(ratio, advantage, self.clip))
        returns = part.value + part.advantage
        critic = jnp.mean((self._value(parameters, part.features) - returns) ** 2)
        return policy + 0.5 * critic


RECIPE = Recipe("ppo", PPO(), PPO(breaths=288, iterations=1200, widths=(64, 64)), chunk=10)

if __name__ == "__main__":
    command(RECIPE, "Train networks that correct the PID, by proximal policy optimisation.")
