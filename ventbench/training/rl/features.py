"""What the networks see, and the PID that they correct: the same for every method."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax.numpy as jnp
from jax import Array

from ventbench import protocol
from ventbench.controllers.pid import PID, PIDState
from ventbench.interfaces import Observation

#: The PID that is corrected: the best single one of the grid for all six lungs, (P, I, D).
GAINS = (6.0, 6.0, 0.3)

#: Errors and commands before this step that are shown.
PAST = 4

#: Number of features.
COUNT = 2 * PAST + 7

#: What makes the features of the order of 1: cmH2O and %.
ERROR_SCALE, TARGET_SCALE, COMMAND_SCALE = 10.0, 40.0, 50.0


@flax.struct.dataclass
class Memory:
    """What is remembered from step to step.

    Attributes:
        pid: state of the PID, ``(...)``.
        errors: of the steps before, the latest first, cmH2O, ``(..., PAST)``.
        commands: as applied, likewise, %.
    """

    pid: PIDState
    errors: Array
    commands: Array


def init(shape: tuple[int, ...]) -> Memory:
    """Memory before the first breath; each breath begins with a new one."""
    past = jnp.zeros((*shape, PAST))
    return Memory(PID(*GAINS).init(shape), past, past)


def see(memory: Memory, observation: Observation) -> tuple[Memory, Array, Array]:
    """Take in one observation.

    Returns:
        The memory, the features, shape ``(..., COUNT)``, and the command of the PID, cut to the
        valve's range, %, shape ``(...)``.
    """
    restart = jnp.broadcast_to(observation.time == 0, jnp.shape(observation.pressure))[..., None]
    error = observation.target - observation.pressure
    before = jnp.where(restart, error[..., None], memory.errors)
    bias = observation.previous_u_in[..., None]
    commands = jnp.concatenate([bias, memory.commands[..., :-1]], axis=-1)
    commands = jnp.where(restart, bias, commands)
    pid, asked = PID(*GAINS).step(memory.pid, observation)
    base = jnp.clip(asked, 0.0, protocol.U_MAX)
    now: list[Any] = [
        error / ERROR_SCALE,
        pid.integral / ERROR_SCALE,
        pid.derivative,
        base / COMMAND_SCALE - 1.0,
        observation.target / TARGET_SCALE,
        observation.targets_ahead[..., -1] / TARGET_SCALE,
        jnp.broadcast_to(observation.time, error.shape),
    ]
    features = jnp.concatenate(
        [jnp.stack(now, axis=-1), before / ERROR_SCALE, commands / COMMAND_SCALE - 1.0], axis=-1
    )
    errors = jnp.concatenate([error[..., None], before[..., :-1]], axis=-1)
    return Memory(pid, errors, commands), features, base
