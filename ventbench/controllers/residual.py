"""A PID with a correction by a network that sees this breath and the previous one.

:class:`Residual` is trained by the simulators' derivatives. Reinforcement learners correct the PID
of :data:`GAINS` from the same 30 features: the policy of PPO and of the policy gradient,
:class:`GaussianPolicy`, adds the network's output to the PID's command; that of DQN,
:class:`GreedyPolicy`, the one of 19 corrections that has the highest value.

The weights file of a residual controller is an ``.npz`` of plain arrays, as the submissions read
it. For each network, by the id of its lung or ``all``: ``ID.gains`` (P, I, D), ``ID.limit``,
``ID.windows`` (pressures, commands, ahead) and the layers ``ID.w0``, ``ID.b0``, ``ID.w1``, ... That
of policies has the layers alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base import files
from ventbench.controllers.pid import PID, PIDState
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Observation

#: Scales that bring the features to the order of 1: cmH2O of errors and of targets, % of commands,
#: shares of the control step.
ERROR, TARGET, COMMAND, STEP = 10.0, 40.0, 100.0, 0.1

#: One dense layer: weights ``(inputs, outputs)`` and biases ``(outputs,)``.
Layer = tuple[Array, Array]

_STEPS = protocol.INSPIRATION_STEPS


@flax.struct.dataclass
class ResidualState:
    """Memory of the controller."""

    pid: PIDState  #: state of the PID.
    started: Array  #: 0 before the first breath, then 1, shape ``(...)``.
    has_previous: Array  #: whether there was a previous breath, 0/1, shape ``(...)``.
    #: errors in the last steps of this breath, the latest first, cmH2O, ``(..., pressures)``.
    errors: Array
    #: commands as applied in the last steps, the latest first, %, ``(..., commands)``.
    commands: Array
    error_trace: Array  #: errors of the last 34 steps, the latest last, cmH2O, ``(..., 34)``.
    #: commands of the last 34 steps, the latest last, %, ``(..., 34)``. The command of a step is
    #: known one step later, so that the first entry is the bias flow before the breath.
    command_trace: Array
    #: errors of the previous breath from this step on, cmH2O, ``(..., 34 + ahead)``.
    error_before: Array
    #: commands of the previous breath from this step on, %, ``(..., 34 + ahead)``.
    command_before: Array


@flax.struct.dataclass
class Residual:
    """``u_in = PID + limit tanh(network(features))``, %.

    The features are the PID's error, integral and derivative; the target; time in breath and
    control step; errors and applied commands of the last steps; and errors and commands of the
    previous breath at this step and at the next ones, which are zero in the first breath.
    """

    pid: PID  #: gains of shape ``()``.
    #: dense layers of the network, tanh between them; the last has one output.
    layers: tuple[Layer, ...]
    #: number of earlier errors that the network sees.
    pressures: int = flax.struct.field(pytree_node=False, default=5)
    #: number of earlier commands that it sees.
    commands: int = flax.struct.field(pytree_node=False, default=6)
    #: number of steps of the previous breath that it sees; 0 for none.
    ahead: int = flax.struct.field(pytree_node=False, default=6)
    limit: float = flax.struct.field(pytree_node=False, default=100.0)  #: largest correction, %.

    def init(self, shape: tuple[int, ...]) -> ResidualState:
        """State before the first breath."""
        zero, long = jnp.zeros(shape), jnp.zeros((*shape, _STEPS + self.ahead))
        errors, commands = (jnp.zeros((*shape, count)) for count in (self.pressures, self.commands))
        trace = long[..., :_STEPS]
        return ResidualState(
            self.pid.init(shape), zero, zero, errors, commands, trace, trace, long, long
        )

    def step(self, state: ResidualState, observation: Observation) -> tuple[ResidualState, Array]:
        """Return the next state and ``u_in``, %, shape ``(...)``."""
        state, base, correction = self.parts(state, observation)
        return state, base + correction

    def parts(
        self, state: ResidualState, observation: Observation
    ) -> tuple[ResidualState, Array, Array]:
        """Return the next state, the PID's command and the correction of it, %, shape ``(...)``."""
        state, features, base = self.features(state, observation)
        correction = self.limit * jnp.tanh(apply(self.layers, features)[..., 0])
        return state, base, correction

    def features(
        self, state: ResidualState, observation: Observation
    ) -> tuple[ResidualState, Array, Array]:
        """Features of an observation.

        Returns:
            The next state, the features, shape ``(..., inputs(self))``, and the PID's command, %,
            shape ``(...)``.
        """
        error = observation.target - observation.pressure
        state = self._begin(state, observation, error)
        pid, base = self.pid.step(state.pid, observation)
        previous, zero = observation.previous_u_in, jnp.zeros_like(error)
        state = state.replace(  # type: ignore[attr-defined]
            pid=pid,
            commands=_push(previous, state.commands),
            error_trace=_append(state.error_trace, error),
            command_trace=_append(state.command_trace, previous),
        )
        now = jnp.stack([error, pid.integral, pid.derivative], axis=-1)
        errors = jnp.concatenate(
            [now, state.errors, state.error_before[..., : self.ahead]], axis=-1
        )
        step = (observation.dt / protocol.DT - 1.0) / STEP + zero
        rest = [observation.target / TARGET, observation.time + zero, step, state.has_previous]
        commands = [state.commands, state.command_before[..., : self.ahead]]
        columns = [
            errors / ERROR,
            jnp.stack(rest, axis=-1),
            jnp.concatenate(commands, axis=-1) / COMMAND,
        ]
        features = jnp.concatenate(columns, axis=-1)
        state = state.replace(  # type: ignore[attr-defined]
            errors=_push(error, state.errors),
            error_before=_append(state.error_before, zero),
            command_before=_append(state.command_before, zero),
        )
        return state, features, base

    def _begin(self, state: ResidualState, observation: Observation, error: Array) -> ResidualState:
        """Turn the traces of the previous breath into memory at the first step of a breath."""
        restart = observation.time + jnp.zeros_like(error) == 0
        wide = restart[..., None]
        room = jnp.zeros((*error.shape, self.ahead), error.dtype)

        def turned(trace: Array, before: Array) -> Array:
            return jnp.where(wide, jnp.concatenate([trace, room], axis=-1), before)

        return state.replace(  # type: ignore[attr-defined]
            started=jnp.where(restart, 1.0, state.started),
            has_previous=jnp.where(restart, state.started, state.has_previous),
            errors=jnp.where(wide, error[..., None], state.errors),
            commands=jnp.where(wide, waveform.EXPIRATORY_BIAS, state.commands),
            error_before=turned(state.error_trace, state.error_before),
            command_before=turned(state.command_trace, state.command_before),
        )


