"""Official runs in the sandbox: every frozen entry of a round, and second runs of records.

**Rounds.** Bounds of the draws come first, where no submission has run; then every entry on them,
each in a job with a folder of its own; then :func:`close` takes records and failures out of these
folders, as data that a stranger may have written. What is finished is kept, so that the same
command continues. Jobs are small: workers of a cluster need to see the same files. An entry that
cannot be run, or whose job left nothing, has no record, and the result says why.

**Second runs** prove that commands come from the code whose hashes a record names, and what it says
of the stress track. No file of an earlier run is trusted; several processes can share the work.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.executor import Progress, executor, results
from ventbench.board import attestation, canonical, create, record, rounds, schema, store
from ventbench.board.canonical import RECORDS, SEEDS
from ventbench.board.record import Record
from ventbench.board.replay import Load, ReplayPlants, protocol_of, require_replay, seed_scores
from ventbench.board.rounds import BOUNDS, RESULT, Entered, Result, Round
from ventbench.entries import cells
from ventbench.entries import reference as references
from ventbench.entries.cells import Runner
from ventbench.entries.folder import (
    CONTROLLER,
    MAX_SEEDS,
    combined_hash,
    file_hashes,
    frozen_copy,
    seeds,
    with_seed,
)
from ventbench.entries.reference import Reference
from ventbench.entries.runs import DRAWS
from ventbench.entries.scoring import run_protocol
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import environment, protocol

#: What a second run can show.
REPRODUCED, DIFFERENT, NOT_RERUN = "reproduced", "different", "not re-run"

#: Most that a command may differ from the recorded one, %: one step and rounding. Another
#: processor, or sums in another order, move the last bit of a pressure, and of a request.
COMMAND_TOLERANCE = 1.5 * protocol.RESOLUTION

#: Most folders of submissions that are looked through in one place.
MAX_FOLDERS = 5000


@dataclass(frozen=True)
class Outcome:
    """What the second run of a record showed."""

    record: Record  #: that was run again.
    state: str  #: ``"reproduced"``, ``"different"`` or ``"not re-run"``.
    #: what differs, or why it was not run again; for a reproduced record how close its commands
    #: are.
    detail: str = ""

    def __str__(self) -> str:
        detail = f": {self.detail}" if self.detail else ""
        record = self.record
        return f"record {record.sha256} ({record.name}, {record.track}): {self.state}{detail}"


def sandboxed() -> Runner:
    """The runner of official scores of one entry, which has a budget of time for all of its runs.

    Raises:
        SandboxError: if this machine lacks a layer that they need.
    """
    from ventbench.sandbox.pipes import Budget
    from ventbench.sandbox.runner import SandboxRunner

    return SandboxRunner(require_official=True, budget=Budget(protocol.ENTRY_S))


def rerun(
    folder: Path,
    *,
    records: Sequence[str] = (),
    sources: Sequence[Path] = (),
    workers: int = 0,
    scheduler: str | None = None,
    load: Load = frozen.load,
    runner: Callable[[], Runner] = sandboxed,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Run the code of records again and compare commands.

    Args:
        folder: of the leaderboard.
        records: hashes of the records, or the beginnings of them; all scores if empty.
        sources: folders with the code: of one submission, or of several.
        workers: number of processes; 0 for this one alone.
        scheduler: address of a Dask scheduler instead, whose workers see the same files.
        load: gives the simulators; outside of this process, a function of a module.
        runner: gives the runner; outside of this process, a function of a module.
        progress: called with how many of how many were run again.

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
    identity = canonical.through_json(load().about())
    available = code_in([folder.parent / "submissions", *sources])
    outcomes: dict[str, Outcome] = {}
    todo: dict[str, tuple[Any, ...]] = {}
    for score in scores:
        code = available.get(score.header.submission.sha256)
        if score.header.simulators != identity:
            why = "it was scored on other simulators than those of this ventbench"
        elif code is None:
            why = "no folder at hand has the files that it names; give --source DIR"
        else:
            round_ = board.round_of(score)
            todo[score.sha256] = score, round_, code, folder.resolve(), load, runner
            continue
        outcomes[score.sha256] = Outcome(score, NOT_RERUN, why)
    with executor(workers, scheduler) as pool:
        for done, (sha256, outcome) in enumerate(results(pool, _run, todo), 1):
            outcomes[sha256] = outcome
            if progress is not None:
                progress(done, len(todo))
    return [outcomes[score.sha256] for score in scores]


def folders(places: Iterable[Path]) -> Iterator[Path]:
    """Folders that may hold a submission: the places themselves and those in them."""
    for place in (*places, files.submissions_folder()):
        if not place.is_dir():
            continue
        yield place
        inside = (path for path in sorted(place.iterdir())[:MAX_FOLDERS] if not path.is_symlink())
        yield from (path for path in inside if path.is_dir())


def code_in(places: Iterable[Path]) -> dict[str, Path]:
    """Folders that hold a submission, the first of each, by the hash of its files."""
    found: dict[str, Path] = {}
    for folder in folders(places):
        if (folder / CONTROLLER).is_file():
            found.setdefault(combined_hash(file_hashes(folder)), folder.resolve())
    return found


def _run(
    score: Record,
    round_: Round | None,
    code: Path,
    folder: Path,
    load: Load,
    runner: Callable[[], Runner],
) -> Outcome:
    """Run the code of one record, and compare."""
    header, closest, simulators, apart = score.header, list[str](), load(), runner()
    try:
        protocol_ = protocol_of(header, simulators, round_)
        if header.stress is None:
            protocol_ = replace(protocol_, stressed=None)
        with TemporaryDirectory() as place:
            submission = frozen_copy(code, header.submission.sha256, Path(place))
            result = run_protocol(submission, protocol_, track=score.track, runner=apart)
        runs: list[tuple[Any, ...]] = [
            (header.commands, result.requested, result.failures, header.failures)
        ]
        if (stress := header.stress) is not None and (stressed := result.stressed) is not None:
            again = np.asarray(stressed.requested), stressed.failures
            runs.append((stress.commands, *again, stress.failures))
        for commands, requested, *failures in runs:
            recorded = store.load_commands(commands, folder / RECORDS)
            again = environment.resolved(requested)
            failed, named = ({(x.condition, x.lung, x.pip, x.draw) for x in y} for y in failures)
            detail = difference(recorded, again)
            if not detail and failed != named:
                detail = f"{len(failed)} cells failed, {len(named)} in the record"
            if detail:
                return Outcome(score, DIFFERENT, detail)
            off = np.abs(recorded - again).max()
            closest.append(f"commands within {off:.1e} %" if off else "to the bit")
    except (InputError, FloatingPointError) as error:
        why = f"its code cannot be run: {error}"
        return Outcome(score, DIFFERENT, why)
    closeness = ", under stress ".join(closest)
    return Outcome(score, REPRODUCED, closeness)


def difference(recorded: Floats, again: Floats) -> str:
    """Describe how commands ``(..., BREATHS, STEPS)`` differ; empty if they agree.

    They agree within `COMMAND_TOLERANCE`: a processor's last bits may move one by a step.
    """
    if recorded.shape != again.shape:
        return f"commands of shape {again.shape}, {recorded.shape} in the record"
    # Not `>`: whatever is no number is apart, too.
    apart = ~(np.abs(recorded - again) <= COMMAND_TOLERANCE)
    if not apart.any():
        return ""
    first = tuple(np.argwhere(apart)[0].tolist())
    cells = int(apart.any(axis=(-2, -1)).sum())
    return (
        f"commands differ in {cells} of {apart[..., 0, 0].size} cells, by up to "
        f"{np.abs(recorded - again).max():.3g} %; first in cell {first[:-2]}, breath "
        f"{first[-2] + 1}, step {first[-1] + 1}: {recorded[first]:.12g} % in the record, "
        f"{again[first]:.12g} % now"
    )


#: Processor time of a plain entry on a track, sandbox included, s; the robustness track has the
#: stressed runs too. As ``time ventbench score pid_robust`` counts; networks take twice as long.
SECONDS = {"performance": 13.0, "robustness": 58.0}

#: Told what is going on, and how far it is.
StageProgress = Callable[[str, int, int], None]


def plan(round_: Round) -> list[tuple[str, str]]:
    """Name and track of every run of a round that has draws.

    Raises:
        InputError: if it is not drawn, or is scored already.
    """
    if round_.state != "drawn":
        raise InputError(f"round {round_.name} is {round_.state}; it is scored once it is drawn")
    return [run[:2] for run in round_.runs.values()]


def code_of(round_: Round, places: Iterable[Path]) -> dict[str, Path]:
    """Find the folder of every frozen entry by its hash.

    Raises:
        InputError: naming the entries whose code is not at hand.
    """
    found = code_in(places)
    code = {x.name: found[x.sha256] for x in round_.entries if x.sha256 in found}
    if missing := sorted({x.name for x in round_.entries} - set(code)):
        raise InputError(
            f"the code of {', '.join(missing)}, as it was frozen, is not at hand; give --source DIR"
        )
    return code


def bounds_of(
    round_: Round,
    simulators: ReplayPlants,
    pool: Executor,
    folder: Path,
    *,
    progress: Progress | None = None,
) -> Reference:
    """Best attainable and best PID of the draws of a round, with the PIDs of the protocol."""
    rigs = rigs_of(simulators)
    draws = round_.draws(rigs)
    plants, cells = rigs.cells(draws, protocol.PIPS)
    settings = references.settings(rigs.about, draws.about())
    return references.compute(
        plants,
        cells,
        np.array(references.PID_GAINS),
        settings,
        folder=folder,
        pool=pool,
        progress=progress,
    )


def bound(
    leaderboard: Path,
    name: str,
    pool: Executor,
    work: Path,
    *,
    load: Load = frozen.load,
    progress: Progress | None = None,
) -> Round:
    """Write the bounds of a round's draws, unless they are there; runs no submission.

    Args:
        leaderboard: its folder.
        name: of the round.
        pool: executor of the draws.
        work: folder for what is finished.
        load: gives the simulators.
        progress: called with the number of cells done, and of all.

    Raises:
        InputError: if the round cannot be scored, or its bounds are of other draws.
        OSError: if a file cannot be read or written.
    """
    round_, simulators = _load_scorable(leaderboard, name), load()
    if different := rounds.protocol_differences(round_, simulators.about()):
        raise InputError(f"round {name} has another protocol: {', '.join(different)}")
    if not (path := round_.folder / BOUNDS).exists():
        bounds = bounds_of(round_, simulators, pool, work / "bounds", progress=progress)
        bounds.save(path)
    rigs = rigs_of(simulators)
    references.reference_of(rigs.about, round_.draws(rigs).about(), round_.bounds())
    return round_


def score(
    leaderboard: Path,
    name: str,
    pool: Executor,
    work: Path,
    *,
    places: Iterable[Path],
    only: Sequence[str] = (),
    load: Load = frozen.load,
    runner: Callable[[], Runner] = sandboxed,
    secret: str | None = None,
    progress: StageProgress | None = None,
) -> Round:
    """Score every frozen entry, write its records, and close the round.

    Args:
        leaderboard: its folder.
        name: of the round.
        pool: executor of bounds and entries.
        work: folder for what is finished.
        places: folders with the code.
        only: entries to score alone, in a job of their own: what they give is kept in ``work``, and
            the same without it closes the round.
        load: gives the simulators; outside of this process, a function of a module.
        runner: gives the runner of an entry; outside of this process, a function of a module.
        secret: key that signs the records; without one they have no rank.
        progress: called with what is going on, how much of it is done, and of how much.

    Raises:
        InputError: if the round cannot be scored, code is missing, or what is kept is of another
            round.
        OSError: if a file cannot be read or written.
    """
    tell = progress or (lambda stage, completed, count: None)
    code = code_of(_load_scorable(leaderboard, name), places)
    bounds_progress = functools.partial(tell, "bounds of the draws")
    round_ = bound(leaderboard, name, pool, work, load=load, progress=bounds_progress)
    bounds = files.sha256(round_.folder / BOUNDS)
    chosen = [x for x in round_.entries if x.name in (only or code)]
    jobs = {
        x.name: (leaderboard.resolve(), name, x, code[x.name], work.resolve(), load, runner)
        for x in chosen
        if not (path := _job(work, x.name) / RESULT).exists() or not _job_result(path, bounds)
    }
    count = len(chosen) - len(jobs)
    tell("entries and their seeds", count, len(chosen))
    for completed, _ in enumerate(results(pool, _score_entry, jobs), count + 1):
        tell("entries and their seeds", completed, len(chosen))
    if only:
        return round_
    return close(leaderboard, name, work, load=load, secret=secret, progress=tell)


def _load_scorable(leaderboard: Path, name: str) -> Round:
    round_ = rounds.load(leaderboard, name)
    plan(round_)
    return round_


def _job(work: Path, entry: str) -> Path:
    """Folder that the job of an entry leaves."""
    return work / f"entry-{entry}"


def _job_result(path: Path, bounds: str) -> Result:
    """Read the result that the job of an entry has left; InputError if it is of other bounds."""
    result = schema.read_canonical(Result, path)
    if result.bounds != bounds:
        raise InputError(f"{path} is of other draws or bounds; remove the folder")
    return result


def _score_entry(
    leaderboard: Path,
    name: str,
    entry: Entered,
    code: Path,
    work: Path,
    load: Load,
    runner: Callable[[], Runner],
) -> None:
    """Score an entry on its tracks, and with the weights of each of its seeds, all by one runner.

    Leaves its records, commands of its seeds, and its part of the result, in a folder of its own.
    """
    round_, simulators = rounds.load(leaderboard, name), load()
    rigs, apart = rigs_of(simulators), runner()
    draws, bounds = round_.draws(rigs), round_.bounds()
    under_stress = cells.protocol_of(rigs, drawn=draws, stress=DRAWS, reference=bounds)
    unstressed = replace(under_stress, stressed=None)
    job_result, folder = Result(files.sha256(round_.folder / BOUNDS), {}), _job(work, entry.name)
    of_seeds: dict[str, list[schema.Commands]] = {}
    with TemporaryDirectory() as place:
        for track, seed in itertools.product(entry.tracks, ["", *(x.name for x in seeds(code))]):
            key = rounds.key_of(entry.name, track)
            try:
                at = Path(place) / f"{track}{seed}"
                submission = frozen_copy(code, entry.sha256, at)
                if seed:
                    submission = with_seed(submission, seed, at / "seed")
                protocol_ = under_stress if track == "robustness" and not seed else unstressed
                result = run_protocol(submission, protocol_, track=track, runner=apart)
                if seed:
                    if result.failures:
                        raise InputError("a cell failed")
                    commands = store.save_commands(np.asarray(result.requested), folder)
                    of_seeds.setdefault(key, []).append(commands)
                    continue
                provenance: Mapping[str, Any] = {"round": name, "frozen": round_.frozen_sha256}
                draft = create.create(result, simulators, source=provenance)
                job_result.records[key] = draft.save(folder).stem
            except (InputError, FloatingPointError, OSError) as error:
                why = str(error)[: schema.MAX_TEXT]
                job_result.failed[f"{key}, seed {seed}" if seed else key] = why
    _write(folder, of_seeds, job_result)


def _write(folder: Path, of_seeds: Mapping[str, list[schema.Commands]], result: Result) -> None:
    """Write a result, and before it the commands of seeds, if there are any."""
    for name, content in ((SEEDS, of_seeds), (RESULT, result)):
        if content:
            written = canonical.canonical(msgspec.to_builtins(content))
            files.write_bytes(folder / name, written)


def close(
    leaderboard: Path,
    name: str,
    work: Path,
    *,
    load: Load = frozen.load,
    secret: str | None = None,
    progress: StageProgress | None = None,
) -> Round:
    """Write records and result of a round from what the jobs of its entries left; runs none.

    A job that left nothing, or what it must not, loses its entry and no other one.

    Args:
        leaderboard: its folder, with the bounds of the round.
        name: of the round.
        work: folder of the jobs, one folder each.
        load: gives the simulators.
        secret: key that signs the records; without one they have no rank.
        progress: called with what is going on, how much of it is done, and of how much.

    Raises:
        InputError: if the round is not drawn, or the key is none of the leaderboard's.
        OSError: if a file cannot be written.
    """
    round_, simulators = _load_scorable(leaderboard, name), load()
    result = Result(files.sha256(round_.folder / BOUNDS), {})
    of_seeds: dict[str, list[schema.Commands]] = {}
    for count, key in enumerate(round_.runs, 1):
        folder = _job(work, round_.runs[key][0])
        try:
            job_result = _job_result(folder / RESULT, result.bounds)
            if (sha256 := job_result.records.get(key)) is None:
                raise InputError(job_result.failed.get(key, "its job left no record"))
            path, commands, scores = _take(leaderboard, folder, sha256, round_, key, simulators)
        except (InputError, OSError) as error:
            result.failed[key] = str(error)[: schema.MAX_TEXT]
            continue
        if secret:
            attestation.sign(leaderboard, path, secret)
        result.records[key] = sha256
        if scores:
            of_seeds[key], result.seeds[key] = commands, scores
        seeds_failed = (x for x in job_result.failed if x.startswith(f"{key}, seed "))
        result.failed.update({x: job_result.failed[x][: schema.MAX_TEXT] for x in seeds_failed})
        if progress is not None:
            progress("records", count, len(round_.runs))
    _write(round_.folder, of_seeds, result)
    if secret:
        attestation.sign(leaderboard, round_.folder / RESULT, secret)
    return rounds.load(leaderboard, name)


def _take(
    leaderboard: Path,
    folder: Path,
    sha256: str,
    round_: Round,
    key: str,
    simulators: ReplayPlants,
) -> tuple[Path, list[schema.Commands], list[float]]:
    """Add the record that a job left, unless it is there; InputError if it is of anything else.

    Returns:
        Its path, and commands of seeds of the entry with the scores that they give.
    """
    path = store.path_of(leaderboard, sha256)
    source = path if path.exists() else folder / path.name
    candidate = record.load(source)
    if not isinstance(candidate, Record) or (
        candidate.sha256,
        candidate.run,
        candidate.header.draws.sha256,
    ) != (sha256, round_.runs[key], round_.commitment):
        raise InputError(f"{source.name} is not the record of {key} in this round")
    commands = rounds.seed_commands(folder).get(key, [])[:MAX_SEEDS]
    scores = seed_scores(candidate, commands, folder, simulators, round_, {})
    if source != path:
        replayed = functools.partial(require_replay, simulators)
        store.add(leaderboard, source, replayed, seeds=commands)
    return path, commands, scores
