"""Everything again: hashes, signatures, the replay of all commands, and the code of records.

Nothing stops at the first problem: each names its file, and the key or line in it. Replay proves
that errors follow from commands; :func:`rerun` runs the code of a record once more in the sandbox,
which proves that the commands come from the code whose hashes the record names. It trusts no file
of an earlier run; several processes can share the work.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.board import attestation, canonical, create, ranking, rounds, store
from ventbench.board.canonical import ATTESTATIONS, RECORDS
from ventbench.board.record import AnyRecord, Record, RecordStress
from ventbench.board.replay import (
    BATCH,
    Replayed,
    ReplayPlants,
    deviation,
    differences,
    draws_of,
    replay,
)
from ventbench.board.rounds import Round
from ventbench.board.store import Store
from ventbench.entries import reference as references
from ventbench.entries.folder import Submission, combined_hash, file_hashes, open_submission
from ventbench.entries.reference import published, reference_of
from ventbench.entries.runner import Runner
from ventbench.entries.runs import Runs, pip_columns
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import rigs_of
from ventbench.task import protocol, stressors
from ventbench.task.draws import Draws
from ventbench.task.metrics.score import normalised

Floats = NDArray[np.float64]

#: What a second run can show.
REPRODUCED, DIFFERENT, NOT_RERUN = "reproduced", "different", "not re-run"

#: Most that a command up to 100 % may differ from the recorded one, %; larger requests by the same
#: share. Another processor, or simulators whose
#: sums run in another order, move the last bit of a pressure; a controller in single precision
#: makes up to 1e-5 % of that, and feedback some more. No score shows a thousandth of a percent.
COMMAND_TOLERANCE = 1e-3

#: Most that the error of a stress run may differ, cmH2O, where commands are not equal to the bit.
STRESS_TOLERANCE = 1e-3

#: Most that errors of bounds may differ from what their commands give, cmH2O.
BOUNDS_TOLERANCE = 1e-9

#: Most folders of submissions that are looked through in one place.
MAX_FOLDERS = 5000

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
            :func:`rerun`.
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
    vouched, problems = attestation.attested(folder, store.measured(entries))
    report.problems += problems if len(entries) == len(paths) else []
    leaderboard = Store(folder, entries, vouched, tuple(_rounds(folder, load, report)))
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
        elif whole and path.parts[0] == RECORDS and path.suffix != canonical.RECORD_SUFFIX:
            of = commands if path.suffix == canonical.ACTIONS_SUFFIX else named
            if path.stem not in of:
                problems.append(f"{folder / name} belongs to no record; remove it")
    return problems


def _check_replay(
    leaderboard: Store, load: Load, report: Report, progress: Progress | None
) -> dict[str, Floats]:
    """Replay records and note in the report what differs.

    Returns:
        What ranks as replayed, shape ``(L, k)``, by the record's hash; see
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
            drawn = draws_of(header, simulators, leaderboard.evidence.rounds)
        except InputError as error:
            report.problems += [f"record {score.sha256}, {error}" for score in group]
            continue
        own = leaderboard.evidence.rounds.get(header.draws.season)
        report.problems += _wrong_reference(group, own)
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
    for track in ranking.board(leaderboard):
        if track.round is None or not track.ranked:
            continue
        entries = [row.entry for row in track.ranked]
        again = [by_draw.get(x.record.sha256, x.record.ranked_values) for x in entries]
        problems += [
            f"record {row.record.sha256} ({row.record.name}): ranks {row.rank} on the "
            f"{track.name} track by its recorded errors, {given} by those that all commands give"
            for row, given in zip(track.ranked, ranking.ranks_of(entries, again).rank, strict=True)
            if row.rank != given
        ]
    return problems


def _rounds(folder: Path, load: Load, report: Report) -> Iterator[Round]:
    """Read the rounds, newest first, and note what is wrong with them.

    Entries stay as they were ranked until the next round is open.
    """
    made: list[Round] = []
    for name in rounds.names(folder):
        try:
            made.append(rounds.load(folder, name))
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    made.sort(key=lambda x: x.opened.closes, reverse=True)
    for at, own in enumerate(made):
        yield own
        if own.frozen is None:
            continue
        simulators = _loaded(load, report)
        if simulators is None:
            return
        for key in rounds.protocol_differences(own, simulators.about()):
            report.problems.append(f"{own.folder}: this ventbench has another protocol: {key}")
        available = list(folders([folder.parent / "submissions"]))
        for entry in own.frozen.entries if at == 0 else ():
            named = [x for x in available if x.name == entry.name]
            if named and all(combined_hash(file_hashes(x)) != entry.sha256 for x in named):
                report.problems.append(
                    f"{named[0]} is not what was frozen in round {own.name}, {entry.sha256[:12]}"
                )
        if own.result is not None:
            report.problems += _wrong_bounds(own, simulators)


