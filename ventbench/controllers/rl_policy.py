"""The PID with a correction by a small network, the policy of the reinforcement learners.

All methods share the features that the network sees, the PID that it corrects, and the kind of
network. The features are the 30 of the residual controller (:mod:`ventbench.controllers.residual`),
which look back at the breath before. The policy of PPO and of the policy gradient adds the
network's output to the PID's command; the policy of DQN adds the one of 19 corrections that has the
highest value.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import flax.linen as nn
import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.files import write_atomically
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import Residual, ResidualState, inputs
from ventbench.task import protocol
from ventbench.task.interfaces import Observation

#: The PID that is corrected: the best single one of the grid for all six lungs, (P, I, D).
GAINS = (6.0, 6.0, 0.3)

#: Gives the features, those of the residual controller; its network has no layers.
_RESIDUAL = Residual(PID(*GAINS), ())

#: Number of features.
FEATURES = inputs(_RESIDUAL)


def init_features(shape: tuple[int, ...]) -> ResidualState:
    """State before the first breath."""
    return _RESIDUAL.init(shape)


def features(state: ResidualState, observation: Observation) -> tuple[ResidualState, Array, Array]:
    """The next state, the features, ``(..., FEATURES)``, and the clipped command of the PID, %."""
    state, seen, asked = _RESIDUAL.features(state, observation)
    return state, seen, jnp.clip(asked, 0.0, protocol.U_MAX)


#: Parameters of a network, as flax keeps them.
Parameters = Any


class TanhNetwork(nn.Module):
    """Dense layers with tanh, then a linear one that starts as zero."""

    widths: tuple[int, ...]  #: units of each hidden layer.
    outputs: int  #: units of the last layer.
    first: float = 0.0  #: scale of the last layer's weights at the start; 0 for none.

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Outputs, shape ``(..., outputs)``, of features, shape ``(..., features)``."""
        for width in self.widths:
            x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5))(x))
        start = nn.initializers.orthogonal(self.first) if self.first else nn.initializers.zeros
        return nn.Dense(self.outputs, kernel_init=start)(x)


def init_parameters(network: TanhNetwork, key: Array) -> Parameters:
    """Parameters at the start of a training."""
    return network.init(key, jnp.zeros((1, FEATURES)))


def layers(parameters: Parameters) -> list[tuple[Array, Array]]:
    """Weights, shape ``(inputs, units)``, and biases of each layer in order."""
    named = parameters["params"]
    return [(named[f"Dense_{k}"]["kernel"], named[f"Dense_{k}"]["bias"]) for k in range(len(named))]


#: Correction that an output of 1 stands for, %.
SCALE = 20.0

#: Corrections that DQN chooses from, %: fine about zero, coarse to the whole range of the valve.
CHOICES = (
    -90.0, -60.0, -40.0, -25.0, -15.0, -9.0, -5.0, -2.5, -1.0,
    0.0, 1.0, 2.5, 5.0, 9.0, 15.0, 25.0, 40.0, 60.0, 90.0,
)  # fmt: skip


@flax.struct.dataclass
class CorrectedPID:
    """The PID plus a correction that a network decides on."""

    parameters: Parameters  #: weights and biases of the network.
    #: what the outputs of the network mean is told by the kind of policy.
    network: TanhNetwork = flax.struct.field(pytree_node=False)

    def init(self, shape: tuple[int, ...]) -> ResidualState:
        """State at the start of a run."""
        return init_features(shape)

    def step(self, state: ResidualState, observation: Observation) -> tuple[ResidualState, Array]:
        """Return the next state and ``u_in``, %."""
        state, x, base = features(state, observation)
        outputs: Array = self.network.apply(self.parameters, x)  # type: ignore[assignment]
        return state, base + self.correction(outputs)

    def correction(self, outputs: Array) -> Array:
        """Correction, %, shape ``(...)``, for outputs, shape ``(..., outputs)``."""
        raise NotImplementedError


@flax.struct.dataclass
class GaussianPolicy(CorrectedPID):
    """The PID plus :data:`SCALE` times the network's one output, the mean of a Gaussian policy."""

    def correction(self, outputs: Array) -> Array:
        """:data:`SCALE` times the output."""
        return SCALE * outputs[..., 0]


@flax.struct.dataclass
class GreedyPolicy(CorrectedPID):
    """The PID plus the one of :data:`CHOICES` to which the network gives the highest value."""

    def correction(self, outputs: Array) -> Array:
        """The choice of the highest output."""
        return jnp.asarray(CHOICES, outputs.dtype)[jnp.argmax(outputs, axis=-1)]


def arrays(policies: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Weights and biases by name, float32: ``R20C50.w0``, ``R20C50.b0``, ``R20C50.w1``, ...

    Layer k does ``x @ wk + bk``, with tanh between the layers. The policy that is not told the lung
    is called ``all``.
    """
    named = {}
    for name, policy in policies.items():
        for k, layer in enumerate(layers(policy.parameters)):
            for kind, array in zip("wb", layer, strict=True):
                named[f"{name}.{kind}{k}"] = np.asarray(array, np.float32)
    return named


def save_weights(path: Path, policies: Mapping[str, Any]) -> None:
    """Write policies, by lung id or ``all``, as an ``.npz``; equal networks give equal bytes."""
    content: dict[str, Any] = arrays(policies)
    write_atomically(path, lambda file: np.savez(file, **content))
