"""Returns and targets; time runs along the leading axis, and no reward comes after the last."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


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
        rewards: after each command, shape ``(T, ...)``.
        values: estimated before each command, likewise.
        discount: of a reward one step later.
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
    """What the value of a choice should be: the online network chooses, the target one judges.

    Args:
        reward: shape ``(...)``.
        discount: of what follows, 0 at the end of an episode, likewise.
        online: values of the following choices, shape ``(..., choices)``.
        target: likewise.
    """
    choice = jnp.argmax(online, axis=-1, keepdims=True)
    return reward + discount * jnp.take_along_axis(target, choice, axis=-1)[..., 0]