def _wrong_bounds(own: Round, simulators: ReplayPlants) -> list[str]:
    """Say whether the bounds of a round are what their commands and its PIDs give."""
    rigs = rigs_of(simulators)
    try:
        drawn, bounds = own.draws(rigs), own.bounds()
        references.reference_of(rigs.about, drawn.about(), bounds)
    except (InputError, OSError) as error:
        return [str(error)]
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    attained = references.witness_errors(bounds, plants, cells) - bounds.attainable
    pid = references.pid_errors(plants, cells, bounds.gains) - bounds.pid
    if max(np.abs(attained).max(), np.abs(pid).max()) > BOUNDS_TOLERANCE:
        return [f"{own.folder / rounds.BOUNDS}: its commands or PIDs do not attain its errors"]
    return []


def _wrong_reference(group: Sequence[Record], own: Round | None) -> list[str]:
    """Records whose reference errors are not those of their round, or the published ones."""
    header = group[0].header
    try:
        given = published() if own is None else own.bounds()
        reference = reference_of(header.simulators, header.draws.about(), given)
    except (InputError, OSError) as error:
        return [f"record {group[0].sha256}, key headroom: {error}"]
    assert reference is not None
    tables = {"attainable": reference.attainable, "pid": reference.pid}
    return [
        f"record {score.sha256}, key headroom.{key}: not the reference errors of its draws"
        for score in group
        for key, table in tables.items()
        if not np.array_equal(getattr(score.headroom, key), np.moveaxis(table, 1, 0))
    ]


def _simulators(recorded: Mapping[str, Any], load: Load, report: Report) -> ReplayPlants | None:
    """Load the simulators; None, and a problem, where they are not those that records name."""
    simulators = _loaded(load, report)
    if simulators is None:
        return None
    here = canonical.through_json(simulators.about())
    if here == recorded:
        return simulators
    keys = sorted(key for key in {*here, *recorded} if here.get(key) != recorded.get(key))
    report.problems.append(
        f"simulators: those of this ventbench are not those of the records; {', '.join(keys)} "
        "differ"
    )
    return None


def _loaded(load: Load, report: Report) -> ReplayPlants | None:
    """Load the simulators; None, and a problem, where they are damaged."""
    try:
        simulators = load()
        canonical.through_json(simulators.about())
        return simulators
    # A damaged manifest can lack anything; InputError is a ValueError.
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        text = f"simulators: {error if isinstance(error, InputError) else repr(error)}"
        report.problems += [text] if text not in report.problems else []
        return None


def _replay_batch(
    folder: Path,
    batch: Sequence[Record],
    simulators: ReplayPlants,
    drawn: Draws,
    report: Report,
) -> dict[str, Floats]:
    sound, requested = [], []
    by_draw: dict[str, Floats] = {}
    for score in batch:
        try:
            requested.append(store.load_commands(score, folder / RECORDS))
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
        texts = differences(score, replayed) + unstressed_difference(score, replayed)
        report.problems += [f"{path}, {text}" for text in texts]
        own, failed = score.headroom, np.isnan(score.drawn)
        values = normalised(replayed.controllable, own.attainable, own.pid)[1:]
        by_draw[score.sha256] = np.where(failed, np.nan, values).mean(axis=2).T[:, own.ranked]
    return by_draw


def unstressed_difference(record: Record, replayed: Replayed) -> list[str]:
    """Say where runs of the stress track without a stressor are not those of the same draws.

    They are the same cells, so that a record whose other figures replay holds these twice.
    """
    if record.stress is None:
        return []
    tables = record.stress.tables
    draws = np.flatnonzero(record.headroom.ranked)[: tables.pips.shape[1]]
    at = draws, np.arange(len(record.lungs))[:, None], pip_columns(*tables.pips.shape)
    pairs = {
        "errors": (tables.error[0], replayed.drawn[at], STRESS_TOLERANCE),
        "peak_centi_cmH2O": (tables.peak[0], replayed.peak[1:][at], 0.011),
    }
    return [
        f"key stress.{key}: without a stressor not what the same draws give, by up to "
        f"{np.nanmax(np.abs(own - given)):.3g}"
        for key, (own, given, tolerance) in pairs.items()
        if np.any(np.abs(own - given) > tolerance)  # a failed run has no error
    ]


