"""Everything again: chain, hashes, replay of all commands, and a rebuild of every page.

Nothing stops at the first problem: each names its file, and the key, line or byte in it.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench import protocol, rig_draws
from ventbench import seasons as season_files
from ventbench.board import (
    actions,
    attestation,
    build,
    canonical,
    layout,
    ranking,
    record,
    sealed,
    store,
)
from ventbench.board.conflicts import conflicts
from ventbench.board.record import AnyRecord, Record
from ventbench.board.replay import (
    BATCH,
    ReplayPlants,
    deviation,
    differences,
    draws_of,
    replay,
)
from ventbench.errors import InputError
from ventbench.headroom.reference import published, reference_of
from ventbench.metrics.score import normalised
from ventbench.rig_draws import RigDraws

Floats = NDArray[np.float64]

#: Loads the frozen simulators of a version.
Load = Callable[[int], ReplayPlants]

#: Told how many records of how many have been replayed.
Progress = Callable[[int, int], None]


@dataclass
class Report:
    """What a verification saw.

    Attributes:
        head: SHA-256 that stands for all records and their order.
        records: how many there are.
        replayed: how many were replayed.
        unsealed: how many sealed records were looked into.
        reproduced: how many were run again and gave the same commands; see
            :mod:`ventbench.board.rerun`.
        second_runs: what each second run showed, one sentence a record.
        deviation: largest difference between a recorded error and its replay, cmH2O.
        problems: one sentence each; empty if all is well.
        notes: what could not be checked, which is no problem.
    """

    head: str = store.CHAIN_START
    records: int = 0
    replayed: int = 0
    unsealed: int = 0
    reproduced: int = 0
    second_runs: list[str] = field(default_factory=list)
    deviation: float = 0.0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def verify(
    folder: Path,
    load: Load,
    *,
    head: str | None = None,
    seed: bytes | None = None,
    progress: Progress | None = None,
) -> Report:
    """Verify a leaderboard.

    Args:
        folder: of the leaderboard.
        load: of the frozen simulators, by their version; raises InputError where they were changed.
        head: of the chain, noted earlier: it must still be on it.
        seed: of a season that is not revealed yet, to look into its sealed records.
        progress: called after each batch of records.

    Raises:
        InputError: if there is no leaderboard, or jinja2 is not installed.
        OSError: if a file cannot be read.
    """
    report = Report()
    if not (folder / store.CHAIN).is_file():
        raise InputError(f"{folder} holds no leaderboard: {store.CHAIN} is missing")
    try:
        links = store.read_chain(folder)
    except InputError as error:
        report.problems.append(str(error))
        links = []
    report.head = store.chain_head(links)
    if head is not None and head not in {store.CHAIN_START, *(link.sha256 for link in links)}:
        report.problems.append(f"{folder / store.CHAIN} does not hold the line {head}")
    entries: list[AnyRecord] = []
    for link in links:
        try:
            entries.append(store.read_record(folder, link, strict=True))
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    report.records = len(entries)
    report.problems += _strange_files(folder, bool(links))
    if len(entries) == len(links):
        report.problems += _misnamed(folder, entries)
    report.problems += conflicts(entries)
    vouched: frozenset[str] = frozenset()
    if links:  # else nobody knows which records there are
        vouched, problems = attestation.attested(folder, [link.record for link in links])
        report.problems += problems
    known = _check_seasons(folder, report)
    leaderboard = store.assembled(folder, links, entries, vouched, known)
    hidden = _check_sealed(leaderboard, vouched, seed, report)
    by_draw = _check_replay(folder, leaderboard.scores, load, known, report, progress)
    seeds = {name: season.revealed for name, season in known.items() if season.revealed}
    if seed is not None:
        of_seed = season_files.commitment(seed)
        seeds |= {name: seed for name, about in known.items() if about.commitment == of_seed}
    _check_hidden(hidden, load, seeds, report)
    if not report.problems:  # else whatever is wrong has been said, and moves the ranks
        report.problems += _check_ranks(leaderboard, by_draw)
    if len(entries) == len(links) > 0:
        report.problems += _check_pages(leaderboard)
    return report


def _check_seasons(folder: Path, report: Report) -> dict[str, season_files.Season]:
    """Read each season file; one whose seed is not that of its commitment is a problem."""
    known = {}
    for path in sorted((folder / layout.SEASONS).glob("*.toml")):
        try:
            known[path.stem] = season_files.read_season(path)
        except InputError as error:
            report.problems.append(str(error))
    return known


def _check_sealed(
    leaderboard: store.Store, vouched: Container[str], seed: bytes | None, report: Report
) -> list[sealed.Opened]:
    """Check sealed records; look into them where the seed of their season is known.

    Returns:
        What was inside those that are not on the chain yet.
    """
    opened = []
    there = {entry.sha256 for entry in leaderboard.records}
    closed = 0
    for entry in leaderboard.sealed:
        folder = leaderboard.folder / store.RECORDS
        season = leaderboard.seasons.get(entry.content.season.id)
        label = folder / f"{entry.sha256}{record.SUFFIX}"
        if season is None:
            name = f"{layout.SEASONS}/{entry.content.season.id}.toml"
            report.problems.append(f"{label}, key season.id: {name} is missing or wrong")
            continue
        try:
            ciphertext = sealed.load(entry, folder)
            problems = sealed.belongs(entry, season)
            if problems:
                raise InputError(f"{label}: {'; '.join(problems)}")
            own = season.revealed
            if own is None and seed is not None:
                own = seed if season_files.commitment(seed) == season.commitment else None
            if own is None:
                closed += 1
                continue
        except (InputError, OSError) as error:
            report.problems.append(str(error))
            continue
        try:
            inside = sealed.unseal(entry, ciphertext, season, own)
        except InputError as error:
            # Anybody can send a forgery; only a signature makes it somebody's fault.
            (report.problems if entry.sha256 in vouched else report.notes).append(str(error))
            continue
        report.unsealed += 1
        if inside.record.sha256 in there:
            continue
        if season.seed is not None:
            report.problems.append(
                f"{label} belongs to season {season.id}, which is revealed, and is still sealed; "
                "run `ventbench board reveal` again"
            )
        opened.append(inside)
    if closed:
        report.notes.append(
            f"{closed} sealed records cannot be looked into before their season is revealed"
        )
    return opened


def _check_hidden(
    hidden: Sequence[sealed.Opened], load: Load, seeds: Mapping[str, bytes], report: Report
) -> None:
    """Replay what is inside sealed records; ``seeds`` are known ones by season."""
    for inside in hidden:
        label = f"what is sealed of record {inside.record.sha256}"
        simulators = _simulators(inside.record.header.simulators, load, report)
        if simulators is None:
            continue
        try:
            season = inside.record.header.draws.season
            store.require_replay(
                inside.record, inside.commands, simulators, label, seeds.get(season or "")
            )
            report.replayed += 1
        except InputError as error:
            report.problems.append(str(error))


def _strange_files(folder: Path, readable: bool) -> list[str]:
    """Files that belong to no leaderboard with this chain: none of them may be published.

    Args:
        folder: of the leaderboard.
        readable: whether the chain could be read; else nobody knows which records it names.
    """
    plain, odd = layout.walk(folder)
    problems = [f"{folder / name} is neither a plain file nor a folder; remove it" for name in odd]
    for name in layout.stray(plain, (folder / store.CHAIN).read_bytes()):
        if not name.startswith(f"{store.RECORDS}/"):
            problems.append(f"{folder / name} is no part of a leaderboard; remove it")
        elif readable:
            problems.append(f"{folder / name} is not named by {store.CHAIN}; add it, or remove it")
    return problems


def _misnamed(folder: Path, entries: Sequence[AnyRecord]) -> list[str]:
    """Files that bear the hash of a file of another kind, or belong to a record that has none."""
    beside = {record.commands_of(x): isinstance(x, record.Sealed) for x in entries}
    return [
        f"{folder / name} is not named by {store.CHAIN}; remove it"
        for name in sorted(layout.walk(folder)[0])
        if name.startswith(f"{store.RECORDS}/")
        for path in [Path(name)]
        if path.suffix in (layout.ACTIONS_SUFFIX, layout.SEALED_SUFFIX)
        if beside.get(path.stem) is (path.suffix == layout.ACTIONS_SUFFIX)
    ]


def _check_pages(leaderboard: store.Store) -> list[str]:
    """Built files that are missing, stale or changed, with the first byte that differs."""
    folder = leaderboard.folder
    built, present = build.content(leaderboard), build.present(folder)
    missing, stale = sorted(built.keys() - present), sorted(present - built.keys())
    problems = [f"{folder / name} is missing; run `ventbench board build`" for name in missing]
    problems += [f"{folder / name} belongs to no record" for name in stale]
    for name in sorted(built.keys() & present):
        now = (folder / name).read_bytes()
        if now != built[name]:
            byte = _first_difference(now, built[name])
            problems.append(f"{folder / name} is not what the records give: byte {byte}")
    return problems


def _first_difference(a: bytes, b: bytes) -> int:
    """Index of the first byte that differs, or the length of the shorter one."""
    pairs = enumerate(zip(a, b, strict=False))
    return next((i for i, (x, y) in pairs if x != y), min(len(a), len(b)))


def _check_replay(
    folder: Path,
    scores: Sequence[Record],
    load: Load,
    known: Mapping[str, season_files.Season],
    report: Report,
    progress: Progress | None,
) -> dict[str, Floats]:
    """Replay records and note in the report what differs.

    Returns:
        What ranks as replayed, shape ``(L, K)``, by the record's hash; see
        :attr:`ventbench.board.record.Record.ranked_values`.
    """
    by_draw: dict[str, Floats] = {}
    for group in _by_simulators(scores, report):
        header = group[0].header
        simulators = _simulators(header.simulators, load, report)
        if simulators is None:
            continue
        try:
            season = known.get(header.draws.season or "")
            drawn = draws_of(header, simulators, season.revealed if season else None)
        except InputError as error:
            report.problems += [f"record {score.sha256}, {error}" for score in group]
            continue
        report.problems += _wrong_reference(folder, known, group)
        for first in range(0, len(group), BATCH):
            batch = group[first : first + BATCH]
            by_draw |= _replay_batch(folder, batch, simulators, drawn, report)
            if progress is not None:
                progress(min(first + BATCH, len(group)), len(group))
    return by_draw


def _check_ranks(leaderboard: store.Store, by_draw: Mapping[str, Floats]) -> list[str]:
    """Ranks that recorded errors give and replayed ones do not: nobody gains by a rounding error.

    Args:
        leaderboard: all that could be read.
        by_draw: replayed values that rank; a record without them keeps its own.
    """
    problems = []
    standings = ranking.standings(leaderboard.records, leaderboard.attested, leaderboard.breaches)
    for tracks in standings.values():
        for name, standing in tracks.items():
            records = [entry.record for entry in standing.ranked]
            recorded = ranking.places(records, [score.ranked_values for score in records])
            again = [by_draw.get(x.sha256, x.ranked_values) for x in records]
            replayed = ranking.places(records, again)
            problems += [
                f"record {score.sha256} ({score.name}): ranks {said} on the {name} track by its "
                f"recorded errors, {given} by those that all commands give"
                for score, said, given in zip(records, recorded, replayed, strict=True)
                if said != given
            ]
    return problems


def _by_simulators(scores: Sequence[Record], report: Report) -> list[list[Record]]:
    """Records that can be replayed together."""
    groups: dict[str, list[Record]] = {}
    old: set[int] = set()
    for score in scores:
        if score.version > max(protocol.VERSIONS):
            report.problems.append(
                f"record {score.sha256}, key protocol: version {score.version} is not known to "
                "this ventbench"
            )
        elif score.version < min(protocol.VERSIONS):
            old.add(score.version)
        else:
            groups.setdefault("".join((str(score.version), *score.basis[:2])), []).append(score)
    report.notes += [
        f"records of protocol version {version} were not replayed; an older ventbench does that"
        for version in sorted(old)
    ]
    return list(groups.values())


def _wrong_reference(
    folder: Path, known: Mapping[str, season_files.Season], group: Sequence[Record]
) -> list[str]:
    """Records of one season whose reference errors are not those of the season."""
    score = group[0]
    season = known.get(score.header.draws.season or "")
    development = score.header.draws.season == rig_draws.DEVELOPMENT
    if score.headroom is None or not (development or (season and season.revealed)):
        return []
    try:
        own = published()
        if season is not None and season.revealed is not None and not development:
            own = sealed.open_reference(folder, season, season.revealed)
        reference = reference_of(score.header.simulators, score.header.draws.about(), own)
    except InputError as error:
        return [f"record {score.sha256}, key headroom: {error}"]
    assert reference is not None
    return [
        f"record {entry.sha256}, {text}"
        for entry in group
        for text in sealed.other_reference(entry, reference)
    ]


def _simulators(recorded: Mapping[str, Any], load: Load, report: Report) -> ReplayPlants | None:
    """Load the simulators that records name; None, and a problem, where that is impossible."""
    version = recorded.get("version")
    if not isinstance(version, int):  # it becomes part of a path
        report.problems.append(f"simulators: a record names version {version!r}, not a number")
        return None
    try:
        simulators = load(version)
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
    drawn: RigDraws | None,
    report: Report,
) -> dict[str, Floats]:
    sound, requested = [], []
    by_draw: dict[str, Floats] = {}
    for score in batch:
        try:
            requested.append(actions.load(score, folder / store.RECORDS))
            sound.append(score)
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    if not sound:
        return by_draw
    runs = replay(simulators, sound[0].pips, requested, drawn)
    for score, replayed in zip(sound, runs, strict=True):
        report.replayed += 1
        report.deviation = max(report.deviation, deviation(score, replayed))
        path = folder / store.RECORDS / f"{score.sha256}{record.SUFFIX}"
        report.problems += [f"{path}, {text}" for text in differences(score, replayed)]
        failed = np.isnan(score.drawn)
        values = replayed.drawn
        if score.headroom is not None and replayed.controllable is not None:
            own = score.headroom
            values = normalised(replayed.controllable, own.attainable, own.pid)[1:]
        by_draw[score.sha256] = np.where(failed, np.nan, values).mean(axis=2).T
    return by_draw
