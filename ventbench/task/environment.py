"""Cells of a score, and one control step of the loop around a plant.

The scan of :mod:`ventbench.task.rollouts` and the stepwise scorer of :mod:`ventbench.entries` both
call these functions, so that a controller scores the same in both.
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Observation, Plant, Signals

# Tables over the step of the breath: two breaths of target, so that looking ahead needs no modulo.
_TARGET = waveform.shape(np.arange(2 * protocol.BREATH_STEPS))
_EXPIRATORY = waveform.expiratory_command(np.arange(protocol.BREATH_STEPS))


@flax.struct.dataclass
class Scenario:
    """A batch of cells; every field has the batch shape ``(...)`` unless it says otherwise."""

    pip: Array  #: peak inspiratory pressure, cmH2O.
    peep: Array  #: positive end-expiratory pressure, cmH2O.
    start: Array  #: pressure at which each inspiration starts, cmH2O.
    dt: Array  #: true control step, s.
    r_scale: Array  #: true over nominal resistance.
    c_scale: Array  #: true over nominal compliance.
    delay: Array  #: additional dead time of the command, as a share of one step, 0..1.
    #: flow of the inspiratory valve in each breath over that of its rig, ``(..., BREATHS)``.
    gain: Array
    quantum: Array  #: step of the pressure sensor's converter, cmH2O; 0 for none.
    #: noise that is added to the measured pressure before the converter, cmH2O, shape ``(...,
    #: BREATHS, INSPIRATION_STEPS)``.
    noise: Array


def nominal_scenario(pip: ArrayLike) -> Scenario:
    """Cells without noise or deviation, of a PIP of any shape, cmH2O.

    Raises:
        InputError: if a PIP does not exceed the PEEP.
    """
    pip = np.asarray(pip, float)
    if not np.all(pip > protocol.PEEP):
        raise InputError(f"PIP {pip} cmH2O must exceed PEEP {protocol.PEEP} cmH2O")
    ones, zeros = np.ones(pip.shape), np.zeros(pip.shape)
    peep = protocol.PEEP * ones
    noise = np.zeros((*pip.shape, protocol.BREATHS, protocol.INSPIRATION_STEPS))
    gain = np.ones((*pip.shape, protocol.BREATHS))
    arrays = (pip, peep, peep, protocol.DT * ones, ones, ones, zeros, gain, zeros, noise)
    return Scenario(*(jnp.asarray(array) for array in arrays))


def _table(values: Floats, scenario: Scenario) -> Array:
    # With its type spelled out: JAX keeps the constant that it makes of a numpy array, and would
    # bring a 64-bit one from an earlier trace into a 32-bit trace.
    return jnp.asarray(values, jnp.result_type(scenario.pip))


@flax.struct.dataclass
class LoopState:
    """State of the loop: a batch of plants in mid-breath."""

    plant: Any  #: states of the plants.
    signals: Signals  #: what the plants show; readings are without noise.
    previous: Array  #: command of the previous step as applied, %, shape ``(...)``.


def vary(plant: Plant, scenario: Scenario, breath: Array | int) -> Plant:
    """Return plants with the resistance, the compliance and the valve's gain of a breath."""
    gain = scenario.gain[..., breath]
    return plant.vary(scenario.r_scale, scenario.c_scale, gain)


def start_breath(plant: Plant, scenario: Scenario) -> LoopState:
    """Lungs at rest at the start of an inspiration, the bias flow of the expiration still on."""
    bias = _table(_EXPIRATORY, scenario)[-1]
    return LoopState(
        *plant.init(scenario.start, scenario.peep), jnp.full_like(scenario.start, bias)
    )


def target(scenario: Scenario, step: Array | int) -> Array:
    """Target pressure at a step of the breath, cmH2O, shape ``(...)``."""
    return scenario.peep + (scenario.pip - scenario.peep) * _table(_TARGET, scenario)[step]


def observe(
    scenario: Scenario, loop: LoopState, breath: Array | int, step: Array | int
) -> Observation:
    """Observation of the controller at a step of an inspiration.

    Indices of breath and step, below ``INSPIRATION_STEPS``, are for all cells, or ``(...)``.
    """
    if jnp.ndim(step):
        at = jnp.asarray(breath) * protocol.INSPIRATION_STEPS + step
        flat = scenario.noise.reshape(*scenario.noise.shape[:-2], -1)
        noise = jnp.take_along_axis(flat, at[..., None], axis=-1)[..., 0]
    else:
        noise = scenario.noise[..., breath, step]
    measured = loop.signals.reading + noise
    quantum = jnp.where(scenario.quantum > 0, scenario.quantum, 1.0)
    measured = jnp.where(scenario.quantum > 0, jnp.round(measured / quantum) * quantum, measured)
    ahead = jnp.stack(
        [target(scenario, step + 1 + k) for k in range(protocol.TARGETS_AHEAD)], axis=-1
    )
    now = jnp.broadcast_to(target(scenario, step), measured.shape)
    return Observation(step * scenario.dt, scenario.dt, measured, now, ahead, loop.previous)


def resolved(u_in: ArrayLike) -> Floats:
    """What the valve gets of a controller's commands, %, of any shape: in range, to its step.

    Only a submission's commands pass here: bounds and training follow derivatives, which steps have
    not.
    """
    steps = round(1.0 / protocol.RESOLUTION)
    return np.rint(np.clip(u_in, 0.0, protocol.U_MAX) * steps) / steps + 0.0  # no "-0.0"


def inspire(
    plant: Plant, scenario: Scenario, loop: LoopState, u_in: Array
) -> tuple[LoopState, Array]:
    """Apply one inspiratory command, %, ``(...)``, clipped to the valve's range.

    Returns the state one step later, and the command as applied. Plants are from :func:`vary`.
    """
    applied = jnp.clip(u_in, 0.0, protocol.U_MAX)
    # The held command reaches the valve `delay` of a step late: over this step it averages to
    late = (1.0 - scenario.delay) * applied + scenario.delay * loop.previous
    after = plant.step(loop.plant, late, jnp.zeros_like(late), scenario.dt)
    return LoopState(*after, applied), applied


def expire(
    plant: Plant, scenario: Scenario, loop: LoopState, step: Array | int
) -> tuple[LoopState, Array]:
    """Apply the fixed expiratory command of a step; arguments and results as of :func:`inspire`."""
    u_in = jnp.broadcast_to(_table(_EXPIRATORY, scenario)[step], loop.previous.shape)
    return LoopState(*plant.step(loop.plant, u_in, jnp.ones_like(u_in), scenario.dt), u_in), u_in
