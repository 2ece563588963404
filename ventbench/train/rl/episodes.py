"""Episodes of reinforcement learning: breaths of many cells in one scan, and their returns.

An episode is the three breaths of a run, since features look back at the breath before; returns
end with the breath.

In the functions of returns, time runs along the leading axis, and no reward comes after the last.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.controllers import rl_policy
from ventbench.task import environment as env
from ventbench.task import protocol, rollouts
from ventbench.task.draws import random_scenarios
from ventbench.task.environment import Scenario

#: Commands of an episode; the last command of a breath moves no pressure that is scored.
STEPS = protocol.INSPIRATION_STEPS - 1

#: Error that costs a reward of 1, cmH2O.
REWARD_SCALE = 10.0

#: Takes a key, features ``(E, FEATURES)`` and the PID's command, %, ``(E,)``; returns ``u_in``, %,
#: and whatever else of the step :func:`roll` shall return.
Act = Callable[[Array, Array, Array], tuple[Array, Any]]


@flax.struct.dataclass
class Lungs:
    """Lungs to learn on; see :class:`ventbench.train.plants.TrainingPlants`."""

    plants: Any  #: K plants of each of L lungs, the nominal one first, leaves ``(K, L, ...)``.
    weights: Array  #: of the error of each lung at each PIP, ``(L, P)``.

    @property
    def nominal(self) -> Any:
        """The nominal plants, leaves ``(L, ...)``."""
        return jax.tree.map(lambda leaf: leaf[0], self.plants)

    @property
    def count(self) -> int:
        """Number of lungs L."""
        return self.weights.shape[0]


@flax.struct.dataclass
class Episodes:
    """Cells to run, E of them, each with its plant."""

    plants: Any  #: leaves ``(E, ...)``.
    cells: Scenario  #: E cells.
    weight: Array  #: of the errors in each, ``(E,)``.


def draw(
    key: Array, lungs: Lungs, count: int, first: Array | int = 0, vary: bool = True
) -> Episodes:
    """Draw episodes: the lungs in turn, on any of their plants, with new deviations.

    Args:
        key: key of the random numbers.
        lungs: lungs to learn on.
        count: number of episodes E.
        first: which of the six PIPs comes first.
        vary: false for nominal cells on nominal plants.
    """
    number = lungs.count
    lung = jnp.arange(count) % number
    which = jax.tree.leaves(lungs.plants)[0].shape[0]
    plant_key = jax.random.fold_in(key, 1)
    plant = jax.random.randint(plant_key, (count,), 0, which) * vary
    plants = jax.tree.map(lambda leaf: jnp.asarray(leaf)[plant, lung], lungs.plants)
    pip = (first + jnp.arange(count) // number) % len(protocol.PIPS)
    wanted = jnp.asarray(protocol.PIPS, jnp.result_type(float))[pip]
    cells = random_scenarios(key, wanted, spread=None if vary else 0.0)
    return Episodes(plants, cells, lungs.weights[lung, pip])


def of_iteration(key: Array, lungs: Lungs, breaths: int, iteration: Array) -> Episodes:
    """Draw the episodes of an iteration, three breaths each; the PIPs come in turn."""
    count = breaths // protocol.BREATHS
    return draw(key, lungs, count, iteration * max(count // lungs.count, 1))


def roll(episodes: Episodes, act: Act, key: Array) -> tuple[Array, Any, Array]:
    """Run episodes.

    Args:
        episodes: E of them.
        act: see :data:`Act`; asked :data:`STEPS` times a breath.
        key: split for the steps.

    Returns:
        Of each of the B breaths of all episodes: features before each command, shape
        ``(STEPS, B, features)``; what ``act`` kept; rewards, minus the weighted error after each
        command over ``REWARD_SCALE``, shape ``(STEPS, B)``.
    """
    cells, weight = episodes.cells, episodes.weight
    memory = rl_policy.init_features(cells.pip.shape)

    def policy(state: Any, seen: Any, key: Array) -> tuple[Any, Array]:
        memory, x, base = rl_policy.features(state[0], seen)
        asked, kept = act(key, x, base)
        return (memory, (x, kept)), asked

    def run(memory: Any, now: tuple[Array, Array]) -> tuple[Any, Any]:
        breath, keys = now
        varied = env.vary(episodes.plants, cells, breath)

        def step(carry: Any, now: tuple[Array, Array]) -> tuple[Any, tuple[Array, Any, Array]]:
            loop, memory = carry
            (loop, (memory, (x, kept))), pressure = rollouts.control_step(
                varied, cells, policy, lambda _, after, *__: after.signals.scored,
                (loop, (memory, None)), (breath, *now),
            )  # fmt: skip
            reward = -weight * jnp.abs(pressure - cells.pip) / REWARD_SCALE
            return (loop, memory), (x, kept, reward)

        start = env.start_breath(varied, cells)
        (loop, memory), out = jax.lax.scan(step, (start, memory), (jnp.arange(STEPS), keys))
        # The last observation is remembered too.
        memory, _, _ = rl_policy.features(memory, env.observe(cells, loop, breath, STEPS))
        return memory, out

    keys = jax.random.split(key, (protocol.BREATHS, STEPS))
    breaths = jnp.arange(protocol.BREATHS)
    _, out = jax.lax.scan(run, memory, (breaths, keys))
    # (breath, step, episode, ...) -> (step, breath and episode, ...)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(STEPS, -1, *x.shape[3:]), out)


@jax.jit
def errors(episodes: Episodes, controller: Any) -> Array:
    """Mean weighted ``|pressure - PIP|`` of each episode, cmH2O, shape ``(E,)``.

    The breaths that are scored count.

    Args:
        episodes: E of them.
        controller: pure controller.
    """
    run, _ = rollouts.closed_loop(episodes.plants, controller, episodes.cells)
    error = jnp.abs(run.pressure - episodes.cells.pip[..., None, None])
    return error[..., protocol.SCORED_BREATHS, :].mean(axis=(-2, -1)) * episodes.weight


def discounted(rewards: Array, discount: float) -> Array:
    """Sum of the rewards from each step on, discounted; shape of ``rewards``, ``(T, ...)``."""

    def back(after: Array, reward: Array) -> tuple[Array, Array]:
        total = reward + discount * after
        return total, total

    _, out = jax.lax.scan(back, jnp.zeros_like(rewards[0]), rewards, reverse=True)
    return out


def advantages(rewards: Array, values: Array, discount: float, trace: float) -> Array:
    """Generalised advantage estimates of an episode that ends after its last reward.

    Args:
        rewards: rewards after each command, shape ``(T, ...)``.
        values: estimated before each command, shape ``(T, ...)``.
        discount: factor of a reward one step later.
        trace: lambda, 0 for one-step differences, 1 for returns minus values.

    Returns:
        Shape ``(T, ...)``.
    """
    following = jnp.concatenate([values[1:], jnp.zeros_like(values[:1])])
    return discounted(rewards + discount * following - values, discount * trace)


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
