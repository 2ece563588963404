"""Recorded commands through the frozen simulators again: no code of a submission is needed.

Commands are whole numbers of the valve's step, so that every machine replays the same runs; what
follows from them, :class:`~ventbench.board.figures.Figures`, is computed by the code that scores.
Figures of records that were replayed before are kept in the user's cache, by the hash of all that
they follow from; a verification never reads it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax import Array

from ventbench.base import compilation, files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.executor import Progress
from ventbench.board import canonical, store
from ventbench.board.canonical import RECORDS
from ventbench.board.figures import Figures
from ventbench.board.record import Record
from ventbench.board.rounds import Round
from ventbench.board.schema import Commands, RecordedFailure, ScoreContent
from ventbench.board.store import Store
from ventbench.entries import cells as scored
from ventbench.entries.cells import Cells, Index, ProtocolRun, as_float64, gather
from ventbench.entries.reference import published
from ventbench.entries.runs import DRAWS, Runs
from ventbench.entries.scoring import runs_of
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import draws as draw_tables
from ventbench.task import environment, protocol, rollouts, stressors
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics.score import controllable_error, safety_limit

#: The breath whose nominal inspirations pages show.
TRACE_BREATH = max(protocol.SCORED_BREATHS)

#: How far a replayed number may be from the scorer's, cmH2O: matrix products of another batch size
#: round differently.
TOLERANCE = 1e-9


class ReplayPlants(Protocol):
    """What :func:`ventbench.plants.frozen.load` returns."""

    @property
    def ensemble(self) -> Any:
        """The plants of every seed, stacked over members, then lungs."""

    def about(self) -> Mapping[str, Any]:
        """Version and hashes, as they go into a record."""
        ...


#: Loads the frozen simulators.
Load = Callable[[], ReplayPlants]

#: What was derived before, by hashes of all that it follows from.
Memo = dict[Any, Any]


@jax.jit
def _breath(plants: Plant, scenario: Scenario, commands: Array, breath: Array) -> Any:
    """Both phases of one breath, steps last, for commands ``(L, ..., S)``; cells ``(L, ...)``."""

    def run(plant: Plant, cells: Scenario, commands: Array) -> Any:
        varied = environment.vary(plant, cells, breath)
        inputs = jnp.moveaxis(commands, -1, 0)
        loop, _, inspired = rollouts.inspiration(
            varied, cells, rollouts.commanded, breath=breath, inputs=inputs
        )
        phases = inspired, rollouts.expiration(varied, cells, loop)[1]
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), phases)

    return jax.vmap(run)(plants, scenario, commands)


def _breaths(plants: Sequence[Plant], scenario: Scenario, commands: Floats) -> Any:
    """Both phases of all breaths, with the plants of each, for commands ``(L, ..., B, S)``."""
    breaths = [
        jax.tree.map(np.asarray, _breath(plant, scenario, jnp.asarray(commands[..., k, :]), k))
        for k, plant in enumerate(plants)
    ]
    return jax.tree.map(lambda *x: np.stack(x, axis=-2), *breaths)


def run_of(cells: Cells, commands: Floats) -> ProtocolRun:
    """What commands, %, ``(S, L, n, P, BREATHS, INSPIRATION_STEPS)``, give on cells."""

    def run(at: Index, plants: Sequence[Plant], scenario: Scenario) -> ProtocolRun:
        own = commands[at].reshape(*np.shape(scenario.pip), *commands.shape[4:])
        inspired, expired = _breaths(plants, scenario, own)
        return ProtocolRun(
            inspired.pressure,
            inspired.requested,
            inspired.u_in,
            expired.pressure,
            np.full(own.shape, np.nan) if inspired.volume is None else inspired.volume,
            {},
            np.zeros(0),
        )

    with compilation.float64():
        return gather(cells, run)


def spread(simulators: ReplayPlants, pips: Sequence[float], requested: Floats) -> Floats:
    """Disagreement of the ensemble along an entry's own nominal trajectory.

    Sample standard deviation over members of the pressure that the same commands give, averaged
    over the scored inspiratory steps. An entry that lives on errors of one simulator shows a large
    one; its mean over all cells is the exploitation index.

    Of nominal commands, %, ``(L, P, BREATHS, INSPIRATION_STEPS)``: cmH2O, ``(L, P)``; NaN for fewer
    than two members.
    """
    members, lungs = jax.tree.leaves(simulators.ensemble)[0].shape[:2]
    if members < 2:
        return np.full(requested.shape[:2], np.nan)
    with compilation.float64():
        nominal, _, _ = draw_tables.with_nominal(None, [0] * lungs, pips)
        wide = as_float64(simulators.ensemble, members)
        by_member = []
        for k in range(members):
            plants = [jax.tree.map(lambda x, k=k: x[k], wide)] * protocol.BREATHS
            by_member.append(_breaths(plants, nominal, requested[:, None])[0].pressure[:, 0])
    deviation = np.std(by_member, axis=0, ddof=1)
    return np.mean(deviation[..., protocol.SCORED_BREATHS, :], axis=(-2, -1))


def _failed(failures: Sequence[RecordedFailure], cells: Cells) -> list[tuple[int, ...]]:
    """Cells of failures: condition, lung, draw and place of the PIP.

    Raises:
        InputError: if there is no such cell.
    """
    named = {cells.name(at): at for at in np.ndindex(len(cells.conditions), *cells.pips.shape)}
    indices = []
    for failure in failures:
        cell = (failure.condition, failure.lung, failure.pip, failure.draw or None)
        if cell not in named:
            raise InputError(
                f"key failures: there is no cell {failure.condition}, {failure.lung}, "
                f"PIP {failure.pip:g}, draw {failure.draw}"
            )
        indices.append(named[cell])
    return indices


def _runs(cells: Cells, commands: Floats, failures: Sequence[RecordedFailure]) -> Any:
    """Runs of commands of any shape, and their series."""
    shape = (len(cells.conditions), *cells.pips.shape, *commands.shape[-2:])
    run = run_of(cells, commands.reshape(shape))
    run = dataclasses.replace(run, failures=dict.fromkeys(_failed(failures, cells)))
    return run, runs_of(run, cells)


def figures_of(
    content: ScoreContent,
    commands: Floats,
    stressed: Floats | None,
    protocol_: scored.Protocol,
    simulators: ReplayPlants,
) -> Figures:
    """Derive the figures of a record.

    Args:
        content: of the record.
        commands: %, shape ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``.
        stressed: commands under missing physics, %; None without.
        protocol_: cells and bounds of its draws.
        simulators: that they are of.

    Raises:
        InputError: if it names a cell that is not there, or there are no bounds of its draws.
    """
    run, runs = _runs(protocol_.cells, commands, content.failures)
    under_stress = None
    if stressed is not None and protocol_.stressed is not None and content.stress is not None:
        _, under_stress = _runs(protocol_.stressed, stressed, content.stress.failures)
    if protocol_.reference is None or protocol_.drawn is None:
        raise InputError("key draws: there are no reference errors of these simulators and draws")
    size = protocol_.cells.pips.shape
    failed = np.isnan(runs.error[0]).reshape(size)
    pip = np.asarray(protocol_.cells.scenario.pip)[..., None, None]
    above = np.sum(run.breaths[0] > safety_limit(pip), axis=-1).max(axis=-1)

    def by_draw(values: Any) -> Any:
        return np.moveaxis(np.asarray(values).reshape(size), 1, 0)

    controllable = np.where(failed, np.nan, controllable_error(run.pressure[0], pip))
    disagreement = spread(simulators, protocol_.pips, commands[:, 0])
    return Figures(
        error=by_draw(runs.error[0]),
        controllable=by_draw(controllable),
        attainable=by_draw(protocol_.reference.attainable),
        pid=by_draw(protocol_.reference.pid),
        peak=by_draw(runs.peak[0]),
        steps_above=by_draw(above),
        safe=runs.safe[0].all(axis=-1),
        spread=np.where(failed[:, 0], np.nan, disagreement),
        pressure=run.pressure[0, :, 0, :, TRACE_BREATH],
        u_in=run.u_in[0, :, 0, :, TRACE_BREATH],
        first=np.where(failed[:, 0], np.nan, commands[:, 0, :, 0, 0]),
        rig=protocol_.drawn.rig,
        member=protocol_.drawn.member,
        stressed=under_stress,
    )


def protocol_of(
    header: ScoreContent, simulators: ReplayPlants, round_: Round | None
) -> scored.Protocol:
    """Cells and bounds of the draws that a record names: the development draws, or its round's.

    Raises:
        InputError: if the draws are neither, or the bounds are of others.
    """
    rigs = rigs_of(simulators)
    draws = rigs.draws(draw_tables.COUNT) if round_ is None else round_.draws(rigs)
    if draws.about() != header.draws.to_json():
        raise InputError("key draws: neither the development draws nor those of a round")
    reference = published() if round_ is None else round_.bounds()
    return scored.protocol_of(rigs, drawn=draws, stress=DRAWS, reference=reference)


def with_figures(
    leaderboard: Store,
    simulators: ReplayPlants,
    problem: Callable[[str], object],
    *,
    memo: Memo,
    note: Callable[[str], object] = lambda text: None,
    progress: Progress | None = None,
    cached: bool = False,
) -> Store:
    """Derive the figures of all records of a leaderboard.

    Args:
        leaderboard: without them.
        simulators: that replay them.
        problem: told why a record has none, and of a record whose lung was known.
        memo: what earlier calls of this process derived; adds to it.
        note: told whose stressed commands are not at hand.
        progress: called after each record.
        cached: read the user's cache, and write to it.
    """
    replayed: dict[str, Record] = {}
    for at, record in enumerate(leaderboard.scores):
        path = store.path_of(leaderboard.folder, record.sha256)
        try:
            round_ = leaderboard.round_of(record)
            folder = leaderboard.folder / RECORDS
            derived = derived_of(record, folder, simulators, round_, memo, cached=cached)
        except (InputError, OSError) as error:
            problem(str(error) if str(error).startswith(str(path.parent)) else f"{path}, {error}")
            continue
        if record.track == "robustness" and derived.leak:
            problem(f"{path}, key commands: {derived.leak}")
        if record.header.stress is not None and derived.stressed is None:
            note(
                f"{store.commands_path(record.header.stress.commands, folder)}, stressed commands, "
                f"are not at hand: {path} has no stress rank"
            )
        replayed[record.sha256] = dataclasses.replace(record, derived=derived)
        if progress is not None:
            progress(at + 1, len(leaderboard.scores))
    records = tuple(replayed.get(entry.sha256, entry) for entry in leaderboard.records)
    return dataclasses.replace(leaderboard, records=records)


def load(folder: Path, simulators: Load | None = None) -> Store:
    """Read a leaderboard with the figures of its records; kept ones are not computed again.

    Raises:
        InputError: naming the file that was changed, or holds a wrong signature, or if the
            simulators are others.
        OSError: if a file cannot be read.
    """

    def problem(text: str) -> None:
        raise InputError(text)

    leaderboard = store.load(folder)
    plants = loaded(simulators or frozen.load, problem) if leaderboard.scores else None
    if plants is None:
        return leaderboard
    return with_figures(leaderboard, plants, problem, memo=_MEMO, cached=simulators is None)


#: Figures of this process.
_MEMO: Memo = {}


def loaded(load: Load, problem: Callable[[str], object]) -> ReplayPlants | None:
    """Load the simulators; None, and a problem, where they are damaged."""
    try:
        simulators = load()
        canonical.through_json(simulators.about())
        return simulators
    except InputError as error:
        text = f"simulators: {error}"
    # A damaged manifest can lack anything.
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        text = f"simulators: {error!r}"
    problem(text)
    return None


def derived_of(
    record: Record,
    folder: Path,
    simulators: ReplayPlants,
    round_: Round | None,
    memo: Memo,
    *,
    cached: bool = False,
) -> Figures:
    """Figures of a record whose commands are in a folder, of a round, or of practice if None.

    ``memo`` and ``cached`` are as of :func:`with_figures`.

    Raises:
        InputError: if it was scored on other simulators or draws, or commands are missing.
    """
    header, identity = record.header, canonical.through_json(simulators.about())
    if header.simulators != identity:
        every = {*identity, *header.simulators}
        keys = sorted(k for k in every if identity.get(k) != header.simulators.get(k))
        raise InputError(
            "key simulators: those of this ventbench are not those of the record; "
            f"{', '.join(keys)} differ"
        )
    bounds = "" if round_ is None or round_.result is None else round_.result.bounds
    basis = (canonical.digest(canonical.canonical(identity)), round_ and round_.commitment, bounds)
    commands, stressed = store.load_commands(header.commands, folder), None
    stress = header.stress
    if stress is not None and stress.stressors == stressors.VERSION:
        at_hand = store.commands_path(stress.commands, folder).exists()
        stressed = store.load_commands(stress.commands, folder) if at_hand else None
    key = (*basis, record.sha256, stressed is not None)
    place = _place(key) if cached else None
    if key not in memo and place is not None and place.is_file():
        memo[key] = _read(place)
    if key not in memo:
        protocol_ = once(memo, basis, protocol_of, header, simulators, round_)
        memo[key] = figures_of(header, commands, stressed, protocol_, simulators)
        if place is not None:
            _write(place, memo[key])
    return memo[key]


def require_replay(
    simulators: ReplayPlants, added: Record, folder: Path, leaderboard: Store
) -> None:
    """Replay a record, whose commands are in a folder, before it is added to a leaderboard.

    Raises:
        InputError: if it was scored on other simulators or draws, or cannot be honest.
    """
    round_ = leaderboard.round_of(added)
    figures = derived_of(added, folder, simulators, round_, {})
    if added.track == "robustness" and figures.leak:
        name = store.path_of(folder, added.sha256).name
        raise InputError(f"{name}, key commands: {figures.leak}")


def seed_scores(
    record: Record,
    commands: Sequence[Commands],
    folder: Path,
    simulators: ReplayPlants,
    round_: Round,
    memo: Memo,
) -> list[float]:
    """Ranked scores that commands of seeds give; ``record`` is of their entry on the same track.

    Raises:
        InputError: if some are missing, cannot be honest, or are of another number of runs.
    """
    scores = []
    for own in commands:
        path = store.commands_path(own, folder)
        if own.shape != record.header.commands.shape:
            raise InputError(f"{path} does not have the shape of the commands of {record.name}")
        header = msgspec.structs.replace(record.header, commands=own, failures=[], stress=None)
        figures = derived_of(Record(own.sha256, header), folder, simulators, round_, memo)
        if record.track == "robustness" and figures.leak:
            raise InputError(f"{path}: {figures.leak}")
        scores.append(float(figures.ranked_values.mean()))
    return scores


def once(memo: Memo, key: Any, make: Callable[..., Any], *of: Any) -> Any:
    """Derive something, if it was not derived before."""
    if key not in memo:
        memo[key] = make(*of)
    return memo[key]


#: Code that figures depend on.
_CODE = ("board", "entries", "physics", "plants", "task")

_ARRAYS = [field.name for field in dataclasses.fields(Figures) if field.name != "stressed"]
_OF_RUNS = [
    "pips",
    "rig",
    "member",
    "error",
    "safe",
    "survived",
    "alarm_s",
    "peak",
    "volume",
    "draw",
    "plateau_error",
]


@functools.cache
def _code() -> str:
    """Hash of the code that figures depend on."""
    root = Path(files.__file__).parents[1]
    paths = (path for name in _CODE for path in sorted((root / name).rglob("*.py")))
    return canonical.digest("".join(map(files.sha256, paths)).encode())


def _place(key: tuple[Any, ...]) -> Path | None:
    """Where figures are kept; None where nothing is."""
    if os.environ.get("VENTBENCH_CACHE") == "":
        return None
    name = canonical.digest(repr((_code(), key)).encode())
    return compilation.folder() / "figures" / f"{name}.npz"


def _write(place: Path, figures: Figures) -> None:
    arrays = {name: getattr(figures, name) for name in _ARRAYS}
    if (runs := figures.stressed) is not None:
        arrays |= {f"stressed.{name}": getattr(runs, name) for name in _OF_RUNS}
    with contextlib.suppress(OSError):  # a read-only home is no reason to fail
        files.write_atomically(place, lambda file: np.savez(file, **arrays))


def _read(place: Path) -> Figures:
    with np.load(place, allow_pickle=False) as npz:
        runs = {name: npz[f"stressed.{name}"] for name in _OF_RUNS if f"stressed.{name}" in npz}
        stressed = Runs(conditions=stressors.conditions(), lungs=LUNG_IDS, **runs) if runs else None
        return Figures(**{name: npz[name] for name in _ARRAYS}, stressed=stressed)
