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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import build, canonical, frames, gate, ranking, rounds, store
from ventbench.board.canonical import ATTESTATIONS, RECORDS
from ventbench.board.official_runs import code_in, folders
from ventbench.board.record import AnyRecord, Withdrawal
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

#: Told how many records of how many have been replayed.
Progress = Callable[[int, int], None]

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
    paths = store.record_paths(folder)
    if not paths:
        raise InputError(f"{folder} holds no leaderboard: there is no record in {RECORDS}/")
    read: list[AnyRecord] = []
    for path in paths:
        try:
            read.append(store.read_record(path, strict=True))
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    entries = store.in_order(read)
    report.records = len(entries)
    plain, odd = canonical.walk(folder)
    if site is None and any(map(canonical.BUILT.fullmatch, plain)):
        site = folder
    inputs = {x for x in plain if site != folder or not canonical.BUILT.fullmatch(x)}
    report.problems += [f"{folder / x} is no plain file or folder; remove it" for x in odd]
    report.problems += store.conflicts(entries)
    vouched, problems = gate.attested(folder, store.measured(entries))
    report.problems += problems if len(entries) == len(paths) else []
    leaderboard = Store(folder, entries, vouched, tuple(_rounds(folder, load, report, memo)))
    report.problems += _strange_files(leaderboard, inputs, complete=len(entries) == len(paths))
    report.problems += [] if problems else _unsigned(leaderboard)
    for round_ in leaderboard.rounds:
        report.problems += _unaccounted(round_, leaderboard)
    leaderboard = with_figures(
        leaderboard,
        load,
        report.problems.append,
        note=report.notes.append,
        progress=progress,
        memo=memo,
    )
    report.replayed = sum(score.derived is not None for score in leaderboard.scores)
    report.problems += _below_bounds(leaderboard)
    for round_ in leaderboard.rounds:
        report.problems += _wrong_seeds(round_, leaderboard, load, memo)
    if not report.problems:  # else whatever is wrong has been said, and moves ranks and pages
        report.problems += _check_published(leaderboard, site, folder.parent / "README.md", memo)
        for round_ in leaderboard.rounds:
            _recompute(round_, load(), recomputed, report, memo)
    report.problems = list(dict.fromkeys(report.problems))
    return report


def _strange_files(leaderboard: Store, plain: set[str], *, complete: bool) -> list[str]:
    """Files that belong to no record of the leaderboard: none of them may be published.

    If the entries are not complete, nobody knows which commands the missing ones name.
    """
    problems, folder, entries = [], leaderboard.folder, leaderboard.records
    complete &= len(leaderboard.rounds) == len(rounds.names(folder))
    named = {entry.sha256 for entry in entries}
    of_seeds = [x for round_ in leaderboard.rounds for x in round_.seeds.values()]
    used = [*(x.commands for x in leaderboard.scores), *of_seeds]
    commands = {x.sha256 for own in used for x in own}
    for name in sorted(plain - {ATTESTATIONS}):
        path = Path(name)
        if not canonical.named(name):
            problems.append(f"{folder / name} is no part of a leaderboard; remove it")
        elif complete and path.parts[0] == RECORDS and path.suffix != canonical.RECORD_SUFFIX:
            of = commands if path.suffix == canonical.ACTIONS_SUFFIX else named
            if path.stem not in of:
                problems.append(f"{folder / name} belongs to no record; remove it")
    signatures = {gate.signature_path(path) for path in gate.statements(folder)}
    signature_files = (folder / x for x in sorted(plain) if x.endswith(canonical.SIGNATURE_SUFFIX))
    return problems + [
        f"{path} signs no file; remove it"
        for path in signature_files
        if path not in signatures and path.parent.name != RECORDS
    ]


