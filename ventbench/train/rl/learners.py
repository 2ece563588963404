"""Ways to learn a correction: through the simulator's derivatives, and PPO and DQN without them.

The policy gradient differentiates the error of whole breaths; proximal policy optimisation samples
commands from a Gaussian around the network's output; DQN learns values of discrete corrections from
a replay buffer by double Q-learning.
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
from ventbench.controllers.residual import (
    CHOICES,
    SCALE,
    GaussianPolicy,
    GreedyPolicy,
    Parameters,
    TanhNetwork,
)
from ventbench.train.rl import environment


@flax.struct.dataclass
class State:
    """One training: parameters, the optimiser's state, key, number of the iteration."""

    parameters: Any  #: of the network; for PPO of both networks and the spread, by name.
    optimiser: Any
    key: Array
    iteration: Array


@dataclass(frozen=True)
class PolicyGradient:
    """Settings of the policy gradient; one iteration is one update."""

    breaths: int = 6  #: breaths of an update, three an episode, PIPs in turn.
    iterations: int = 1600  #: iterations of a training, over which the learning rate falls to zero.
    learning_rate: float = 3e-3  #: initial learning rate of Adam.
    widths: tuple[int, ...] = (32, 32)  #: hidden layers of the network.

    @property
    def network(self) -> TanhNetwork:
        """One output."""
        return TanhNetwork(self.widths, 1)

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        schedule = optax.cosine_decay_schedule(self.learning_rate, self.iterations)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    def init(self, key: Array) -> State:
        """Return the state at the start of a training."""
        network_key, key = jax.random.split(key)
        parameters = residual.init_parameters(self.network, network_key)
        return State(parameters, self._optimiser.init(parameters), key, jnp.zeros((), jnp.int32))

    def iterate(self, state: State, plants: environment.Lungs) -> State:
        """One update on lungs."""
        cells_key, roll_key, key = jax.random.split(state.key, 3)
        episodes = environment.of_iteration(cells_key, plants, self.breaths, state.iteration)

        def loss(parameters: Parameters) -> Array:
            def act(key: Array, x: Array, base: Array) -> tuple[Array, None]:
                mean: Array = self.network.apply(parameters, x)  # type: ignore[assignment]
                return base + SCALE * mean[..., 0], None

            return -jnp.mean(environment.roll(episodes, act, roll_key)[2])

        gradient = jax.grad(loss)(state.parameters)
        updates, optimiser = self._optimiser.update(gradient, state.optimiser, state.parameters)
        parameters = optax.apply_updates(state.parameters, updates)
        return State(parameters, optimiser, key, state.iteration + 1)

    def policy(self, state: State) -> GaussianPolicy:
        """The learned policy."""
        return GaussianPolicy(state.parameters, self.network)


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
        target_values = environment.double_q_target(part.reward, part.discount, *after)

        def loss(parameters: Parameters) -> Array:
            values = self._values(parameters, part.features)
            chosen = jnp.take_along_axis(values, part.choice[:, None], axis=-1)[:, 0]
            return jnp.mean(optax.huber_loss(chosen, target_values))

        updates, optimiser = self._optimiser.update(jax.grad(loss)(online), optimiser, online)
        online = optax.apply_updates(online, updates)
        return online, optax.incremental_update(online, target, self.follow), optimiser