@dataclass(frozen=True)
class Outcome:
    """What the second run of a record showed.

    Attributes:
        record: SHA-256 of the record.
        name: of the entry.
        track: of the record.
        state: ``"reproduced"``, ``"different"`` or ``"not re-run"``.
        detail: what differs, or why it was not run again; for a reproduced record how close its
            commands are.
        seconds: that the run took.
    """

    record: str
    name: str
    track: str
    state: str
    detail: str = ""
    seconds: float = 0.0

    def __str__(self) -> str:
        detail = f": {self.detail}" if self.detail else ""
        return f"record {self.record} ({self.name}, {self.track}): {self.state}{detail}"


def sandboxed() -> Runner:
    """The runner of official scores.

    Raises:
        SandboxError: if this machine lacks a layer that they need.
    """
    from ventbench.sandbox.runner import SandboxRunner

    return SandboxRunner(require_official=True)


def frozen_simulators() -> ReplayPlants:
    """The frozen simulators.

    Raises:
        InputError: if they were changed.
    """
    from ventbench.plants import frozen

    return frozen.load()


def rerun(
    folder: Path,
    *,
    records: Sequence[str] = (),
    sources: Sequence[Path] = (),
    jobs: int = 1,
    scheduler: str | None = None,
    load: Callable[[], ReplayPlants] = frozen_simulators,
    runner: Callable[[], Runner] = sandboxed,
    progress: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Run the code of records again and compare commands.

    Args:
        folder: of the leaderboard.
        records: hashes of the records, or the beginnings of them; all scores if empty.
        sources: folders with the code: of one submission, or of several.
        jobs: number of processes; 1 for this one alone.
        scheduler: address of a Dask scheduler instead, whose workers see the same files.
        load: gives the simulators; outside of this process, a function of a module.
        runner: gives the runner; outside of this process, a function of a module.
        progress: called after each record.

    Returns:
        One outcome a record, oldest first.

    Raises:
        InputError: if a hash names no record, this machine cannot run submissions as official
            scores are run, or a worker process died.
        OSError: if a file cannot be read or written.
    """
    board = store.load(folder)
    chosen = {store.find_record(board, sha256, Record).sha256 for sha256 in records}
    scores = [score for score in board.scores if not chosen or score.sha256 in chosen]
    about = canonical.through_json(load().about())
    outcomes: dict[str, Outcome] = {}
    todo: dict[str, tuple[Any, ...]] = {}

    def note(outcome: Outcome) -> None:
        outcomes[outcome.record] = outcome
        if progress is not None:
            progress(outcome)

    available = list(folders([folder.parent / "submissions", *sources]))
    for score in scores:
        code, why = _code_of(score, available, about)
        if code is None:
            note(Outcome(score.sha256, score.name, score.track, NOT_RERUN, why))
        else:
            todo[score.sha256] = score.sha256, code.resolve(), folder.resolve(), load, runner
    with executor(jobs if jobs > 1 and scheduler is None else 0, scheduler) as pool:
        for _, outcome in results(pool, _run, todo):
            note(outcome)
    return [outcomes[score.sha256] for score in scores]


def folders(places: Sequence[Path]) -> Iterator[Path]:
    """Folders that may hold a submission: the places themselves and those in them."""
    for place in (*places, files.submissions_folder()):
        if not place.is_dir():
            continue
        yield place
        inside = (path for path in sorted(place.iterdir())[:MAX_FOLDERS] if not path.is_symlink())
        yield from (path for path in inside if path.is_dir())


def _code_of(
    score: Record, available: Sequence[Path], simulators: Mapping[str, Any]
) -> tuple[Path | None, str]:
    """Find the code that a record names by its hashes; else why it cannot be run again."""
    if score.header.simulators != simulators:
        return None, "it was scored on other simulators than those of this ventbench"
    wanted = score.header.submission.files
    for folder in available:
        # By its files first: hashing every folder for every record would take long.
        if all((folder / name).is_file() for name in wanted) and file_hashes(folder) == wanted:
            return folder, ""
    return None, "no folder at hand has the files that it names; give --source DIR"


def _run(
    sha256: str,
    code: Path,
    folder: Path,
    load: Callable[[], ReplayPlants],
    runner: Callable[[], Runner],
) -> Outcome:
    """Run the code of one record, which is read again, and compare."""
    score = store.find_record(store.load(folder), sha256, Record)
    assert isinstance(score, Record)
    simulators, apart = load(), runner()
    begun = time.perf_counter()
    try:
        submission = open_submission(str(code))
        _check_same(submission, score)
        stress = 0 if score.stress is None else score.stress.tables.pips.shape[1]
        known = store.load(folder).evidence.rounds
        result = run_protocol(
            submission, rigs_of(simulators), track=score.track, stress=stress, runner=apart,
            drawn=draws_of(score.header, simulators, known),
        )  # fmt: skip
        _check_same(open_submission(str(code)), score)
        recorded = store.load_commands(score, folder / RECORDS)
        detail = difference(score, recorded, result.requested)
        closeness = _closeness(recorded, result.requested)
        failed = {(x.lung, x.pip, x.draw) for x in result.failures}
        if not detail and failed != {(x.lung, x.pip, x.draw) for x in score.header.failures}:
            detail = f"{len(failed)} cells failed, {score.header.failed_cells} in the record"
        if not detail and score.stress is not None and result.stressed is not None:
            detail = stress_difference(score.stress, result.stressed)
            same = create.stress_digest(result.stressed) == score.stress.commands_sha256
            closeness += f", stress {'to the bit' if same else 'within tolerance'}"
    except (InputError, FloatingPointError) as error:
        detail, closeness = f"its code cannot be run: {error}", ""
    seconds = round(time.perf_counter() - begun, 1)
    state = DIFFERENT if detail else REPRODUCED
    return Outcome(score.sha256, score.name, score.track, state, detail or closeness, seconds)


def _check_same(submission: Submission, score: Record) -> None:
    """Refuse code that has changed since it was found."""
    if submission.sha256 != score.header.submission.sha256:
        raise InputError(f"{submission.label} was changed while it ran")


def stress_difference(recorded: RecordStress, again: Runs) -> str:
    """Describe how runs of the stress track differ from the recorded ones; empty if they do not.

    Args:
        recorded: figures and hash of the commands.
        again: the second run.
    """
    if recorded.stressors != stressors.VERSION:
        return f"stress: its stressors are version {recorded.stressors}, not {stressors.VERSION}"
    tables = recorded.tables
    pairs = {
        "errors": (tables.error, again.error, STRESS_TOLERANCE),
        "safe": (tables.safe, again.safe, 0.0),
        "survived": (tables.survived, again.survived, 0.0),
        "above_alarm_ms": (tables.alarm_s, again.alarm_s, 1e-3),
        "peak_centi_cmH2O": (tables.peak, again.peak, 0.011),
        "volume_mL": (tables.volume, again.volume, 1.0),
    }
    for key, (old, new, tolerance) in pairs.items():
        # A failed run has no error; -1 stands for it on both sides.
        ours, theirs = (np.nan_to_num(np.asarray(x, float), nan=-1.0) for x in (new, old))
        off = np.abs(ours - theirs)
        if off.max() > tolerance:
            return f"stress.{key}: differs by up to {off.max():.3g} from the record"
    return ""


def _closeness(recorded: Floats, again: Floats) -> str:
    """Say how close commands of equal shape are."""
    if recorded.shape != again.shape:
        return ""
    if not _bits_apart(recorded, again).any():
        return "to the bit"
    return f"commands within {np.abs(recorded - again).max():.1e} %"


def _bits_apart(recorded: Floats, again: Floats) -> NDArray[np.bool_]:
    bits = (np.ascontiguousarray(x, np.float64).view(np.uint64) for x in (recorded, again))
    return np.not_equal(*bits)


def difference(score: Record, recorded: Floats, again: Floats) -> str:
    """Describe how commands differ from the recorded ones; empty if they agree.

    They agree within `COMMAND_TOLERANCE`, of which a processor's last bits are a small part.

    Args:
        score: whose commands they are.
        recorded: %, shape ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``.
        again: commands of the second run, of the same shape.
    """
    if recorded.shape != again.shape:
        return f"commands of shape {again.shape}, {recorded.shape} in the record"
    # Not `>`: whatever is no number is apart, too.
    allowed = COMMAND_TOLERANCE * np.maximum(1.0, np.abs(recorded) / 100.0)
    apart = ~(np.abs(recorded - again) <= allowed)
    if not apart.any():
        return ""
    lung, draw, pip, breath, step = np.argwhere(apart)[0]
    cells = int(apart.any(axis=(-2, -1)).sum())
    run = f"draw {draw}" if draw else "nominal"
    where = (
        f"{score.lungs[lung]}, PIP {score.pips[pip]:g}, {run}, breath {breath + 1}, step {step + 1}"
    )
    first = lung, draw, pip, breath, step
    return (
        f"commands differ in {cells} of {apart[..., 0, 0].size} cells, by up to "
        f"{np.abs(recorded - again).max():.3g} %; first in {where}: {recorded[first]:.12g} % in "
        f"the record, {again[first]:.12g} % now"
    )
