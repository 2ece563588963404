"""A plain multilayer perceptron as a pytree: nothing but weights, biases and matrix products."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

#: Activations by name: the paper's SELU, and tanh, which is smooth and bounded.
ACTIVATIONS = {"tanh": jnp.tanh, "selu": jax.nn.selu}


def activate(name: str, x: Array) -> Array:
    """Apply an activation by its name."""
    return ACTIVATIONS[name](x)


@flax.struct.dataclass
class MLP:
    """Dense layers; the last one is linear.

    The layers are unrolled, not scanned: each is one matrix product whose bias and activation
    XLA fuses into one pass.

    Attributes:
        weights: one matrix a layer, shapes ``(in, width)``, ``(width, width)``, ...,
            ``(width, out)``.
        biases: one vector a layer, shapes ``(width,)``, ..., ``(out,)``.
        activation: a name in :data:`ACTIVATIONS`.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str = flax.struct.field(pytree_node=False)

    def __call__(self, x: Array) -> Array:
        """Evaluate at inputs of shape ``(..., in)``; returns shape ``(..., out)``."""
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = activate(self.activation, x @ weight + bias)
        return x @ last[0] + last[1]


def mlp(key: Array, sizes: tuple[int, ...], activation: str, last_scale: float = 1.0) -> MLP:
    """Draw a network with LeCun-normal weights and zero biases.

    Args:
        key: a key that is used for nothing else.
        sizes: sizes of the input, the hidden layers and the output; at least two numbers.
        activation: a name in :data:`ACTIVATIONS`.
        last_scale: factor on the weights of the last layer.

    Raises:
        ValueError: if a size is below 1, there are fewer than two, or the activation is unknown.
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation {activation!r} is not one of {', '.join(ACTIVATIONS)}")
    if len(sizes) < 2 or min(sizes) < 1:
        raise ValueError(f"layer sizes {sizes} must be two or more numbers, each at least 1")
    scales = [n**-0.5 for n in sizes[:-1]]
    scales[-1] *= last_scale
    weights = tuple(
        scale * jax.random.normal(subkey, (n, m), jnp.float32)
        for scale, subkey, n, m in zip(
            scales, jax.random.split(key, len(scales)), sizes[:-1], sizes[1:], strict=True
        )
    )
    biases = tuple(jnp.zeros(n, jnp.float32) for n in sizes[1:])
    return MLP(weights, biases, activation)


def layer_sizes(inputs: int, width: int, depth: int, outputs: int) -> tuple[int, ...]:
    """Sizes for :func:`mlp`; ``depth`` counts matrices, the last included, as the paper does."""
    return (inputs, *([width] * (depth - 1)), outputs)