def _unsigned(leaderboard: Store) -> list[str]:
    """Withdrawals and statements that nobody vouches for who may do so."""
    folder = leaderboard.folder
    nobody = not gate.read_list(folder).keys  # who could sign a list without keys?
    paths = [x for x in gate.statements(folder) if not nobody or x.name != ATTESTATIONS] + [
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
    path, result = round_.folder / rounds.RESULT, round_.result
    records = {x.sha256: x for x in leaderboard.scores if x.header.draws.season == round_.name}
    if result is None:
        return [f"{path} is missing: records are of the round's draws"] if records else []
    runs = {
        f"{entry.name} ({track})": (entry, track)
        for entry in (round_.frozen.entries if round_.frozen else ())
        for track in entry.tracks
    }
    problems = [
        f"{path}: {key} has {'both a record and a failure' if key in result.failed else 'neither'}"
        for key in runs
        if (key in result.records) == (key in result.failed)
    ]
    withdrawn, corrected = leaderboard.evidence.withdrawn, set[str]()
    for key, sha256 in result.records.items():
        record, at = records.pop(sha256, None), store.path_of(leaderboard.folder, sha256)
        if key not in runs:
            problems.append(f"{path}, key records: {key} was not frozen")
        elif record is None:
            missing = f"{at} is missing: the record of {key} in round {round_.name}"
            problems += [] if at.exists() else [missing]  # what cannot be read was named
        elif (record.name, record.track, record.header.submission.sha256) != (
            runs[key][0].name,
            runs[key][1],
            runs[key][0].sha256,
        ):
            problems.append(f"{path}, key records: {at} is not of {key} as it was frozen")
        elif record.official and sha256 not in leaderboard.attested:
            problems.append(f"{at}, of round {round_.name}, is signed by no key of {ATTESTATIONS}")
        if sha256 in withdrawn:
            corrected.add(key)
    problems += [
        f"{store.path_of(leaderboard.folder, x.sha256)} is not in {path}"
        for x in records.values()
        if f"{x.name} ({x.track})" not in corrected
    ]
    seeds = [key for key in (*result.failed, *result.seeds) if key not in runs]
    problems += [
        f"{path}, keys failed and seeds: {key} was not frozen"
        for key in seeds
        if key.partition(", seed ")[0] not in runs
    ]
    return problems + [
        f"{path}, key seeds: {key} has no record"
        for key in {*result.seeds, *round_.seeds} - set(result.records)
    ]


def _check_published(leaderboard: Store, site: Path | None, readme: Path, memo: Memo) -> list[str]:
    """Pages, CSV and table of the README that are not what the board gives."""
    problems = []
    there = _TABLE.search(readme.read_text("utf-8")) if readme.is_file() else None
    if there and there[1] != frames.markdown(ranking.board(leaderboard)):
        problems.append(f"{readme}: its table is not that of the board")
    if site is None:
        return problems
    plain, _ = canonical.walk(leaderboard.folder)
    inputs = {x: (leaderboard.folder / x).read_bytes() for x in filter(canonical.named, plain)}
    state = tuple(sorted((name, canonical.digest(content)) for name, content in inputs.items()))
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


def _rounds(folder: Path, load: Load, report: Report, memo: Memo) -> Iterator[Round]:
    """Read the rounds, newest first, and note what is wrong with them.

    Entries stay as they were ranked until the next round is open.
    """
    all_rounds: list[Round] = []
    for name in rounds.names(folder):
        try:
            round_ = rounds.load(folder, name)
            all_rounds.append(round_)
            entered = {x.name for x in round_.frozen.entries} if round_.frozen else set[str]()
            report.problems += [
                f"{round_.folder / canonical.NOTES}, key entries: {x} was not frozen"
                for x in set(round_.notes()) - entered
            ]
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    all_rounds.sort(key=lambda x: x.opened.closes, reverse=True)
    for at, round_ in enumerate(all_rounds):
        yield round_
        if round_.frozen is None:
            continue
        simulators = loaded(load, report.problems.append)
        if simulators is None:
            return
        for key in rounds.protocol_differences(round_, simulators.about()):
            report.problems.append(f"{round_.folder}: this ventbench has another protocol: {key}")
        places = [folder.parent / "submissions"]
        available, named = code_in(places), {x.name: x for x in folders(places)}
        for entry in round_.frozen.entries if at == 0 else ():
            if entry.name in named and entry.sha256 not in available:
                report.problems.append(
                    f"{named[entry.name]} is not what was frozen in round {round_.name}, "
                    f"{entry.sha256[:12]}"
                )
        if round_.result is not None:
            state = (
                round_.commitment,
                round_.result.bounds,
                files.sha256(round_.folder / rounds.BOUNDS),
            )
            identity = canonical.canonical(simulators.about())
            report.problems += once(memo, (state, identity), _wrong_bounds, round_, simulators)


def _wrong_seeds(round_: Round, leaderboard: Store, load: Load, memo: Memo) -> list[str]:
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
            given = seed_scores(replayed[sha256], commands, where, load(), round_, memo)
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
