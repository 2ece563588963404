"""A board is what follows from frozen lists and signed inputs, byte for byte.

Inputs are bound: a record by its name, the files of a round by the next one, and what nothing
binds, a result, a withdrawal, the maintainers' notes, by a signature. Everything else is derived
anew: each frozen entry has a record or a signed failure, commands give figures by replay, figures
give ranks, ranks give pages, CSV and the table of the README. What is there must be that, and no
file more or less.

Nothing stops at the first problem: each names its file, and the key or line in it. Replay proves
that errors follow from commands; who computed them is for :mod:`ventbench.board.official_runs`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.executor import Progress
from ventbench.board import attestation, build, canonical, frames, ranking, rounds, store
from ventbench.board.canonical import ATTESTATIONS, RECORDS
from ventbench.board.official_runs import code_in, folders
from ventbench.board.record import Withdrawal
from ventbench.board.replay import (
    Load,
    Memo,
    ReplayPlants,
    loaded,
    once,
    seed_scores,
    with_figures,
)
from ventbench.board.rounds import Round
from ventbench.board.store import Store
from ventbench.entries import reference as references
from ventbench.plants.rigs import rigs_of
from ventbench.task import protocol
from ventbench.task.draws import uniforms
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics.score import LEAST_HEADROOM

#: Most that errors of bounds may differ from what their commands give, cmH2O, and that an entry or
#: a second optimiser may lie below them: what no cell tells apart.
BOUNDS_TOLERANCE, BOUNDS_LEAD = 1e-9, LEAST_HEADROOM

#: Most that the score of a seed may differ from that of its commands, points: an error may by
#: :data:`~ventbench.board.replay.TOLERANCE`, against the least headroom.
SEED_TOLERANCE = 1e-6

#: Cells of a round whose bound the second optimiser computes anew: about two minutes of one core.
RECOMPUTED = 24

T = TypeVar("T")
U = TypeVar("U")

#: Marks of the board's table in the README beside a leaderboard.
_TABLE = re.compile(r"<!-- board -->\n(.*?)\n<!-- end -->", re.S)


@dataclass
class Report:
    """What a verification saw."""

    records: int = 0  #: how many there are.
    replayed: int = 0  #: how many were replayed.
    #: how many were run again by :func:`official_runs.rerun` and gave the same commands.
    reproduced: int = 0
    #: what each second run showed, one sentence a record.
    second_runs: list[str] = field(default_factory=list)
    #: how far a second optimiser is below the bounds, one sentence a round.
    bounds: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  #: one sentence each; empty if all is well.
    #: what could not be checked, which is no problem.
    notes: list[str] = field(default_factory=list)


def verify(
    folder: Path,
    load: Load,
    *,
    site: Path | None = None,
    recomputed: int = RECOMPUTED,
    progress: Progress | None = None,
    memo: Memo | None = None,
) -> Report:
    """Verify a leaderboard.

    Args:
        folder: of the leaderboard.
        load: gives the simulators.
        site: folder of its built pages; the leaderboard's own if pages lie in it.
        recomputed: cells of each round whose bound the second optimiser computes anew.
        progress: called after each record.
        memo: what earlier calls of this process derived; for many boards that differ little.

    Raises:
        InputError: if there is no leaderboard.
        OSError: if a file cannot be read.
    """
    report, memo = Report(), {} if memo is None else memo
    problems = report.problems
    paths = store.record_paths(folder)
    if not paths:
        raise InputError(f"{folder} holds no leaderboard: there is no record in {RECORDS}/")
    entries = store.in_order(_readable(store.read_record, paths, problems))
    report.records = len(entries)
    names = rounds.names(folder)
    read = rounds.newest_first(_readable(partial(rounds.load, folder), names, problems))
    simulators = loaded(load, problems.append)
    plain, odd = canonical.walk(folder)
    if site is None and any(map(canonical.BUILT.fullmatch, plain)):
        site = folder
    inputs = {x for x in plain if site != folder or not canonical.BUILT.fullmatch(x)}
    problems += [f"{folder / x} is no plain file or folder; remove it" for x in odd]
    problems += store.conflicts(entries)
    complete = len(entries) == len(paths)
    vouched, wrong_lists = attestation.attested(folder, store.measured(entries))
    problems += wrong_lists if complete else []
    leaderboard = Store(folder, entries, vouched, read)
    complete &= len(read) == len(names)
    problems += _strange_files(leaderboard, inputs, complete=complete)
    problems += [] if wrong_lists else _unsigned(leaderboard)
    problems += _changed_since(leaderboard)
    for round_ in read:
        problems += _unaccounted(round_, leaderboard)
    if simulators is not None:
        for round_ in read:
            problems += _other_protocol(round_, simulators, memo)
        leaderboard = with_figures(
            leaderboard,
            simulators,
            problems.append,
            note=report.notes.append,
            progress=progress,
            memo=memo,
        )
        problems += _below_bounds(leaderboard)
        for round_ in read:
            problems += _wrong_seeds(round_, leaderboard, simulators, memo)
        if not problems:  # else what is wrong moves ranks and pages
            problems += _check_published(leaderboard, site, folder.parent / "README.md", memo)
            for round_ in read:
                _recompute(round_, simulators, recomputed, report, memo)
    report.replayed = sum(score.derived is not None for score in leaderboard.scores)
    report.problems = list(dict.fromkeys(problems))
    return report


def _readable(read: Callable[[T], U], some: Iterable[T], problems: list[str]) -> Iterator[U]:
    """What can be read; adds to the problems why the others cannot."""
    for one in some:
        try:
            yield read(one)
        except (InputError, OSError) as error:
            problems.append(str(error))


def _strange_files(leaderboard: Store, plain: set[str], *, complete: bool) -> list[str]:
    """Files that belong to no record of the leaderboard: none of them may be published.

    If the entries are not complete, nobody knows which commands the missing ones name.
    """
    problems, folder = [], leaderboard.folder
    of_seeds = [x for round_ in leaderboard.rounds for x in round_.seeds.values()]
    used = [*(x.commands for x in leaderboard.scores), *of_seeds]
    named = {f"{x.sha256}{canonical.ACTIONS_SUFFIX}" for own in used for x in own}
    for entry in leaderboard.records:
        path = store.path_of(folder, entry.sha256)
        named |= {path.name, attestation.signature_path(path).name}
    signatures = {attestation.signature_path(path) for path in attestation.statements(folder)}
    for path in (folder / name for name in sorted(plain)):
        if not canonical.named(path.relative_to(folder).as_posix()):
            problems.append(f"{path} is no part of a leaderboard; remove it")
        elif path.parent.name == RECORDS:
            if complete and path.name not in named:
                problems.append(f"{path} belongs to no record; remove it")
        elif path.suffix == canonical.SIGNATURE_SUFFIX and path not in signatures:
            problems.append(f"{path} signs no file; remove it")
    return problems


def _unsigned(leaderboard: Store) -> list[str]:
    """Withdrawals and statements that nobody vouches for who may do so."""
    folder = leaderboard.folder
    nobody = not attestation.read_list(folder).keys  # who could sign a list without keys?
    paths = [x for x in attestation.statements(folder) if not nobody or x.name != ATTESTATIONS] + [
        store.path_of(leaderboard.folder, x.sha256)
        for x in leaderboard.records
        if isinstance(x, Withdrawal)
    ]
    return [
        f"{path} is signed by no key of {ATTESTATIONS}"
        for path in paths
        if files.sha256(path) not in leaderboard.attested
    ]


def _unaccounted(round_: Round, leaderboard: Store) -> list[str]:
    """Where a round's result is not what its frozen list and the records of its draws give.

    Each frozen entry has one record or one failure on each of its tracks, its seeds have a score or
    a failure, and there is no other record of these draws; but a correction, once it is withdrawn.
    """
    path, result, runs = round_.folder / rounds.RESULT, round_.result, round_.runs
    records = {x.sha256: x for x in leaderboard.scores if x.draws == round_.name}
    if result is None:
        return [f"{path} is missing: records are of the round's draws"] if records else []
    problems = [
        f"{path}: {key} has {'both a record and a failure' if key in result.failed else 'neither'}"
        for key in runs
        if (key in result.records) == (key in result.failed)
    ]
    for key, sha256 in result.records.items():
        record, at = records.pop(sha256, None), store.path_of(leaderboard.folder, sha256)
        if key not in runs:
            problems.append(f"{path}, key records: {key} was not frozen")
        elif record is None:
            if not at.exists():  # what cannot be read was named
                missing = f"{at} is missing: the record of {key} in round {round_.name}"
                problems.append(missing)
        elif record.run != runs[key]:
            problems.append(f"{path}, key records: {at} is not of {key} as it was frozen")
        elif record.official and sha256 not in leaderboard.attested:
            problems.append(f"{at}, of round {round_.name}, is signed by no key of {ATTESTATIONS}")
    withdrawn = leaderboard.withdrawn
    corrected = {runs[k][:2] for k, sha in result.records.items() if k in runs and sha in withdrawn}
    problems += [
        f"{store.path_of(leaderboard.folder, x.sha256)} is not in {path}"
        for x in records.values()
        if x.run[:2] not in corrected
    ]
    stated = {key.partition(", seed ")[0] for key in (*result.failed, *result.seeds)}
    problems += [
        f"{path}, keys failed and seeds: {key} was not frozen" for key in sorted(stated - set(runs))
    ]
    unrecorded = {*result.seeds, *round_.seeds} - set(result.records)
    return problems + [f"{path}, key seeds: {key} has no record" for key in sorted(unrecorded)]


def _check_published(leaderboard: Store, site: Path | None, readme: Path, memo: Memo) -> list[str]:
    """Pages, CSV and table of the README that are not what the board gives."""
    problems = []
    there = _TABLE.search(readme.read_text("utf-8")) if readme.is_file() else None
    if there and there[1] != frames.markdown(ranking.board(leaderboard)):
        problems.append(f"{readme}: its table is not that of the board")
    if site is None:
        return problems
    inputs = build.inputs(leaderboard.folder)
    state = tuple((name, canonical.digest(content)) for name, content in inputs.items())
    expected = inputs | once(memo, ("pages", state), build.content, leaderboard)
    present, odd = canonical.walk(site)
    for name in sorted({*expected, *present, *odd}):
        if name not in present:
            problem = "is missing" if name in expected else "is no plain file"
        elif name not in expected:
            problem = "is no page of this board; remove it"
        elif (site / name).read_bytes() != expected[name]:
            problem = "is not what the records give; build it again"
        else:
            continue
        problems.append(f"{site / name} {problem}")
    return problems


def _changed_since(leaderboard: Store) -> Iterator[str]:
    """Notes on what was not frozen, and entries that are not what the newest round has frozen.

    Entries stay as they were ranked until the next round is open.
    """
    places = [leaderboard.folder.parent / "submissions"]
    available, by_name = code_in(places), {x.name: x for x in folders(places)}
    for round_ in leaderboard.rounds:
        for name in sorted(set(round_.notes) - {x.name for x in round_.entries}):
            yield f"{round_.folder / canonical.NOTES}, key entries: {name} was not frozen"
    for round_ in leaderboard.rounds[:1]:
        for entry in round_.entries:
            if entry.name in by_name and entry.sha256 not in available:
                yield (
                    f"{by_name[entry.name]} is not what was frozen in round {round_.name}, "
                    f"{entry.sha256[:12]}"
                )


def _other_protocol(round_: Round, simulators: ReplayPlants, memo: Memo) -> Iterator[str]:
    """Parts of the protocol of a round that this ventbench does not have, and wrong bounds."""
    if round_.frozen is not None:
        for key in rounds.protocol_differences(round_, simulators.about()):
            yield f"{round_.folder}: this ventbench has another protocol: {key}"
    if round_.result is not None:
        file = files.sha256(round_.folder / rounds.BOUNDS)
        state = round_.commitment, round_.result.bounds, file
        identity = canonical.canonical(simulators.about())
        yield from once(memo, (state, identity), _wrong_bounds, round_, simulators)


def _wrong_seeds(
    round_: Round, leaderboard: Store, simulators: ReplayPlants, memo: Memo
) -> list[str]:
    """Scores of seeds that their commands do not give."""
    problems, path, result = [], round_.folder / canonical.SEEDS, round_.result
    if result is None:
        return []
    replayed = {x.sha256: x for x in leaderboard.scores if x.derived}
    for key, sha256 in result.records.items():
        if sha256 not in replayed:
            continue  # that has been named
        stated, where = result.seeds.get(key, []), leaderboard.folder / RECORDS
        commands = round_.seeds.get(key, [])
        try:
            given = seed_scores(replayed[sha256], commands, where, simulators, round_, memo)
            same = len(given) == len(stated) and np.allclose(given, stated, 0.0, SEED_TOLERANCE)
            if not same:
                raise InputError("its commands do not give the scores of the result")
        except (InputError, OSError) as error:
            problems.append(f"{path}, key {key}: {error}")
    return problems


def _below_bounds(leaderboard: Store) -> list[str]:
    """Records that attain less than the least error of any commands: their bounds are none."""
    problems = []
    for score in leaderboard.scores:
        if score.derived is None:
            continue
        lead = np.nan_to_num(score.derived.attainable - score.derived.controllable)
        draw, lung, pip = np.unravel_index(lead.argmax(), lead.shape)
        if lead.max() > BOUNDS_LEAD:
            problems.append(
                f"{store.path_of(leaderboard.folder, score.sha256)} ({score.name}) attains "
                f"{lead.max():.3f} cmH2O less than the bound of a cell, which bounds nothing: "
                f"{_cell(lung, draw, pip)}"
            )
    return problems


def _cell(lung: Any, draw: Any, pip: Any) -> str:
    """Name a cell by its place in tables whose draws have the nominal one in front."""
    run = f"draw {draw}" if draw else "nominal"
    return f"{LUNG_IDS[lung]}, {run}, PIP {protocol.PIPS[pip]:g}"


def _wrong_bounds(round_: Round, simulators: ReplayPlants) -> list[str]:
    """Say whether the bounds of a round are what their commands and its PIDs give."""
    rigs = rigs_of(simulators)
    try:
        draws, bounds = round_.draws(rigs), round_.bounds()
        references.reference_of(rigs.about, draws.about(), bounds)
    except (InputError, OSError) as error:
        files_ = f"{rounds.BOUNDS}, {rounds.FROZEN} and {rounds.BEACON}"
        return [f"{round_.folder}: {files_} do not belong together: {error}"]
    if max(references.deviations(bounds, *rigs.cells(draws, protocol.PIPS))) > BOUNDS_TOLERANCE:
        return [f"{round_.folder / rounds.BOUNDS}: its commands or PIDs do not attain its errors"]
    return []


def _recompute(
    round_: Round, simulators: ReplayPlants, count: int, report: Report, memo: Memo
) -> None:
    """Compare bounds with what the second optimiser finds.

    Half of the cells are those whose bound is farthest above what the rise alone costs, where it
    may be far above the least error. The others the beacon chooses, with the hash of the bounds:
    else whoever makes them would know which.
    """
    if round_.result is None or not count:
        return
    rigs, bounds, sha256 = rigs_of(simulators), round_.bounds(), round_.result.bounds
    cells = rigs.cells(round_.draws(rigs), protocol.PIPS)
    key = ("bounds", canonical.canonical(simulators.about()), round_.commitment, sha256, count)
    gap = bounds.attainable - once(memo, ("rise", *key), references.rise_errors, *cells)
    largest = np.argsort(-gap, axis=None)[: count // 2]
    shuffled = np.argsort(uniforms(round_.seed, f"bounds {sha256}", gap.size))
    some = np.concatenate([largest, shuffled[~np.isin(shuffled, largest)]])[:count]
    second = once(memo, key, references.second_errors, *cells, some)
    lead = bounds.attainable.ravel()[some] - second
    report.bounds.append(
        f"round {round_.name}: a second optimiser attains {lead.max():.3f} cmH2O less than the "
        f"bound at most, {lead.mean():.3f} on average, in {len(some)} cells"
    )
    for k in np.flatnonzero(lead > BOUNDS_LEAD):
        cell = np.unravel_index(some[k], bounds.attainable.shape)
        report.problems.append(
            f"{round_.folder / rounds.BOUNDS}: {_cell(*cell)}: the bound is "
            f"{lead[k] + second[k]:.3f} cmH2O, and a second optimiser attains {second[k]:.3f}"
        )
