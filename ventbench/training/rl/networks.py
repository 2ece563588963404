"""The networks of all methods: dense layers with tanh, in flax."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from ventbench.training.rl import features

#: Parameters of a network, as flax keeps them.
Parameters = Any


class Dense(nn.Module):
    """Hidden layers with tanh, then a linear one that starts as zero.

    Attributes:
        widths: units of each hidden layer.
        outputs: of the last layer.
        first: scale of the last layer's weights at the start; 0 for none.
    """

    widths: tuple[int, ...]
    outputs: int
    first: float = 0.0

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Outputs, shape ``(..., outputs)``, of features, shape ``(..., features)``."""
        for width in self.widths:
            x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5))(x))
        start = nn.initializers.orthogonal(self.first) if self.first else nn.initializers.zeros
        return nn.Dense(self.outputs, kernel_init=start)(x)


def start(network: Dense, key: Array) -> Parameters:
    """Parameters at the start of a training."""
    return network.init(key, jnp.zeros((1, features.COUNT)))


def layers(parameters: Parameters) -> list[tuple[Array, Array]]:
    """Weights, shape ``(inputs, units)``, and biases of each layer in order."""
    named = parameters["params"]
    return [(named[f"Dense_{k}"]["kernel"], named[f"Dense_{k}"]["bias"]) for k in range(len(named))]
