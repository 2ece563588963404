"""Whole runs in one compiled scan over time, vectorised over everything else."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.task import environment as env
from ventbench.task import protocol
from ventbench.task.environment import LoopState, Scenario
from ventbench.task.interfaces import Controller, Observation, Plant


@flax.struct.dataclass
class Script:
    """A controller that ignores what it observes."""

    #: commands of a run in order, %, shape ``(BREATHS * INSPIRATION_STEPS,)`` or ``(..., BREATHS *
    #: INSPIRATION_STEPS)`` for different ones in each cell of a batch.
    u_in: Array

    def init(self, shape: tuple[int, ...]) -> Array:
        """Return the index of the first command."""
        return jnp.zeros((), int)

    def step(self, state: Array, observation: Observation) -> tuple[Array, Array]:
        """Return the index of the next command, and the present command, %, shape ``(...)``."""
        command = jnp.take(self.u_in, state, axis=-1)
        return state + 1, jnp.broadcast_to(command, jnp.shape(observation.pressure))


BREATHS, INSPIRATION = protocol.BREATHS, protocol.INSPIRATION_STEPS

#: State, observation and inputs of a step, to the next state and ``u_in``, %.
Policy = Callable[[Any, Any, Any], tuple[Any, Array]]

#: The loop before and after a step, the request and the command as applied, to what is kept.
Record = Callable[[LoopState, LoopState, Array, Array], Any]


@jax.jit
def open_loop(plant: Plant, start: Array, u_in: Array, u_out: Array, dt: Array) -> Array:
    """Pressures that a plant answers to recorded commands with, from the recorded start.

    Args:
        plant: any plant.
        start: first pressure, cmH2O, shape ``(n,)``.
        u_in: inspiratory valve, %, shape ``(n, T)``.
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``; the last one is not used.

    Returns:
        Pressure at each sample, cmH2O, shape ``(n, T)``; the first is ``start``.
    """

    def step(state: Any, command: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        state, signals = plant.step(state, *command)
        return state, signals.reading

    commands = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), (u_in, u_out, dt))
    _, pressure = jax.lax.scan(step, plant.init(start)[0], commands)
    return jnp.concatenate([start[:, None], jnp.moveaxis(pressure, 0, 1)], axis=1)


@flax.struct.dataclass
class Inspirations:
    """Inspirations of a closed-loop run; every array has shape ``(..., BREATHS, steps)``."""

    pressure: Array  #: airway pressure at each step, which is scored, cmH2O.
    requested: Array  #: what the controller asked for, %.
    u_in: Array  #: what was applied, %.
    #: gas in the lung, mL, see :class:`~ventbench.task.interfaces.Signals`; None where the plant
    #: has none.
    volume: Array | None


@flax.struct.dataclass
class Expirations:
    """Expirations of a closed-loop run; every array has shape ``(..., BREATHS, steps)``.

    The expiratory valve is open throughout.
    """

    pressure: Array  #: true airway pressure at each step, cmH2O.
    u_in: Array  #: inspiratory valve as applied, %.


def scored_step(before: LoopState, after: LoopState, requested: Array, applied: Array) -> Any:
    """Record a step as :class:`Inspirations`: what the plant shows before its command acts."""
    return Inspirations(before.signals.scored, requested, applied, before.signals.volume)


def control_step(
    plant: Plant,
    scenario: Scenario,
    policy: Policy,
    record: Record,
    carry: tuple[LoopState, Any],
    at: tuple[Array | int, Array | int, Any],
) -> tuple[tuple[LoopState, Any], Any]:
    """One step of an inspiration, as the body of a scan; every compiled loop is made of it.

    Args:
        plant: plants of the cells, from :func:`ventbench.task.environment.vary`.
        scenario: the cells.
        policy: takes its state, the observation and the inputs of a step, and returns its next
            state and ``u_in``, %.
        record: what is kept of a step.
        carry: states of the loop and of the policy.
        at: index of the breath, index of the step, and inputs of the policy.
    """
    loop, state = carry
    breath, index, inputs = at
    state, requested = policy(state, env.observe(scenario, loop, breath, index), inputs)
    after, applied = env.inspire(plant, scenario, loop, requested)
    return (after, state), record(loop, after, requested, applied)


def inspiration(
    plant: Plant,
    scenario: Scenario,
    policy: Policy,
    state: Any = None,
    *,
    breath: Array | int = 0,
    steps: int = INSPIRATION,
    inputs: Any = None,
    record: Record = scored_step,
) -> tuple[LoopState, Any, Any]:
    """Run one inspiration from rest; further arguments as of :func:`control_step`.

    Args:
        plant: plants of the cells, from :func:`ventbench.task.environment.vary`.
        scenario: the cells.
        policy: chooses the commands.
        state: of the policy.
        breath: index of the breath.
        steps: number of steps.
        inputs: what the policy gets besides, with the steps on the leading axis of each leaf.
        record: what is kept of a step.

    Returns:
        States of the loop and of the policy afterwards, and the records, steps first.
    """

    def step(carry: tuple[LoopState, Any], at: tuple[Array, Any]) -> tuple[Any, Any]:
        return control_step(plant, scenario, policy, record, carry, (breath, *at))

    start = (env.start_breath(plant, scenario), state)
    (loop, state), out = jax.lax.scan(step, start, (jnp.arange(steps), inputs))
    return loop, state, out


def expiration(plant: Plant, scenario: Scenario, loop: LoopState) -> tuple[LoopState, Expirations]:
    """Run the fixed commands of an expiration, from the state at the end of the inspiration.

    Returns the state of the loop afterwards, and what it shows, steps first.
    """

    def expire(loop: LoopState, step: Array) -> tuple[LoopState, Expirations]:
        after, u_in = env.expire(plant, scenario, loop, step)
        return after, Expirations(loop.signals.scored, u_in)

    return jax.lax.scan(expire, loop, jnp.arange(INSPIRATION, protocol.BREATH_STEPS))


def controlled_by(controller: Controller) -> Policy:
    """Return a pure controller as a policy."""
    return lambda state, observation, _: controller.step(state, observation)


def commanded(state: Any, observation: Any, command: Array) -> tuple[Any, Array]:
    """Policy that applies its inputs, as if recorded before."""
    return state, command


@partial(jax.jit, static_argnames=("whole",))
def closed_loop(
    plant: Plant, controller: Controller, scenario: Scenario, *, whole: bool = False
) -> tuple[Inspirations, Expirations | None]:
    """Run a pure controller through the protocol, all cells at once.

    Args:
        plant: any plant.
        controller: parameters broadcast against the cells.
        scenario: the cells, batch shape ``(...)``.
        whole: simulate the expirations too, which the safety gate judges.

    Returns:
        The inspirations, and the expirations if asked for.
    """
    policy = controlled_by(controller)

    def run(state: Any, breath: Array) -> tuple[Any, Any]:
        varied = env.vary(plant, scenario, breath)
        loop, state, inspired = inspiration(varied, scenario, policy, state, breath=breath)

        expired = expiration(varied, scenario, loop)[1] if whole else None
        return state, (inspired, expired)

    _, out = jax.lax.scan(run, controller.init(scenario.pip.shape), jnp.arange(BREATHS))
    # Scans stack time in front: (breath, step, ...) -> (..., breath, step).
    return jax.tree.map(lambda x: jnp.moveaxis(x, (0, 1), (-2, -1)), out)
