"""Episodes of reinforcement learning: one breath each, many in one scan, and their returns.

In the functions of returns, time runs along the leading axis, and no reward comes after the last.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ventbench import environment as env
from ventbench import protocol
from ventbench.controllers import rl_policy
from ventbench.draws import random_scenarios
from ventbench.environment import Scenario
from ventbench.interfaces import Plant

#: Commands of an episode; the last command of a breath moves no pressure that is scored.
STEPS = protocol.INSPIRATION_STEPS - 1

#: Error that costs a reward of 1, cmH2O.
REWARD_SCALE = 10.0

#: Takes a key, features ``(E, FEATURES)`` and the PID's command, %, ``(E,)``; returns ``u_in``, %,
#: and whatever else of the step :func:`roll` shall return.
Act = Callable[[Array, Array, Array], tuple[Array, Any]]


def sample(
    key: Array, count: int, lungs: int = 1, first: Array | int = 0, vary: bool = True
) -> Scenario:
    """Draw cells of one breath each, with the deviations of the published draws.

    Args:
        key: key of the random numbers.
        count: number of cells E.
        lungs: cells of that many lungs in turn get the same nominal PIP.
        first: which of the six PIPs comes first.
        vary: false for nominal cells, without any deviation.
    """
    which = (first + jnp.arange(count) // lungs) % len(protocol.PIPS)
    pip = jnp.asarray(protocol.PIPS, jnp.result_type(float))[which]
    return random_scenarios(key, pip, spread=None if vary else 0.0, breaths=1)


def plants_of_cells(plants: Plant, count: int) -> Plant:
    """One plant for each of ``count`` cells, the lungs in turn: leaves ``(L, ...)`` repeated."""
    lungs = jax.tree.leaves(plants)[0].shape[0]
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[jnp.arange(count) % lungs], plants)


def roll(plants: Plant, cells: Scenario, act: Act, key: Array) -> tuple[Array, Any, Array]:
    """Run one breath in every cell.

    Args:
        plants: leaves ``(E, ...)``, as of :func:`plants_of_cells`.
        cells: E of them.
        act: see :data:`Act`; asked :data:`STEPS` times.
        key: split for the steps.

    Returns:
        Features before each command, shape ``(STEPS, E, FEATURES)``; what ``act`` kept; rewards,
        ``-|error| / REWARD_SCALE`` after each command, shape ``(STEPS, E)``.
    """
    varied = env.vary(plants, cells)

    def step(carry: Any, now: tuple[Array, Array]) -> tuple[Any, tuple[Array, Any, Array]]:
        loop, memory = carry
        index, key = now
        memory, x, base = rl_policy.features(memory, env.observe(cells, loop, 0, index))
        asked, kept = act(key, x, base)
        loop, _ = env.inspire(varied, cells, loop, asked)
        return (loop, memory), (x, kept, -jnp.abs(loop.pressure - cells.pip) / REWARD_SCALE)

    start = (env.start_breath(varied, cells), rl_policy.init_features(cells.pip.shape))
    _, out = jax.lax.scan(step, start, (jnp.arange(STEPS), jax.random.split(key, STEPS)))
    return out


@partial(jax.jit, static_argnames="count")
def errors(plants: Plant, controller: Any, cells: Scenario, count: int) -> Array:
    """Mean ``|pressure - PIP|`` of one inspiration in each cell, cmH2O, shape ``(count,)``.

    Args:
        plants: leaves ``(L, ...)``, the lungs of the cells in turn.
        controller: pure controller that starts anew at each breath.
        cells: ``count`` of them.
        count: number of cells.
    """
    varied = env.vary(plants_of_cells(plants, count), cells)

    def step(carry: Any, index: Array) -> tuple[Any, Array]:
        loop, state = carry
        state, asked = controller.step(state, env.observe(cells, loop, 0, index))
        after, _ = env.inspire(varied, cells, loop, asked)
        return (after, state), jnp.abs(loop.pressure - cells.pip)

    start = (env.start_breath(varied, cells), controller.init(cells.pip.shape))
    _, out = jax.lax.scan(step, start, jnp.arange(protocol.INSPIRATION_STEPS))
    return jnp.mean(out, axis=0)


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


def n_step(rewards: Array, discount: float, n: int) -> Array:
    """Discounted sum of the next ``n`` rewards, fewer at the end; shape of ``rewards``."""
    padded = jnp.concatenate([rewards, jnp.zeros_like(rewards[:1].repeat(n, axis=0))])
    return sum(
        (discount**k * padded[k : k + len(rewards)] for k in range(n)), jnp.zeros_like(rewards)
    )


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
