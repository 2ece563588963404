"""How a sample is cut into substeps, and what delayed commands are during each of them."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array

from ventbench.plants.delay import shares

#: Substeps of a sample of about 30 ms, and samples that a dead time may reach back over.
SUBSTEPS, MEMORY = 5, 6

#: Longest dead time that must be remembered, and longest substep, s.
LONGEST_DEAD_TIME, LONGEST_SUBSTEP = 0.15, 0.007

#: Length of the substep before a sample, s.
LAST_SUBSTEP = 0.001


def resolution(dt: float) -> tuple[int, int]:
    """Substeps and memory that samples of ``dt`` seconds need."""
    return max(4, round(dt / LONGEST_SUBSTEP + 0.4)), math.ceil(LONGEST_DEAD_TIME / dt) + 1


def lengths(dt: Array, past: Array, late: tuple[Array | float, ...], count: int) -> Array:
    """Cut a sample into substeps.

    A valve that opens within a substep is not the same as one that is half open throughout, so that
    a cut is moved to where a delayed edge arrives. The last substep is short: if an edge arrives
    within it, what it does to the sample is smoothed over that time, for the sake of derivatives.

    Args:
        dt: length of the sample, s, ``(...)``.
        past: durations of the samples before, the latest first, s, ``(..., P)``.
        late: dead times, s, the most important first.
        count: of substeps, at least 3.

    Returns:
        Lengths, s, ``(..., count)``.
    """
    short = jnp.minimum(LAST_SUBSTEP, dt / count)
    room = (dt - short)[..., None]
    cuts = room * (jnp.arange(1, count - 1) / (count - 1)).astype(dt.dtype)
    free = jnp.ones_like(cuts)
    for delay in late[: count - 2]:
        if not isinstance(delay, jax.Array):
            continue
        behind = jnp.concatenate([jnp.zeros_like(room), jnp.cumsum(past, axis=-1)], axis=-1)
        arrives = (delay + 0.0 * dt)[..., None] - behind
        here = (arrives > 0.0) & (arrives < room)
        edge = jnp.sum(jnp.where(here, arrives, 0.0) * _first(here), axis=-1, keepdims=True)
        away = jnp.where(free > 0, jnp.abs(cuts - edge), jnp.inf)
        nearest = _first(away == jnp.min(away, axis=-1, keepdims=True))
        nearest = nearest * jnp.any(here, axis=-1, keepdims=True)
        cuts = jnp.where(nearest > 0, edge, cuts)
        free = free * (1.0 - nearest)
    ends = jnp.concatenate([jnp.zeros_like(room), jnp.sort(cuts, axis=-1), room, dt[..., None]], -1)
    # Two cuts may coincide; nothing may be divided by zero.
    return jnp.maximum(jnp.diff(ends, axis=-1), 1e-6 * dt[..., None])


def held(late: Array | float, lengths: Array, past: Array, values: Array) -> Array:
    """Mean over each substep of what was commanded ``late`` seconds before, ``(..., K)``."""
    if not isinstance(late, jax.Array):  # no mechanism has a dead time
        return values[..., :1] + 0.0 * lengths
    starts = jnp.cumsum(lengths, axis=-1) - lengths - (late + 0.0 * lengths[..., 0])[..., None]
    weights = shares(starts, lengths, past[..., None, :])
    return jnp.sum(weights * values[..., None, :], axis=-1)


def _first(mask: Array) -> Array:
    """One at the first True along the last axis, zero elsewhere."""
    return (mask & (jnp.cumsum(mask, axis=-1) == 1)).astype(float)
