"""The small networks of the first steps of an inspiration."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jax import Array


@flax.struct.dataclass
class Boundary:
    """N_B networks of one hidden tanh layer, side by side in two matrices.

    Attributes:
        hidden: shape ``(in, N_B * width)``.
        hidden_bias: shape ``(N_B * width,)``.
        output: shape ``(N_B * width, 2)``.
        output_bias: shape ``(N_B, 2)``.
    """

    hidden: Array
    hidden_bias: Array
    output: Array
    output_bias: Array

    def __call__(self, x: Array, index: Array) -> Array:
        """Evaluate network ``index`` (shape ``(...)``) at inputs of shape ``(..., in)``.

        All hidden layers are one matrix product; the others' units are then set to zero, so that
        the output is one product too and no weight is gathered. Zero for an index beyond N_B.
        """
        count = self.output_bias.shape[0]
        chosen = (index[..., None] == jnp.arange(count)).astype(x.dtype)
        units = jnp.tanh(x @ self.hidden + self.hidden_bias)
        units = units * jnp.repeat(chosen, units.shape[-1] // count, axis=-1)
        return units @ self.output + chosen @ self.output_bias
