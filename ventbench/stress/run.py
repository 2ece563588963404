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
from numpy.typing import NDArray

from ventbench.base import precision
from ventbench.entries import stepping
from ventbench.entries.errors import Failure
from ventbench.entries.folder import Submission
from ventbench.entries.runner import Runner
from ventbench.entries.stepping import ProtocolRun
from ventbench.plants.rigs import Rigs
from ventbench.stress.plants import Stressed, stressed_plants
from ventbench.stress.results import DRAWS, pip_columns
from ventbench.stress.stressors import Condition
from ventbench.task import draws as draw_tables
from ventbench.task import protocol
from ventbench.task.draws import Draws
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant, Task
from ventbench.task.lungs import Lung

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
    parts, failures = [], {}
    for draw in range(draws.nominal_pip.shape[1]):
        run = _batch(_only(draws, draw), conditions, runner, submission)
        parts.append(run)
        for (cell,), failure in run.failures.items():
            condition, lung = divmod(cell, len(draws.lungs))
            failures[condition, lung, draw] = failure
    shape = (len(conditions), len(draws.lungs))

    def joined(name: str) -> Floats:
        each = (np.asarray(getattr(part, name)) for part in parts)
        return np.stack([x.reshape(*shape, *x.shape[1:]) for x in each], axis=2)

    return StressRun(
        joined("pressure"), joined("requested"), joined("u_in"), joined("volume"), failures
    )


def _only(draws: StressDraws, draw: int) -> StressDraws:
    """Take one draw."""

    def chosen(leaf: Any) -> Any:
        return np.asarray(leaf)[:, draw : draw + 1]

    scenario, plants = jax.tree.map(chosen, (draws.scenario, draws.plants))
    return StressDraws(draws.lungs, plants, scenario, chosen(draws.nominal_pip), draws.drawn)


def _batch(
    draws: StressDraws, conditions: Sequence[Condition], runner: Runner, submission: Submission
) -> ProtocolRun:
    """Run of all cells on one axis."""
    with precision.float64():
        plants, scenario = flat(draws, conditions)
        # Nothing tells a controller that it is stressed.
        task = Task("robustness", None, protocol.DT, protocol.INSPIRATION_STEPS)
        tasks = [task] * scenario.pip.shape[0]
        try:
            return stepping.step_through(plants, scenario, runner, submission, tasks, changing=True)
        except stepping.PlantError as error:
            condition = conditions[error.index // len(draws.lungs)]
            raise FloatingPointError(
                f"the plant under {condition.id} answered with NaN or infinity"
            ) from error
