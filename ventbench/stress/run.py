"""Cells of the stress track, and the loop between them and a submission.

A cell is a lung on one of its rigs, a PIP, deviations of ventilator and sensor, and a condition.
The same draws serve every condition, so that each stressed run has an unstressed twin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import draws as draw_tables
from ventbench import environment as env
from ventbench import precision, protocol, waveform
from ventbench.draws import Draws
from ventbench.environment import Scenario
from ventbench.interfaces import Controller, Plant, Task
from ventbench.lungs import Lung
from ventbench.plants.rigs import Rigs
from ventbench.stress.plants import Stressed, stressed_plants
from ventbench.stress.results import DRAWS, pip_columns
from ventbench.stress.stressors import Condition
from ventbench.submissions.errors import Failure
from ventbench.submissions.folder import Submission
from ventbench.submissions.runner import Runner, pack

Floats = NDArray[np.float64]

#: Name of the track.
TRACK = "stress"


@dataclass(frozen=True, eq=False)
class StressDraws:
    """Lungs, rigs and deviations that every condition shares; L lungs, n draws.

    Attributes:
        lungs: length L.
        plants: scored plants, leaves ``(L, n, ...)``.
        scenario: deviations, batch shape ``(L, n)``.
        nominal_pip: PIP before its deviation, cmH2O, ``(L, n)``.
        drawn: the draws that they are taken from.
    """

    lungs: tuple[Lung, ...]
    plants: Plant
    scenario: Scenario
    nominal_pip: Floats
    drawn: Draws


def draw_cells(rigs: Rigs, n: int = DRAWS, *, drawn: Draws | None = None) -> StressDraws:
    """Take cells of draws, one PIP of each lung and draw.

    In each draw the lungs have different PIPs, and over six draws each lung has each PIP once.

    Args:
        rigs: from :func:`ventbench.plants.rigs.load_rigs`.
        n: number of draws.
        drawn: other draws than the development ones.

    Raises:
        InputError: if there are not so many draws.
    """
    drawn = rigs.draws(n) if drawn is None else drawn.first(n)
    count = len(rigs.lungs)
    at = (np.arange(count)[:, None], np.arange(n), pip_columns(count, n))
    scenario = jax.tree.map(lambda leaf: np.asarray(leaf)[at], drawn.cells)
    if rigs.sessions is None:
        plants = jax.tree.map(
            lambda leaf: np.repeat(np.asarray(leaf)[:, None], n, axis=1), rigs.plants
        )
    else:
        each = draw_tables.plants_of(rigs.plants, drawn.rig, drawn.member)
        plants = jax.tree.map(lambda leaf: leaf[:, :, 0], each)
    nominal = np.asarray(protocol.PIPS)[at[2]]
    return StressDraws(rigs.lungs, plants, scenario, nominal, drawn)


@dataclass(frozen=True)
class StressRun:
    """Inspirations of all cells; arrays of shape ``(S, L, n, BREATHS, INSPIRATION_STEPS)``.

    Attributes:
        pressure: true airway pressure at each step, cmH2O.
        requested: what the controllers asked for, %; 0 once a cell has failed.
        u_in: what was applied, %.
        volume: gas in the lung above that at the start of the breath, mL.
        failures: what failed, by cell, index ``(condition, lung, draw)``.
    """

    pressure: Floats
    requested: Floats
    u_in: Floats
    volume: Floats
    failures: Mapping[tuple[int, int, int], Failure]


@jax.jit
def _start(plant: Stressed, scenario: Scenario) -> tuple[Stressed, env.LoopState]:
    varied = plant.vary(scenario.r_scale, scenario.c_scale)
    rest = jnp.full_like(scenario.start, waveform.expiratory_command(protocol.BREATH_STEPS - 1))
    state = varied.init(scenario.start, scenario.peep)
    loop = env.LoopState(state, varied.first_reading(scenario.start), rest)
    return _strong((varied, loop))


@jax.jit
def _observe(scenario: Scenario, loop: env.LoopState, breath: Array, step: Array) -> Any:
    return env.observe(scenario, loop, breath, step)


@jax.jit
def _inspire(
    plant: Stressed, scenario: Scenario, loop: env.LoopState, u_in: Array
) -> tuple[env.LoopState, Array, Array, Array]:
    after, applied = env.inspire(plant, scenario, loop, u_in)
    truth = plant.airway_pressure(after.plant, after.pressure)
    return _strong((after, applied, truth, plant.volume(after.plant)))


def _strong(tree: Any) -> Any:
    """Drop weak types, which would make the second step compile anew."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, x.dtype), tree)