def inputs(controller: Residual) -> int:
    """Number of features that the network of a controller sees."""
    return 7 + controller.pressures + controller.commands + 2 * controller.ahead


def apply(layers: tuple[Layer, ...], x: Array) -> Array:
    """Outputs of the network, shape ``(..., outputs)``, from inputs ``(..., inputs)``."""
    for weights, biases in layers[:-1]:
        x = jnp.tanh(x @ weights + biases)
    weights, biases = layers[-1]
    return x @ weights + biases


def untrained(key: Array, like: Residual, widths: tuple[int, ...]) -> Residual:
    """Return a controller with a new network that corrects nothing yet: its last layer is zero.

    PID, windows and limit are those of another; ``widths`` are the units of each hidden layer.
    """
    sizes = [inputs(like), *widths]
    layers = []
    for number, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        weights = jax.random.normal(jax.random.fold_in(key, number), (fan_in, fan_out))
        layers.append((weights / np.sqrt(fan_in), jnp.zeros(fan_out)))
    layers.append((jnp.zeros((sizes[-1], 1)), jnp.zeros(1)))
    return like.replace(layers=tuple(layers))  # type: ignore[attr-defined]


def _push(value: Array, before: Array) -> Array:
    """Put a value first and drop the last one."""
    return jnp.concatenate([value[..., None], before], axis=-1)[..., : before.shape[-1]]


def _append(trace: Array, value: Array) -> Array:
    """Put a value last and drop the first one."""
    return jnp.concatenate([trace, value[..., None]], axis=-1)[..., 1:]


def save_weights(path: Path, controllers: Mapping[str, Residual]) -> None:
    """Write controllers, by lung id or ``all``, in one step; equal ones give equal bytes."""
    arrays: dict[str, Any] = {}
    for name, controller in controllers.items():
        pid, windows = controller.pid, (controller.pressures, controller.commands, controller.ahead)
        arrays[f"{name}.gains"] = np.array([float(gain) for gain in (pid.P, pid.I, pid.D)])
        arrays[f"{name}.limit"] = np.array(controller.limit)
        arrays[f"{name}.windows"] = np.array(windows, np.int64)
        arrays |= _named(name, controller.layers)
    files.write_atomically(path, lambda file: np.savez(file, **arrays))


def _named(name: str, layers: Sequence[Layer]) -> dict[str, Any]:
    """Layers as a file names them, float32: ``ID.w0``, ``ID.b0``, ``ID.w1``, ..."""
    return {
        f"{name}.{kind}{k}": np.asarray(array, np.float32)
        for k, layer in enumerate(layers)
        for kind, array in zip("wb", layer, strict=True)
    }


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
    state, values, command = _RESIDUAL.features(state, observation)
    return state, values, jnp.clip(command, 0.0, protocol.U_MAX)


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


def layers(parameters: Parameters) -> list[Layer]:
    """Weights, shape ``(inputs, units)``, and biases of each layer in order."""
    named = parameters["params"]
    return [(named[f"Dense_{k}"]["kernel"], named[f"Dense_{k}"]["bias"]) for k in range(len(named))]


#: Correction that an output of 1 stands for, %.
SCALE = 20.0

#: Corrections that DQN chooses from, %: fine about zero, coarse to the whole range of the valve.
CHOICES = (
    -90.0,
    -60.0,
    -40.0,
    -25.0,
    -15.0,
    -9.0,
    -5.0,
    -2.5,
    -1.0,
    0.0,
    1.0,
    2.5,
    5.0,
    9.0,
    15.0,
    25.0,
    40.0,
    60.0,
    90.0,
)


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


def arrays(policies: Mapping[str, Any]) -> dict[str, Any]:
    """Layers of policies, by lung id or ``all``, as a file names them, float32.

    Layer k does ``x @ wk + bk``, with tanh between the layers.
    """
    named: dict[str, Any] = {}
    for name, policy in policies.items():
        named |= _named(name, layers(policy.parameters))
    return named


def save_policies(path: Path, policies: Mapping[str, Any]) -> None:
    """Write policies, by lung id or ``all``, as an ``.npz``; equal networks give equal bytes."""
    content = arrays(policies)
    files.write_atomically(path, lambda file: np.savez(file, **content))
