"""Whole runs in one compiled scan over time, vectorised over everything else."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import environment as env
from ventbench import precision, protocol
from ventbench.environment import Scenario
from ventbench.interfaces import Controller, Plant
from ventbench.recordings.breaths import Breaths

BREATHS, INSPIRATION = protocol.BREATHS, protocol.INSPIRATION_STEPS

#: Gives the plants of some breaths: parameters of shape ``(n, ...)``.
PlantsFor = Callable[[Breaths], Plant]

# Breaths rolled out together: bounds memory, and the last batch is padded so that all compile once.
_BATCH = 4096


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
        return plant.step(state, *command)

    commands = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), (u_in, u_out, dt))
    _, pressure = jax.lax.scan(step, plant.init(start), commands)
    return jnp.concatenate([start[:, None], jnp.moveaxis(pressure, 0, 1)], axis=1)


def open_loop_breaths(
    plants_for: PlantsFor, breaths: Breaths, progress: Callable[[int], object] | None = None
) -> NDArray[np.float64]:
    """Pressures that plants answer to the commands of recorded breaths with, in batches.

    Each breath starts at its first recorded pressure.

    Args:
        plants_for: see :data:`PlantsFor`.
        breaths: n breaths of T samples.
        progress: called with the number of breaths of each batch, as it is done.

    Returns:
        cmH2O, shape ``(n, T)``; NaN for a breath whose first pressure is blank.
    """
    n = len(breaths)
    batch = min(_BATCH, n)
    parts = []
    with precision.float64():
        for first in range(0, n, batch):
            index = np.minimum(np.arange(first, first + batch), n - 1)
            part = breaths.select(index)
            columns = (part.pressure[:, 0], part.u_in, part.u_out, part.dt)
            start, *commands = (jnp.asarray(x, float) for x in columns)
            answer = open_loop(plants_for(part), start, *commands)
            parts.append(np.asarray(answer)[: min(batch, n - first)])
            if progress is not None:
                progress(len(parts[-1]))
    return np.concatenate(parts)


@flax.struct.dataclass
class Inspirations:
    """Inspirations of a closed-loop run; every array has shape ``(..., BREATHS, steps)``.

    Attributes:
        pressure: airway pressure at each step, cmH2O.
        requested: what the controller asked for, %.
        u_in: what was applied, %.
    """

    pressure: Array
    requested: Array
    u_in: Array


@flax.struct.dataclass
class Expirations:
    """Expirations of a closed-loop run; every array has shape ``(..., BREATHS, steps)``.

    The expiratory valve is open throughout.

    Attributes:
        pressure: true airway pressure at each step, cmH2O.
        u_in: inspiratory valve as applied, %.
    """

    pressure: Array
    u_in: Array


def _breath(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    whole: bool,
    state: Any,
    breath: Array,
) -> tuple[Any, tuple[Inspirations, Expirations | None]]:
    def scored(loop: env.LoopState) -> Array:
        return env.airway_pressure(plant, loop)

    def inspire(carry: tuple[env.LoopState, Any], step: Array) -> tuple[Any, Inspirations]:
        loop, state = carry
        state, requested = controller.step(state, env.observe(scenario, loop, breath, step))
        after, applied = env.inspire(plant, scenario, loop, requested)
        return (after, state), Inspirations(scored(loop), requested, applied)

    def expire(loop: env.LoopState, step: Array) -> tuple[env.LoopState, Expirations]:
        after, u_in = env.expire(plant, scenario, loop, step)
        return after, Expirations(scored(loop), u_in)

    steps = jnp.arange(protocol.BREATH_STEPS)
    start = (env.start_breath(plant, scenario), state)
    (loop, state), inspirations = jax.lax.scan(inspire, start, steps[:INSPIRATION])
    expirations = None
    if whole:
        _, expirations = jax.lax.scan(expire, loop, steps[INSPIRATION:])
    return state, (inspirations, expirations)


@partial(jax.jit, static_argnames="whole")
def closed_loop(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    whole: bool = False,
) -> tuple[Inspirations, Expirations | None]:
    """Run a pure controller through the protocol on one lung, all cells at once.

    Args:
        plant: any plant that can be varied.
        controller: parameters broadcast against the cells.
        scenario: the cells, batch shape ``(...)``.
        whole: simulate the expirations too (for pictures; no score depends on them).

    Returns:
        The inspirations, and the expirations if asked for.
    """
    varied = env.vary(plant, scenario)
    run = partial(_breath, varied, controller, scenario, whole)
    _, out = jax.lax.scan(run, controller.init(scenario.pip.shape), jnp.arange(BREATHS))
    # Scans stack time in front: (breath, step, ...) -> (..., breath, step).
    return jax.tree.map(lambda x: jnp.moveaxis(x, (0, 1), (-2, -1)), out)