@jax.jit
def closed_loop(
    plants: Stressed, controller: Controller, scenario: Scenario
) -> tuple[Array, Array, Array, Array]:
    """Run a pure controller through all cells in one compiled scan.

    Args:
        plants: a plant for each breath, from :func:`flat`.
        controller: parameters broadcast against the cells.
        scenario: batch shape ``(N,)``.

    Returns:
        Pressure, cmH2O, request and command, %, and volume, mL, as in :class:`StressRun`, of shape
        ``(N, BREATHS, INSPIRATION_STEPS)``.
    """

    def run(state: Any, inputs: tuple[Stressed, Array]) -> Any:
        plant, breath = inputs
        varied, loop = _start(plant, scenario)

        def inspire(carry: Any, step: Array) -> Any:
            loop, truth, volume, state = carry
            state, requested = controller.step(state, env.observe(scenario, loop, breath, step))
            after, applied, reached, filled = _inspire(varied, scenario, loop, requested)
            return (after, reached, filled, state), (truth, requested, applied, volume)

        start = (loop, scenario.start, jnp.zeros_like(scenario.start), state)
        (*_, state), out = jax.lax.scan(inspire, start, jnp.arange(protocol.INSPIRATION_STEPS))
        return state, out

    breaths = (plants, jnp.arange(protocol.BREATHS))
    _, out = jax.lax.scan(run, controller.init(scenario.pip.shape), breaths)
    return jax.tree.map(lambda x: jnp.moveaxis(x, (0, 1), (-2, -1)), out)


def flat(draws: StressDraws, conditions: Sequence[Condition]) -> tuple[Stressed, Scenario]:
    """All cells on one axis, as 64-bit arrays: call it within ``precision.float64()``.

    Returns:
        Plants as of :func:`~ventbench.stress.plants.stressed_plants`, and cells of batch shape
        ``(S * L * n,)``.
    """
    plants = stressed_plants(draws.plants, draws.lungs, conditions)

    def repeated(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        every = np.broadcast_to(leaf, (len(conditions), *leaf.shape))
        return every.reshape(-1, *leaf.shape[2:])

    scenario = jax.tree.map(repeated, draws.scenario)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (plants, scenario))


def step_through(
    draws: StressDraws, conditions: Sequence[Condition], runner: Runner, submission: Submission
) -> StressRun:
    """Run a submission under every condition; the lung is not told.

    The draws run one after the other, all conditions and lungs of one together.

    Raises:
        SubmissionError: if the submission cannot be run at all.
        FloatingPointError: if a plant answers with NaN or infinity.
    """
    count = draws.nominal_pip.shape[1]
    parts, failures = [], {}
    for draw in range(count):
        drawn = _only(draws, draw)
        arrays, failed = _batch(drawn, conditions, runner, submission)
        parts.append(arrays)
        for cell, failure in failed.items():
            condition, lung = divmod(cell, len(draws.lungs))
            failures[condition, lung, draw] = failure
    shape = (len(conditions), len(draws.lungs))

    def joined(k: int) -> Floats:
        return np.stack([part[k].reshape(*shape, *part[k].shape[1:]) for part in parts], axis=2)

    return StressRun(joined(0), joined(1), joined(2), joined(3), failures)


def _only(draws: StressDraws, draw: int) -> StressDraws:
    """Take one draw."""

    def chosen(leaf: Any) -> Any:
        return np.asarray(leaf)[:, draw : draw + 1]

    scenario, plants = jax.tree.map(chosen, (draws.scenario, draws.plants))
    return StressDraws(draws.lungs, plants, scenario, chosen(draws.nominal_pip), draws.drawn)


def _batch(
    draws: StressDraws, conditions: Sequence[Condition], runner: Runner, submission: Submission
) -> tuple[tuple[Floats, ...], Mapping[int, Failure]]:
    """Arrays of :class:`StressRun` with all cells on one axis, and failures by cell."""
    with precision.float64():
        plants, scenario = flat(draws, conditions)
        cells = scenario.pip.shape[0]
        out = np.zeros((4, cells, protocol.BREATHS, protocol.INSPIRATION_STEPS))
        pressure, requested, u_in, volume = out
        # Nothing tells a controller that it is stressed.
        task = Task("robustness", None, protocol.DT, protocol.INSPIRATION_STEPS)
        with precision.float32():  # a submission that uses JAX finds it as it is elsewhere
            session = runner.start(submission, [task] * cells)
        try:
            for breath in range(protocol.BREATHS):
                own = jax.tree.map(lambda leaf, k=breath: leaf[k], plants)
                varied, loop = _start(own, scenario)
                truth, filled = scenario.start, np.zeros(cells)
                for step in range(protocol.INSPIRATION_STEPS):
                    rows = pack(_observe(scenario, loop, breath, step))
                    with precision.float32():
                        commands = session.act(rows)
                    now = (slice(None), breath, step)
                    pressure[now], volume[now], requested[now] = truth, filled, commands
                    loop, u_in[now], truth, filled = _inspire(varied, scenario, loop, commands)
            failures = dict(session.failures)
        finally:
            session.close()
    broken = np.flatnonzero(~np.isfinite(out).all(axis=(0, 2, 3)))
    if broken.size:
        condition = conditions[broken[0] // len(draws.lungs)]
        raise FloatingPointError(f"the plant under {condition.id} answered with NaN or infinity")
    return tuple(out), failures
