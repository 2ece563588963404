"""Train the networks by deep Q-learning, and write ``weights.npz``.

    python submissions/dqn/train.py --seeds 5     # seven networks, as the entry has them
    python submissions/dqn/train.py --all         # one for all lungs, which is not told the lung

A network learns the values of 19 corrections of the PID from a replay buffer by double Q-learning.
Ctrl-C keeps the finished work; the same command continues.
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
from ventbench.controllers.residual import CHOICES, GreedyPolicy, Parameters, TanhNetwork
from ventbench.train.rl import environment
from ventbench.train.rl.train import Recipe, command


def double_q_target(reward: Array, discount: Array, online: Array, target: Array) -> Array:
    """Target of the value of a choice: the online network chooses, the target network evaluates.

    Args:
        reward: shape ``(...)``.
        discount: factor of what follows, 0 at the end of an episode, shape ``(...)``.
        online: values of the following choices, shape ``(..., choices)``.
        target: values by the target network, shape ``(..., choices)``.
    """
    choice = jnp.argmax(online, axis=-1, keepdims=True)
    return reward + discount * jnp.take_along_axis(target, choice, axis=-1)[..., 0]


@flax.struct.dataclass
class Replay:
    """Steps to learn from, the oldest overwritten first; N of them."""

    features: Array  #: features before the choice, ``(N, features)``.
    choice: Array  #: index into the corrections, ``(N,)``.
    reward: Array  #: the next reward, ``(N,)``.
    discount: Array  #: discount of what follows it; 0 where the breath ends, ``(N,)``.
    following: Array  #: features then, ``(N, features)``.


@flax.struct.dataclass
class DQNState:
    """One training: both networks, optimiser, replay, key, iteration."""

    online: Parameters
    target: Parameters
    optimiser: Any
    replay: Replay
    key: Array
    iteration: Array


@dataclass(frozen=True)
class DQN:
    """Settings; one iteration is some breaths into the replay, then some updates."""

    breaths: int = 24  #: breaths of an iteration, three an episode.
    iterations: int = 2400  #: iterations of a training, over which the learning rate falls to zero.
    learning_rate: float = 3e-3  #: initial learning rate of Adam.
    widths: tuple[int, ...] = (64, 64)  #: hidden layers of the network.
    updates: int = 8  #: updates of an iteration.
    batch: int = 256  #: steps of an update.
    memory: int = 2400  #: breaths that the replay holds.
    discount: float = 0.95  #: factor of a reward one step later.
    #: share by which the target network moves to the online network at each update.
    follow: float = 0.01
    #: share of random choices, at the start and at the end.
    explore: tuple[float, float] = (1.0, 0.05)
    explored: float = 0.4  #: share of the training after which exploration has reached its end.

    @property
    def network(self) -> TanhNetwork:
        """One output for each choice."""
        return TanhNetwork(self.widths, len(CHOICES), first=0.01)

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        schedule = optax.cosine_decay_schedule(self.learning_rate, self.iterations * self.updates)
        return optax.chain(optax.clip_by_global_norm(10.0), optax.adam(schedule))

    def init(self, key: Array) -> DQNState:
        """Return the state at the start of a training."""
        network_key, key = jax.random.split(key)
        parameters = residual.init_parameters(self.network, network_key)
        size = self.memory * environment.MOVES
        features, zero = jnp.zeros((size, residual.FEATURES)), jnp.zeros((size,))
        replay = Replay(features, jnp.zeros((size,), jnp.int32), zero, zero, features)
        iteration = jnp.zeros((), jnp.int32)
        optimiser = self._optimiser.init(parameters)
        return DQNState(parameters, parameters, optimiser, replay, key, iteration)

    def iterate(self, state: DQNState, plants: environment.Lungs) -> DQNState:
        """Collect breaths on lungs and learn from the replay."""
        collect_key, learn_key, key = jax.random.split(state.key, 3)
        new = self._collect(state, plants, collect_key)
        count = self.breaths * environment.MOVES
        first = state.iteration % (self.memory // self.breaths) * count
        replay = jax.tree.map(
            lambda old, some: jax.lax.dynamic_update_slice_in_dim(old, some, first, 0),
            state.replay,
            new,
        )
        filled = jnp.minimum((state.iteration + 1) * count, self.memory * environment.MOVES)

        def update(carry: Any, key: Array) -> tuple[Any, None]:
            rows = jax.random.randint(key, (self.batch,), 0, filled)
            return self._update(carry, jax.tree.map(lambda x: x[rows], replay)), None

        carry = (state.online, state.target, state.optimiser)
        keys = jax.random.split(learn_key, self.updates)
        (online, target, optimiser), _ = jax.lax.scan(update, carry, keys)
        return DQNState(online, target, optimiser, replay, key, state.iteration + 1)

    def policy(self, state: DQNState) -> GreedyPolicy:
        """Policy so far: the choices of the target network, the smoother of the two."""
        return GreedyPolicy(state.target, self.network)

    def _values(self, parameters: Any, x: Array) -> Array:
        return self.network.apply(parameters, x)  # type: ignore[return-value]

    def _collect(self, state: DQNState, plants: environment.Lungs, key: Array) -> Replay:
        cells_key, roll_key = jax.random.split(key)
        episodes = environment.of_iteration(cells_key, plants, self.breaths, state.iteration)
        start, end = self.explore
        progress = jnp.minimum(state.iteration / (self.explored * self.iterations), 1.0)
        share = start + (end - start) * progress

        def act(key: Array, x: Array, base: Array) -> tuple[Array, Array]:
            whether, which = jax.random.split(key)
            greedy = jnp.argmax(self._values(state.online, x), axis=-1)
            random = jax.random.randint(which, greedy.shape, 0, len(CHOICES))
            explore = jax.random.uniform(whether, greedy.shape) < share
            choice = jnp.where(explore, random, greedy)
            return base + jnp.asarray(CHOICES, base.dtype)[choice], choice

        x, choice, rewards = environment.roll(episodes, act, roll_key)
        following = jnp.arange(environment.MOVES) + 1
        discount = jnp.where(following < environment.MOVES, self.discount, 0.0)
        replay = Replay(
            x,
            choice.astype(jnp.int32),
            rewards,
            jnp.broadcast_to(discount[:, None], rewards.shape),
            x[jnp.minimum(following, environment.MOVES - 1)],
        )
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), replay)

    def _update(self, carry: Any, part: Replay) -> Any:
        online, target, optimiser = carry
        after = [self._values(p, part.following) for p in (online, target)]
        target_values = double_q_target(part.reward, part.discount, *after)

        def loss(parameters: Parameters) -> Array:
            values = self._values(parameters, part.features)
            chosen = jnp.take_along_axis(values, part.choice[:, None], axis=-1)[:, 0]
            return jnp.mean(optax.huber_loss(chosen, target_values))

        updates, optimiser = self._optimiser.update(jax.grad(loss)(online), optimiser, online)
        online = optax.apply_updates(online, updates)
        return online, optax.incremental_update(online, target, self.follow), optimiser


RECIPE = Recipe(
    "dqn", DQN(), DQN(breaths=72, iterations=4800, memory=7200, widths=(128, 128)), chunk=50
)

if __name__ == "__main__":
    command(RECIPE, "Train networks that choose among 19 corrections of the PID, by DQN.")
