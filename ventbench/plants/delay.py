"""Dead time of a held command, as an average: piecewise linear in the delay, so differentiable."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def overlap(start: Array, length: Array, before: Array) -> tuple[Array, Array, Array]:
    """How much of a window falls into this sample, the one before, and all earlier ones.

    Args:
        start: of the window, s after the start of this sample; negative reaches back.
        length: of the window, s, positive.
        before: duration of the sample before, s.

    Returns:
        Three weights that add up to one.
    """
    end = start + length
    now = (jnp.maximum(end, 0.0) - jnp.maximum(start, 0.0)) / length
    earlier = (jnp.maximum(-before - start, 0.0) - jnp.maximum(-before - end, 0.0)) / length
    return now, 1.0 - now - earlier, earlier
