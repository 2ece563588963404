"""The loop between plants and controllers: all cells together, only numbers between them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import environment as env
from ventbench import precision, protocol, rollouts
from ventbench.controllers.script import Script
from ventbench.environment import Scenario
from ventbench.interfaces import Observation, Plant, PlantT, Task
from ventbench.submissions.errors import Failure
from ventbench.submissions.folder import Submission
from ventbench.submissions.runner import Runner, pack

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ProtocolRun:
    """Inspirations of all cells; arrays of shape ``(L, ..., BREATHS, INSPIRATION_STEPS)``.

    L lungs; ``(...)`` is the batch shape of the scenario.

    Attributes:
        pressure: scored pressure at each step, cmH2O.
        requested: what the controllers asked for, %; 0 once a cell has failed.
        u_in: what was applied, %.
        failures: what failed, by cell, index ``(lung, ...)``.
        act_seconds: time that one ``act`` took on average, s, for each round of all cells, shape
            ``(BREATHS * INSPIRATION_STEPS,)``.
    """

    pressure: Floats
    requested: Floats
    u_in: Floats
    failures: Mapping[tuple[int, ...], Failure]
    act_seconds: Floats


def as_float64(plants: PlantT, count: int) -> PlantT:
    """Return stacked plants with 64-bit leaves.

    Args:
        plants: one plant whose leaves have the lungs on their leading axis.
        count: number of lungs.

    Raises:
        ValueError: if a leaf has another leading axis.
    """

    def convert(leaf: Any) -> Array:
        leaf = jnp.asarray(leaf)
        if leaf.shape[:1] != (count,):
            raise ValueError(
                f"a plant's parameter of shape {leaf.shape} is not stacked over {count} lungs"
            )
        return leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return jax.tree.map(convert, plants)


def _strong(tree: Any) -> Any:
    """Drop weak types, which would make the second step compile anew."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), tree)


# Axis of the lungs in the scenario: none where all lungs have the same cells (version 1).
@partial(jax.jit, static_argnames="axis")
def _begin(plants: Plant, scenario: Scenario, axis: int | None = 0) -> tuple[Plant, env.LoopState]:
    def begin(plant: Plant, scenario: Scenario) -> tuple[Plant, env.LoopState]:
        varied = env.vary(plant, scenario)
        return varied, env.start_breath(varied, scenario)

    return _strong(jax.vmap(begin, in_axes=(0, axis))(plants, scenario))


@partial(jax.jit, static_argnames="axis")
def _observe(
    scenario: Scenario, loop: env.LoopState, breath: Array, step: Array, axis: int | None = 0
) -> Observation:
    def observe(scenario: Scenario, loop: env.LoopState) -> Observation:
        return env.observe(scenario, loop, breath, step)

    return jax.vmap(observe, in_axes=(axis, 0))(scenario, loop)


@partial(jax.jit, static_argnames="axis")
def _inspire(
    plants: Plant, scenario: Scenario, loop: env.LoopState, u_in: Array, axis: int | None = 0
) -> tuple[env.LoopState, Array]:
    return _strong(jax.vmap(env.inspire, in_axes=(0, axis, 0, 0))(plants, scenario, loop, u_in))


_airway_pressure = jax.jit(jax.vmap(env.airway_pressure))


def step_through(
    plants: Plant,
    scenario: Scenario,
    runner: Runner,
    submission: Submission,
    tasks: Sequence[Task],
    *,
    version: int = 2,
) -> ProtocolRun:
    """Run a submission on every lung and cell. Call it within ``precision.float64()``.

    Args:
        plants: from :func:`as_float64`, L lungs; in version 2 the leaves may have the cells' batch
            shape too, ``(L, ..., )`` with axes of length 1 where cells share a plant.
        scenario: cells of each lung, batch shape ``(...)`` in version 1, ``(L, ...)`` in version 2.
        runner: runs the controllers.
        submission: whose they are.
        tasks: what is told of each lung, length L.
        version: of the protocol. Version 1 has the same cells on all lungs and scores the reading
            of the sensor, version 2 the airway pressure.

    Raises:
        SubmissionError: if the submission cannot be run at all.
        FloatingPointError: if a plant answers with NaN or infinity.
    """
    axis = None if version == 1 else 0
    batch = np.shape(scenario.pip) if version > 1 else (len(tasks), *scenario.pip.shape)
    cells = int(np.prod(batch))
    shape = (*batch, protocol.BREATHS, protocol.INSPIRATION_STEPS)
    pressure, requested, applied = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    seconds = []
    varied, rest = _begin(plants, scenario, axis)
    each = [task for task in tasks for _ in range(cells // len(tasks))]
    with precision.float32():  # a submission that uses JAX finds it as it is elsewhere
        session = runner.start(submission, each)
    try:
        for breath in range(protocol.BREATHS):
            loop = rest
            for step in range(protocol.INSPIRATION_STEPS):
                rows = pack(_observe(scenario, loop, breath, step, axis))
                live = max(1, cells - len(session.failures))
                start = time.perf_counter()
                with precision.float32():
                    commands = session.act(rows)
                seconds.append((time.perf_counter() - start) / live)
                commands = commands.reshape(batch)
                now = (..., breath, step)
                scored = loop.pressure if version == 1 else _airway_pressure(varied, loop)
                pressure[now], requested[now] = scored, commands
                loop, applied[now] = _inspire(varied, scenario, loop, commands, axis)
        failures = dict(session.failures)
    finally:
        session.close()
    broken = np.flatnonzero(~np.isfinite(pressure).reshape(len(tasks), -1).all(axis=1))
    if broken.size:
        raise FloatingPointError(f"simulator {broken[0]} answered with NaN or infinity")
    by_cell = {tuple(int(i) for i in np.unravel_index(k, batch)): v for k, v in failures.items()}
    return ProtocolRun(pressure, requested, applied, by_cell, np.array(seconds))


def replay(
    plants: Plant, scenario: Scenario, requested: Floats, *, version: int = 2
) -> tuple[rollouts.Inspirations, rollouts.Expirations]:
    """Apply recorded commands again, with the expirations. Call it within ``float64()``.

    Args:
        plants: from :func:`as_float64`, L lungs.
        scenario: cells, as in :func:`step_through`.
        requested: as in :class:`ProtocolRun`.
        version: of the protocol, as in :func:`step_through`.

    Returns:
        Arrays of shape ``(L, ..., BREATHS, steps)``, cmH2O and %.
    """

    def run(plant: Plant, scenario: Scenario, commands: Array) -> Any:
        airway = version > 1
        return rollouts.closed_loop(plant, Script(commands), scenario, whole=True, airway=airway)

    commands = jnp.asarray(requested.reshape(*requested.shape[:-2], -1))
    return jax.vmap(run, in_axes=(0, None if version == 1 else 0, 0))(plants, scenario, commands)
