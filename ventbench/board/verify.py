"""Everything again: hashes, signatures, and the replay of all commands.

Nothing stops at the first problem: each names its file, and the key or line in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.board import actions, attestation, canonical, ranking, store
from ventbench.board.canonical import ATTESTATIONS, RECORDS
from ventbench.board.record import AnyRecord, Record
from ventbench.board.replay import (
    BATCH,
    ReplayPlants,
    deviation,
    differences,
    draws_of,
    replay,
)
from ventbench.board.store import Store
from ventbench.errors import InputError
from ventbench.headroom.reference import published, reference_of
from ventbench.metrics.score import normalised
from ventbench.rig_draws import RigDraws

Floats = NDArray[np.float64]

#: Loads the frozen simulators.
Load = Callable[[], ReplayPlants]

#: Told how many records of how many have been replayed.
Progress = Callable[[int, int], None]


@dataclass
class Report:
    """What a verification saw.

    Attributes:
        records: how many there are.
        replayed: how many were replayed.
        reproduced: how many were run again and gave the same commands; see
            :mod:`ventbench.board.rerun`.
        second_runs: what each second run showed, one sentence a record.
        deviation: largest difference between a recorded error and its replay, cmH2O.
        problems: one sentence each; empty if all is well.
        notes: what could not be checked, which is no problem.
    """

    records: int = 0
    replayed: int = 0
    reproduced: int = 0
    second_runs: list[str] = field(default_factory=list)
    deviation: float = 0.0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def verify(folder: Path, load: Load, *, progress: Progress | None = None) -> Report:
    """Verify a leaderboard.

    Args:
        folder: of the leaderboard.
        load: of the frozen simulators; raises InputError where they were changed.
        progress: called after each batch of records.

    Raises:
        InputError: if there is no leaderboard.
        OSError: if a file cannot be read.
    """
    report = Report()
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
    report.problems += _strange_files(folder, entries, whole=len(entries) == len(paths))
    report.problems += store.conflicts(entries)
    vouched, problems = attestation.attested(folder, [path.stem for path in paths])
    report.problems += problems
    leaderboard = Store(folder, entries, vouched)
    by_draw = _check_replay(leaderboard, load, report, progress)
    if not report.problems:  # else whatever is wrong has been said, and moves the ranks
        report.problems += _check_ranks(leaderboard, by_draw)
    return report


def _strange_files(folder: Path, entries: Sequence[AnyRecord], *, whole: bool) -> list[str]:
    """Files that belong to no record of the leaderboard: none of them may be published.

    Args:
        folder: of the leaderboard.
        entries: that could be read.
        whole: whether these are all; else nobody knows which commands the others name.
    """
    plain, odd = canonical.walk(folder)
    problems = [f"{folder / name} is neither a plain file nor a folder; remove it" for name in odd]
    named = {entry.sha256 for entry in entries}
    commands = {entry.header.actions.sha256 for entry in entries if isinstance(entry, Record)}
    for name in sorted(plain - {ATTESTATIONS}):
        path = Path(name)
        if not canonical.named(name):
            problems.append(f"{folder / name} is no part of a leaderboard; remove it")
        elif whole and path.suffix != canonical.RECORD_SUFFIX:
            of = commands if path.suffix == canonical.ACTIONS_SUFFIX else named
            if path.stem not in of:
                problems.append(f"{folder / name} belongs to no record; remove it")
    return problems


def _check_replay(
    leaderboard: Store, load: Load, report: Report, progress: Progress | None
) -> dict[str, Floats]:
    """Replay records and note in the report what differs.

    Returns:
        What ranks as replayed, shape ``(L, K)``, by the record's hash; see
        :attr:`ventbench.board.record.Record.ranked_values`.
    """
    by_draw: dict[str, Floats] = {}
    groups: dict[tuple[str, str], list[Record]] = {}
    for score in leaderboard.scores:
        groups.setdefault(score.basis[:2], []).append(score)
    for group in groups.values():
        header = group[0].header
        simulators = _simulators(header.simulators, load, report)
        if simulators is None:
            continue
        try:
            drawn = draws_of(header, simulators)
        except InputError as error:
            report.problems += [f"record {score.sha256}, {error}" for score in group]
            continue
        report.problems += _wrong_reference(group)
        for first in range(0, len(group), BATCH):
            batch = group[first : first + BATCH]
            by_draw |= _replay_batch(leaderboard.folder, batch, simulators, drawn, report)
            if progress is not None:
                progress(min(first + BATCH, len(group)), len(group))
    return by_draw


def _check_ranks(leaderboard: Store, by_draw: Mapping[str, Floats]) -> list[str]:
    """Ranks that recorded errors give and replayed ones do not: nobody gains by a rounding error.

    Args:
        leaderboard: all that could be read.
        by_draw: replayed values that rank; a record without them keeps its own.
    """
    problems = []
    for name, standing in ranking.standings(leaderboard).items():
        records = [entry.record for entry in standing.ranked]
        recorded = ranking.ranges_of(records, [score.ranked_values for score in records])
        again = [by_draw.get(x.sha256, x.ranked_values) for x in records]
        replayed = ranking.ranges_of(records, again)
        problems += [
            f"record {score.sha256} ({score.name}): ranks {said[0]} on the {name} track by its "
            f"recorded errors, {given[0]} by those that all commands give"
            for score, said, given in zip(records, recorded, replayed, strict=True)
            if said[0] != given[0]
        ]
    return problems


def _wrong_reference(group: Sequence[Record]) -> list[str]:
    """Records whose reference errors are not the published ones of their draws."""
    header = group[0].header
    try:
        reference = reference_of(header.simulators, header.draws.about(), published())
    except InputError as error:
        return [f"record {group[0].sha256}, key headroom: {error}"]
    assert reference is not None
    tables = {"attainable": reference.attainable, "pid": reference.pid}
    return [
        f"record {score.sha256}, key headroom.{key}: not the published reference errors"
        for score in group
        for key, table in tables.items()
        if not np.array_equal(getattr(score.headroom, key), np.moveaxis(table, 1, 0))
    ]


def _simulators(recorded: Mapping[str, Any], load: Load, report: Report) -> ReplayPlants | None:
    """Load the simulators; None, and a problem, where they are not those that records name."""
    try:
        simulators = load()
        here = canonical.through_json(simulators.about())
    # A damaged manifest can lack anything; InputError is a ValueError.
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        text = str(error) if isinstance(error, InputError) else repr(error)
        report.problems.append(f"simulators: {text}")
        return None
    if here == recorded:
        return simulators
    keys = sorted(key for key in {*here, *recorded} if here.get(key) != recorded.get(key))
    report.problems.append(
        f"simulators: those of this ventbench are not those of the records; {', '.join(keys)} "
        "differ"
    )
    return None


def _replay_batch(
    folder: Path,
    batch: Sequence[Record],
    simulators: ReplayPlants,
    drawn: RigDraws,
    report: Report,
) -> dict[str, Floats]:
    sound, requested = [], []
    by_draw: dict[str, Floats] = {}
    for score in batch:
        try:
            requested.append(actions.load(score, folder / RECORDS))
            sound.append(score)
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    if not sound:
        return by_draw
    runs = replay(simulators, sound[0].pips, requested, drawn)
    for score, replayed in zip(sound, runs, strict=True):
        report.replayed += 1
        report.deviation = max(report.deviation, deviation(score, replayed))
        path = folder / RECORDS / f"{score.sha256}{canonical.RECORD_SUFFIX}"
        report.problems += [f"{path}, {text}" for text in differences(score, replayed)]
        own, failed = score.headroom, np.isnan(score.drawn)
        values = normalised(replayed.controllable, own.attainable, own.pid)[1:]
        by_draw[score.sha256] = np.where(failed, np.nan, values).mean(axis=2).T
    return by_draw
