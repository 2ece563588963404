"""What is scored: cells, the plants that they run on, and the bounds of the score.

A cell is a lung on one of its rigs, a PIP, deviations of ventilator and sensor, and a condition.
All conditions share their cells, so that each stressed run has an unstressed twin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.entries.reference import Reference, reference_of
from ventbench.entries.runs import pip_columns
from ventbench.plants.corrected import Stressed, stressed_plants
from ventbench.plants.rigs import Rigs
from ventbench.task import draws as draw_tables
from ventbench.task import protocol
from ventbench.task.draws import Draws
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung
from ventbench.task.stressors import Condition, conditions, stressor


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of L lungs under S conditions: n draws and P PIPs of each.

    Attributes:
        lungs: length L.
        conditions: length S; the first is none.
        plants: leaves ``(L, n, 1, ...)``, or ``(L, ...)`` where each lung has one rig.
        scenario: deviations, batch shape ``(L, n, P)``.
        pips: PIP before its deviation, cmH2O, ``(L, n, P)``.
        draw: counted from 1; 0 without deviations, ``(n,)``.
        rig: session of each lung, ``(L, n)``.
        member: member of the ensemble, ``(L, n)``.
    """

    lungs: tuple[Lung, ...]
    conditions: tuple[Condition, ...]
    plants: Plant
    scenario: Scenario
    pips: Floats
    draw: Ints
    rig: Ints
    member: Ints

    def stressed(self, draw: int) -> tuple[Stressed, Scenario]:
        """One draw under every condition, as 64-bit arrays: call it within ``float64()``.

        Returns:
            Plants as of :func:`~ventbench.plants.corrected.stressed_plants`, and cells of batch
            shape ``(S * L,)``; there must be one PIP.
        """
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[None, :, draw : draw + 1, 0], self.plants)
        plants = stressed_plants(one, self.lungs, self.conditions)
        scenario = jax.tree.map(
            lambda leaf: np.concatenate([np.asarray(leaf)[:, draw, 0]] * len(self.conditions)),
            self.scenario,
        )
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (plants, scenario))


@dataclass(frozen=True, eq=False)
class Protocol:
    """All that a score depends on besides the submission; make it with :func:`protocol_of`.

    Attributes:
        rigs: the plants.
        pips: nominal PIPs, cmH2O, length P.
        drawn: K draws; None without.
        cells: nominal cells on the reference rigs in front of the draws, without a stressor.
        stressed: the same draws under missing physics, one PIP of each lung and draw; or None.
        reference: best attainable and best PID of the first cells; None where it was not computed
            for these simulators and draws.
    """

    rigs: Rigs
    pips: tuple[float, ...]
    drawn: Draws | None
    cells: Cells
    stressed: Cells | None
    reference: Reference | None

    @property
    def simulators(self) -> Mapping[str, Any]:
        """Version and hashes of the plants."""
        return self.rigs.about


def protocol_of(
    rigs: Rigs,
    *,
    draws: int = 0,
    drawn: Draws | None = None,
    pips: Sequence[float] = protocol.PIPS,
    stress: int = 0,
    stressors: Sequence[str] = (),
    reference: Reference | None = None,
) -> Protocol:
    """Say what is scored.

    Args:
        rigs: from :func:`ventbench.plants.rigs.load_rigs`.
        draws: how many of the development draws to run besides the nominal cells.
        drawn: other draws instead.
        pips: cmH2O.
        stress: how many ranked draws to run under missing physics.
        stressors: names of the stressors; all conditions if empty.
        reference: best attainable and best PID of these simulators and draws; the published one if
            not given and it is of these.

    Raises:
        InputError: if there are no such draws or stressors, or the reference is of others.
    """
    pips = tuple(float(pip) for pip in pips)
    if draws < 0 or stress < 0:
        raise InputError(f"{min(draws, stress)} draws: there cannot be fewer than none")
    every = drawn
    if drawn is None and draws:
        drawn = rigs.draws(draws, pips)
    if stress:
        every = rigs.draws(draw_tables.COUNT) if every is None else every
        whole = every.only(np.flatnonzero(every.ranked)).first(stress)
    if pips == protocol.PIPS:
        about = None if drawn is None else drawn.about()
        reference = reference_of(rigs.about, about, reference)
    return Protocol(
        rigs,
        pips,
        drawn,
        _nominal_and_drawn(rigs, drawn, pips),
        _under_stress(rigs, whole, chosen_conditions(stressors)) if stress else None,
        reference,
    )


def _nominal_and_drawn(rigs: Rigs, drawn: Draws | None, pips: tuple[float, ...]) -> Cells:
    plants, scenario = rigs.cells(drawn, pips)
    shape = np.shape(scenario.pip)
    rig, member = np.zeros(shape[:2], np.int64), np.zeros(shape[:2], np.int64)
    if rigs.sessions is not None:
        rig[:, 0] = [own[0] for own in rigs.sessions]
    if drawn is not None:
        rig[:, 1:], member[:, 1:] = drawn.rig, drawn.member
    nominal = np.broadcast_to(np.array(pips), shape)
    every = np.arange(shape[1])
    return Cells(rigs.lungs, (Condition(),), plants, scenario, nominal, every, rig, member)


def _under_stress(rigs: Rigs, drawn: Draws, chosen: tuple[Condition, ...]) -> Cells:
    """One PIP of each lung and draw; each lung has each PIP once in six draws."""
    count, n = len(rigs.lungs), drawn.count
    columns = pip_columns(count, n)
    at = (np.arange(count)[:, None], np.arange(n), columns)
    scenario = jax.tree.map(lambda leaf: np.asarray(leaf)[at][:, :, None], drawn.cells)
    if rigs.sessions is None:
        plants = jax.tree.map(
            lambda leaf: np.repeat(np.asarray(leaf)[:, None, None], n, axis=1), rigs.plants
        )
    else:
        plants = rigs.plants_of(drawn)
    nominal = np.asarray(protocol.PIPS)[columns][:, :, None]
    every = np.arange(1, n + 1)
    return Cells(rigs.lungs, chosen, plants, scenario, nominal, every, drawn.rig, drawn.member)


def chosen_conditions(stressors: Sequence[str]) -> tuple[Condition, ...]:
    """All conditions, or no stressor and those of some stressors alone.

    Raises:
        InputError: if there is no such stressor.
    """
    names = {stressor(name).name for name in stressors}
    return tuple(c for c in conditions() if not names or set(c.stressors) <= names)
