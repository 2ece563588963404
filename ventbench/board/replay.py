"""Recorded commands through the frozen simulators again: no code of a submission is needed.

Commands do not answer to pressures here, and every inspiration starts from the lung at PEEP, so
that all breaths of all cells of several records advance together, 33 steps in all. Numbers agree
with those of the scorer to 1e-9; matrix products of another batch size may round differently.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import environment as env
from ventbench import precision, protocol
from ventbench.board.replayed import Replayed, Simulators
from ventbench.interfaces import Plant
from ventbench.metrics import safety
from ventbench.metrics.waveform import run_error
from ventbench.scenario import Scenario
from ventbench.submissions.scoring import protocol_cells
from ventbench.submissions.stepping import as_float64

Floats = NDArray[np.float64]

#: The breath whose nominal inspirations are kept for the page.
TRACE_BREATH = max(protocol.SCORED_BREATHS)

#: Records replayed together; the last ones are padded, so that one compilation does for all.
BATCH = 4


@jax.jit
def _pressures(plants: Plant, cells: Scenario, requested: Array) -> Array:
    """Pressures of shape ``(L, n, ..., S)`` for commands of that shape and cells ``(...)``."""

    def lung(plant: Plant, commands: Array) -> Array:
        varied = env.vary(plant, cells)
        start = env.start_breath(varied, cells)

        def step(bench: env.Bench, u_in: Array) -> tuple[env.Bench, Array]:
            after, _ = env.inspire(varied, cells, bench, u_in)
            return after, after.pressure

        def inspiration(commands: Array) -> Array:
            # The last command acts after the last scored pressure.
            _, pressure = jax.lax.scan(step, start, jnp.moveaxis(commands, -1, 0)[:-1])
            first = jnp.broadcast_to(start.pressure, pressure.shape[1:])
            return jnp.moveaxis(jnp.concatenate([first[None], pressure]), 0, -1)

        return jax.vmap(inspiration)(commands)

    return jax.vmap(lung)(plants, requested)


_members = jax.jit(jax.vmap(_pressures, in_axes=(0, None, None)))


def _breaths_first(requested: Floats) -> Array:
    """From ``(N, L, ..., B, S)`` to ``(L, N B, ..., S)``."""
    moved = np.moveaxis(requested, (1, -2), (0, 2))
    return jnp.asarray(moved.reshape(moved.shape[0], -1, *moved.shape[3:]))


def _breaths_last(values: Array, count: int) -> Floats:
    """Back again."""
    array = np.asarray(values)
    split = array.reshape(array.shape[0], count, protocol.BREATHS, *array.shape[2:])
    return np.moveaxis(split, (0, 2), (1, -2))


def pressures(simulators: Simulators, pips: Sequence[float], requested: Floats) -> Floats:
    """True airway pressures that commands give.

    Args:
        simulators: L lungs.
        pips: cmH2O, length P.
        requested: %, shape ``(N, L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``, nominal cells first.

    Returns:
        cmH2O, shape of ``requested``.
    """
    with precision.float64():
        cells = protocol_cells(tuple(pips), requested.shape[2] - 1)
        plants = as_float64(simulators.plants, requested.shape[1])
        found = _pressures(plants, cells, _breaths_first(requested))
    return _breaths_last(found, len(requested))


def spread(simulators: Simulators, pips: Sequence[float], requested: Floats) -> Floats:
    """Disagreement of the ensemble along an entry's own nominal trajectory.

    Sample standard deviation over members of the pressure that the same commands give, averaged
    over the scored inspiratory steps. An entry that lives on errors of one simulator shows a large
    one; its mean over all cells is the exploitation index.

    Args:
        simulators: L lungs, M members.
        pips: cmH2O, length P.
        requested: nominal commands, %, shape ``(N, L, P, BREATHS, INSPIRATION_STEPS)``.

    Returns:
        cmH2O, shape ``(N, L, P)``; NaN for fewer than two members.
    """
    leaves = jax.tree.leaves(simulators.ensemble)
    members, lungs = leaves[0].shape[:2]
    if members < 2:
        return np.full(requested.shape[:3], np.nan)
    with precision.float64():
        cells = protocol_cells(tuple(pips), 0)
        found = _members(
            as_float64(simulators.ensemble, members), cells, _breaths_first(requested[:, :, None])
        )
    each = np.stack([_breaths_last(found[m], len(requested)) for m in range(members)])
    over = np.std(each[:, :, :, 0], axis=0, ddof=1)
    assert over.shape[1] == lungs
    return np.mean(over[..., protocol.SCORED_BREATHS, :], axis=(-2, -1))


def replay(
    simulators: Simulators, pips: Sequence[float], requested: Sequence[Floats]
) -> Iterator[Replayed]:
    """Replay the commands of records of one shape, a few at a time.

    Args:
        simulators: L lungs.
        pips: cmH2O, length P.
        requested: of each record, %, shape ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``.
    """
    if not requested:
        return
    with precision.float64():
        cells = protocol_cells(tuple(pips), requested[0].shape[1] - 1)
    size = min(BATCH, len(requested))
    for first in range(0, len(requested), size):
        part = list(requested[first : first + size])
        together = np.stack([*part, *[part[-1]] * (size - len(part))])
        pressure = pressures(simulators, pips, together)
        apart = spread(simulators, pips, together[:, :, 0])
        for n, commands in enumerate(part):
            yield _measure(cells, commands, pressure[n], apart[n])


def _measure(cells: Scenario, requested: Floats, pressure: Floats, apart: Floats) -> Replayed:
    pip, dt = np.asarray(cells.pip), np.asarray(cells.dt)
    errors = run_error(pressure, pip[..., None, None])
    gate = safety.safe(pressure, pip[..., None], dt[..., None])
    above = pressure > safety.limit(pip[..., None, None])
    return Replayed(
        nominal=errors[:, 0],
        drawn=np.moveaxis(errors[:, 1:], 1, 0),
        safe=np.all(gate, axis=(1, 2, 3)),
        peak=np.moveaxis(pressure.max(axis=(3, 4)), 1, 0),
        steps_above=np.moveaxis(safety.longest_run(above).max(axis=-1), 1, 0),
        below=np.sum(requested < 0.0, axis=(1, 2, 3, 4)),
        above=np.sum(requested > protocol.U_MAX, axis=(1, 2, 3, 4)),
        spread=apart,
        pressure=pressure[:, 0, :, TRACE_BREATH],
        u_in=np.clip(requested[:, 0, :, TRACE_BREATH], 0.0, protocol.U_MAX),
    )
