"""Recorded commands through the frozen simulators again: no code of a submission is needed.

All cells of several records advance together. Numbers agree with those of the scorer to 1e-9;
matrix products of another batch size may round differently.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.board.record import Record
from ventbench.board.rounds import Round
from ventbench.board.schema import ScoreHeader
from ventbench.entries.cells import as_float64
from ventbench.plants.rigs import rigs_of
from ventbench.task import draws as draw_tables
from ventbench.task import protocol, rollouts
from ventbench.task.draws import Draws
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant
from ventbench.task.metrics.score import (
    controllable_error,
    longest_run,
    passes_safety_gate,
    run_error,
    safety_limit,
)
from ventbench.task.rollouts import Script

#: The breath whose nominal inspirations are kept for the page.
TRACE_BREATH = max(protocol.SCORED_BREATHS)

#: Records replayed together; the last ones are padded, so that one compilation does for all.
BATCH = 4

#: How far a replayed number may be off, cmH2O; matrix products round differently elsewhere.
TOLERANCE = 1e-9

#: How far the mean over the cells of a draw may be off, cmH2O. Rounding differs from cell to cell
#: (1e-14 on the machines tried); only a hand that lowers all cells moves their mean.
MEAN_TOLERANCE = 1e-11

# What is rounded to 0.01 cmH2O or 0.1 %: half of that, and a little for ties.
_CENTI, _TENTH = 0.005 + 1e-6, 0.05 + 1e-6


class ReplayPlants(Protocol):
    """What :func:`ventbench.plants.frozen.load` returns."""

    @property
    def plants(self) -> Any:
        """Stacked over the lungs."""

    @property
    def ensemble(self) -> Any:
        """The plants of every seed, stacked over members, then lungs."""

    def about(self) -> Mapping[str, Any]:
        """Version and hashes, as they go into a record."""
        ...


@dataclass(frozen=True)
class Replayed:
    """What the commands of one record give; L lungs, P PIPs, K draws."""

    nominal: Floats  #: error of the nominal runs, cmH2O, shape ``(L, P)``.
    drawn: Floats  #: error of the drawn runs, cmH2O, shape ``(K, L, P)``.
    safe: Bools  #: whether all runs of a lung pass the safety gate, shape ``(L,)``.
    #: highest pressure of each run, nominal ones first, cmH2O, shape ``(1 + K, L, P)``.
    peak: Floats
    #: longest time above the safety limit of each run, steps, shape ``(1 + K, L, P)``.
    steps_above: Ints
    below: Ints  #: how many commands were below 0 %, nominal and drawn, shape ``(L,)``.
    above: Ints  #: how many commands were above 100 %, nominal and drawn, shape ``(L,)``.
    spread: Floats  #: see :func:`spread`, cmH2O, shape ``(L, P)``.
    pressure: Floats  #: nominal inspiration of :data:`TRACE_BREATH`, cmH2O, shape ``(L, P, S)``.
    u_in: Floats  #: commands of that inspiration as applied, %, shape ``(L, P, S)``.
    first: Floats  #: first command of each run, %, shape ``(1 + K, L, P)``.
    controllable: Floats  #: error without the first step, cmH2O, shape ``(1 + K, L, P)``.
    session: Ints  #: rig of each draw, shape ``(L, K)``.
    member: Ints  #: member of the ensemble, shape ``(L, K)``.


@jax.jit
def _pressures(plants: Plant, cells: Scenario, requested: Array) -> Array:
    """Airway pressures of breaths for commands ``(N, L, ..., B, S)``; cells ``(L, ...)``."""

    def run(commands: Array, plant: Plant, cells: Scenario) -> Array:
        script = Script(commands.reshape(*commands.shape[:-2], -1))
        phases = rollouts.closed_loop(plant, script, cells, whole=True)
        return jnp.concatenate([phase.pressure for phase in phases], axis=-1)

    return jax.vmap(jax.vmap(run), (0, None, None))(requested, plants, cells)


_members = jax.jit(jax.vmap(_pressures, in_axes=(0, None, None)))


def pressures(
    simulators: ReplayPlants,
    pips: Sequence[float],
    requested: Floats,
    draws: Draws | None,
) -> Floats:
    """Airway pressures that commands of L lungs give, cmH2O, ``(N, L, 1 + K, P, BREATHS, steps)``.

    Whole breaths of ``BREATH_STEPS`` steps.

    Args:
        simulators: L lungs.
        pips: cmH2O, length P.
        requested: %, shape ``(N, L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``, nominal cells first.
        draws: K of them; None for nominal cells alone.
    """
    with compilation.float64():
        plants, cells = rigs_of(simulators).cells(draws, pips)
        plants = as_float64(plants, requested.shape[1])
        return np.asarray(_pressures(plants, cells, jnp.asarray(requested)))


def spread(simulators: ReplayPlants, pips: Sequence[float], requested: Floats) -> Floats:
    """Disagreement of the ensemble along an entry's own nominal trajectory.

    Sample standard deviation over members of the pressure that the same commands give, averaged
    over the scored inspiratory steps. An entry that lives on errors of one simulator shows a large
    one; its mean over all cells is the exploitation index.

    Of nominal commands, %, ``(N, L, P, BREATHS, INSPIRATION_STEPS)``: cmH2O, ``(N, L, P)``; NaN for
    fewer than two members.
    """
    leaves = jax.tree.leaves(simulators.ensemble)
    members, lungs = leaves[0].shape[:2]
    if members < 2:
        return np.full(requested.shape[:3], np.nan)
    with compilation.float64():
        cells, _, _ = draw_tables.with_nominal(None, [0] * lungs, pips)
        plants = as_float64(simulators.ensemble, members)
        by_member = np.asarray(_members(plants, cells, jnp.asarray(requested[:, :, None])))
    deviation = np.std(by_member[:, :, :, 0], axis=0, ddof=1)
    assert deviation.shape[1] == lungs
    scored = deviation[..., protocol.SCORED_BREATHS, : protocol.INSPIRATION_STEPS]
    return np.mean(scored, axis=(-2, -1))


def draws_of(header: ScoreHeader, simulators: ReplayPlants, rounds: Mapping[str, Round]) -> Draws:
    """Make the draws that a record names again: the development draws, or those of a round by name.

    Raises:
        InputError: if they are neither.
    """
    recorded, rigs = header.draws.about(), rigs_of(simulators)
    own = rounds.get(header.draws.season)
    drawn = rigs.draws(draw_tables.COUNT) if own is None else own.draws(rigs)
    if drawn.about() != recorded:
        raise InputError("key draws: neither the development draws nor those of a round")
    return drawn


def replay(
    simulators: ReplayPlants,
    pips: Sequence[float],
    requested: Sequence[Floats],
    draws: Draws,
) -> Iterator[Replayed]:
    """Replay the commands of records of one shape over K draws, a few at a time.

    Each record has commands, %, of shape ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``.
    """
    if not requested:
        return
    with compilation.float64():
        _, cells = rigs_of(simulators).cells(draws, pips)
    size = min(BATCH, len(requested))
    for first in range(0, len(requested), size):
        batch = list(requested[first : first + size])
        padded = np.stack([*batch, *[batch[-1]] * (size - len(batch))])
        pressure = pressures(simulators, pips, padded, draws)
        spreads = spread(simulators, pips, padded[:, :, 0])
        for n, commands in enumerate(batch):
            yield _measure(cells, draws, commands, pressure[n], spreads[n])


def _measure(
    cells: Scenario, draws: Draws, requested: Floats, breaths: Floats, spread: Floats
) -> Replayed:
    pip, dt = np.asarray(cells.pip), np.asarray(cells.dt)
    pressure = breaths[..., : protocol.INSPIRATION_STEPS]
    errors = run_error(pressure, pip[..., None, None])
    gate = passes_safety_gate(breaths, pip[..., None], dt[..., None])
    above = pressure > safety_limit(pip[..., None, None])
    return Replayed(
        nominal=errors[:, 0],
        drawn=np.moveaxis(errors[:, 1:], 1, 0),
        safe=np.all(gate, axis=(1, 2, 3)),
        peak=np.moveaxis(pressure.max(axis=(3, 4)), 1, 0),
        steps_above=np.moveaxis(longest_run(above).max(axis=-1), 1, 0),
        below=np.sum(requested < 0.0, axis=(1, 2, 3, 4)),
        above=np.sum(requested > protocol.U_MAX, axis=(1, 2, 3, 4)),
        spread=spread,
        pressure=pressure[:, 0, :, TRACE_BREATH],
        u_in=np.clip(requested[:, 0, :, TRACE_BREATH], 0.0, protocol.U_MAX),
        first=np.moveaxis(requested[..., 0, 0], 1, 0),
        controllable=np.moveaxis(controllable_error(pressure, pip[..., None, None]), 1, 0),
        session=draws.rig,
        member=draws.member,
    )


def deviation(record: Record, replayed: Replayed) -> float:
    """Largest difference of an error, cmH2O; infinity where one of them does not exist."""
    pairs = ((record.nominal, replayed.nominal), (record.drawn, replayed.drawn))
    return max(float(np.max(_off(*pair), initial=0.0)) for pair in pairs)


def differences(record: Record, replayed: Replayed) -> list[str]:
    """What differs, by key of the record; empty if the record is what its commands give."""
    header, clipped = record.header, record.header.clipped
    size = int(np.prod(header.actions.shape))
    failed = np.isnan(record.nominal).any(axis=1) | np.isnan(record.drawn).any(axis=(0, 2))
    checks: tuple[Check, ...] = (
        ("errors.nominal", record.nominal, replayed.nominal, TOLERANCE),
        ("errors.drawn", record.drawn, replayed.drawn, TOLERANCE),
        ("spread", record.spread, replayed.spread, TOLERANCE),
        ("safe", header.safe, replayed.safe & ~failed, 0.0),
        ("peak_pressure_cmH2O", header.peak_pressure_cmH2O, replayed.peak.max((0, 2)), TOLERANCE),
        ("safety.peak_centi_cmH2O", record.peak, replayed.peak, _CENTI),
        ("safety.steps_above", record.steps_above, replayed.steps_above, 0.0),
        ("clipped.below", clipped.below, replayed.below, 0.0),
        ("clipped.above", clipped.above, replayed.above, 0.0),
        ("clipped.commands", clipped.commands, size, 0.0),
        ("trace.pressure_centi_cmH2O", record.pressure, replayed.pressure, _CENTI),
        ("trace.u_in_tenths_percent", record.u_in, replayed.u_in, _TENTH),
        ("headroom.error", record.headroom.error, replayed.controllable, TOLERANCE),
        # They decide which draws rank, and what the tests of ranks take as a unit.
        ("rigs.session", record.headroom.session, replayed.session, 0.0),
        ("rigs.member", record.headroom.member, replayed.member, 0.0),
    )
    texts = worst(checks)
    for key, recorded, given in (
        ("errors.nominal", record.nominal, replayed.nominal),
        ("errors.drawn", record.drawn, replayed.drawn),
        ("headroom.error", record.headroom.error, replayed.controllable),
    ):
        if np.all(_off(recorded, given) <= TOLERANCE):
            of_draws, now = (
                x.mean(axis=(-2, -1)) for x in (recorded, given)
            )  # NaN if a cell failed
            texts += worst([(f"{key}, mean over cells", of_draws, now, MEAN_TOLERANCE)])
    return texts + lung_leaks(record, replayed)


def lung_leaks(record: Record, replayed: Replayed) -> list[str]:
    """Find first commands of the robustness track that differ from lung to lung.

    The first observation of a nominal run is that of a lung at PEEP: start, target and step are
    common to all lungs. A controller that is not told the lung cannot answer differently; one that
    does has learned it, or nobody has computed its commands from observations. The reverse is no
    proof of honesty. Failed runs are left out.

    Returns:
        One sentence for the first PIP that shows it; empty if none does.
    """
    if record.track != "robustness":
        return []
    failed = np.isnan(record.nominal)
    highest = np.max(np.where(failed, -np.inf, replayed.first[0]), axis=0)
    lowest = np.min(np.where(failed, np.inf, replayed.first[0]), axis=0)
    apart = np.flatnonzero(highest > lowest)
    if not len(apart):
        return []
    pip = apart[0]
    return [
        f"key actions: in the nominal run at PIP {record.pips[pip]:g} the first command is "
        f"{lowest[pip]:g} % on one lung and {highest[pip]:g} % on another, though the first "
        "observation is the same: the lung was known"
    ]


#: A key of a record, its values there and now, and how far they may be off.
Check = tuple[str, ArrayLike, ArrayLike, float]


def worst(checks: Iterable[Check], source: str = "its commands") -> list[str]:
    """Describe the worst value of each key that is off by more than its tolerance.

    What has no value in the record is off by nothing; ``source`` says what gives the values now.
    """
    texts = []
    for key, recorded, given, tolerance in checks:
        recorded, given = np.asarray(recorded, float), np.asarray(given, float)
        if recorded.shape != given.shape:
            texts.append(f"key {key} has shape {recorded.shape}, {source} give {given.shape}")
            continue
        off = _off(recorded, given)
        if not np.all(off <= tolerance):
            at: Any = np.unravel_index(int(np.argmax(off)), off.shape)
            place = "".join(f"[{i}]" for i in at)
            said, now = f"{recorded[at]:.15g}", f"{given[at]:.15g}"
            texts.append(f"key {key}{place} says {said}, {source} give {now}")
    return texts


def _off(recorded: ArrayLike, replayed: ArrayLike) -> np.ndarray:
    """Differences; 0 in failed cells, whose commands nobody gave, infinity where one is missing."""
    recorded, replayed = np.asarray(recorded, float), np.asarray(replayed, float)
    off = np.nan_to_num(np.abs(recorded - replayed), nan=np.inf)
    return np.where(np.isnan(recorded), 0.0, off)
