"""Dead time of held commands, as an average: piecewise linear in the delay, so differentiable."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def shares(start: Array, length: Array, past: Array) -> Array:
    """How much of a window falls into this sample, each of P samples before, and all earlier ones.

    Args:
        start: of the window, s after the start of this sample; negative reaches back; ``(...)``.
        length: of the window, s, positive, likewise.
        past: durations of the P samples before, the latest first, s, ``(..., P)``.

    Returns:
        Weights that add up to one, in that order, ``(..., P + 2)``.
    """
    begins = -jnp.cumsum(past, axis=-1)
    infinite = jnp.full_like(begins[..., :1], jnp.inf)
    zero = jnp.zeros_like(infinite)
    upper = jnp.concatenate([infinite, zero, begins], axis=-1)
    lower = jnp.concatenate([zero, begins, -infinite], axis=-1)
    first, last = start[..., None], (start + length)[..., None]
    inside = jnp.minimum(last, upper) - jnp.maximum(first, lower)
    return jnp.maximum(inside, 0.0) / length[..., None]
