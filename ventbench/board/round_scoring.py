"""Scoring a round: bounds of its draws, then every frozen entry on them, then the records.

Everything that is finished is kept in a folder, so that the same command continues. Jobs are small:
workers of a cluster need to see the same files. An entry that cannot be run has no record, and the
result says why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.executor import results
from ventbench.base.resume import WorkFolder
from ventbench.board import attestation, canonical, create, rerun, rounds, schema, store
from ventbench.board.replay import ReplayPlants
from ventbench.board.rounds import BOUNDS, RESULT, Result, Round
from ventbench.entries import reference as references
from ventbench.entries.folder import combined_hash, file_hashes, open_submission
from ventbench.entries.reference import Reference
from ventbench.entries.runner import Runner
from ventbench.entries.runs import DRAWS
from ventbench.entries.scoring import run_protocol
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import attainable, protocol

#: Processor time of a plain entry on a track, sandbox included, s; the robustness track has the
#: stressed runs too. By ``benchmarks/executor_scaling.py``; networks take up to twice as long.
SECONDS = {"performance": 13.0, "robustness": 58.0}

Load = Callable[[], ReplayPlants]
Progress = Callable[[str, int, int], None]


def plan(own: Round) -> list[tuple[str, str]]:
    """Name and track of every run of a round that has draws.

    Raises:
        InputError: if it is not drawn, or is scored already.
    """
    if own.state != "drawn" or own.frozen is None:
        raise InputError(f"round {own.name} is {own.state}; it is scored once it is drawn")
    return [(entry.name, track) for entry in own.frozen.entries for track in entry.tracks]


def code_of(own: Round, places: Iterable[Path]) -> dict[str, Path]:
    """Find the folder of every frozen entry by its hash.

    Raises:
        InputError: naming the entries whose code is not at hand.
    """
    assert own.frozen is not None
    wanted = {entry.name: entry.sha256 for entry in own.frozen.entries}
    found: dict[str, Path] = {}
    for folder in rerun.folders(list(places)):
        sha256 = wanted.get(folder.name)
        if sha256 is not None and combined_hash(file_hashes(folder)) == sha256:
            found.setdefault(folder.name, folder.resolve())
    if missing := sorted(set(wanted) - set(found)):
        raise InputError(
            f"the code of {', '.join(missing)}, as it was frozen, is not at hand; give --source DIR"
        )
    return found


def bounds_of(
    own: Round,
    simulators: ReplayPlants,
    pool: Executor,
    folder: Path,
    *,
    starts: tuple[int, ...] = attainable.STARTS,
    progress: references.Progress | None = None,
) -> Reference:
    """Best attainable and best PID of the draws of a round, with the PIDs of the protocol."""
    rigs = rigs_of(simulators)
    drawn = own.draws(rigs)
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    about = references.settings(rigs.about, drawn.about())
    return references.compute(
        plants, cells, np.array(references.PID_GAINS), about,
        folder=folder, starts=starts, pool=pool, progress=progress,
    )  # fmt: skip


def score(
    leaderboard: Path,
    name: str,
    pool: Executor,
    work: Path,
    *,
    places: Iterable[Path],
    load: Load = frozen.load,
    runner: Callable[[], Runner] = rerun.sandboxed,
    secret: str | None = None,
    starts: tuple[int, ...] = attainable.STARTS,
    progress: Progress | None = None,
) -> Round:
    """Score every frozen entry, write its records, and close the round.

    Args:
        leaderboard: its folder.
        name: of the round.
        pool: executor of bounds and entries.
        work: folder for what is finished.
        places: folders with the code.
        load: gives the simulators; outside of this process, a function of a module.
        runner: gives the runner; outside of this process, a function of a module.
        secret: key that signs the records; without one they have no rank.
        starts: of the bounds, see :data:`ventbench.task.attainable.STARTS`.
        progress: called with what is going on, how much of it is done, and of how much.

    Raises:
        InputError: if the round cannot be scored, code is missing, or a record is refused.
        OSError: if a file cannot be read or written.
    """
    own, simulators, tell = rounds.load(leaderboard, name), load(), progress or _silent
    runs, places = plan(own), list(places)
    if different := rounds.protocol_differences(own, simulators.about()):
        raise InputError(f"round {name} has another protocol: {', '.join(different)}")
    code = code_of(own, places)
    done = WorkFolder(work, {"round": own.frozen_sha256, "draws": own.commitment})
    computed = bounds_of(
        own, simulators, pool, work / "bounds", starts=starts,
        progress=lambda ready, count: tell("bounds of the draws", ready, count),
    )  # fmt: skip
    bounds = computed.save(own.folder / BOUNDS)
    jobs = {
        f"{entry}-{track}": (leaderboard.resolve(), name, code[entry], track, work.resolve(),
                             load, runner)
        for entry, track in runs
        if not done.has(f"{entry}-{track}")
    }  # fmt: skip
    tell("entries", len(runs) - len(jobs), len(runs))
    for count, (job, scored) in enumerate(results(pool, _score_entry, jobs), 1):
        done.put(job, scored)
        tell("entries", len(runs) - len(jobs) + count, len(runs))
    records: dict[str, str] = {}
    failed: dict[str, str] = {}
    for at, (entry, track) in enumerate(runs):
        scored, key = done.read(f"{entry}-{track}"), f"{entry} ({track})"
        if "failed" in scored:
            failed[key] = scored["failed"][: schema.MAX_TEXT]
            continue
        path = Path(scored["record"])
        kept = leaderboard / canonical.RECORDS / path.name
        if not kept.exists():
            store.add(leaderboard, path, simulators)
        if secret:
            attestation.sign(leaderboard, path.stem, secret)
        records[key] = path.stem
        tell("records", at + 1, len(runs))
    content = canonical.canonical(msgspec.to_builtins(Result(bounds, records, failed)))
    files.write_atomically(own.folder / RESULT, lambda file: file.write(content))
    return rounds.load(leaderboard, name)


def _score_entry(
    leaderboard: Path, name: str, code: Path, track: str, work: Path, load: Load,
    runner: Callable[[], Runner],
) -> dict[str, str]:  # fmt: skip
    """Score one entry on one track; return the path of its record's draft, or why it failed."""
    own, simulators = rounds.load(leaderboard, name), load()
    rigs = rigs_of(simulators)
    drawn = own.draws(rigs)
    try:
        submission = open_submission(str(code))
        if not own.entered(submission.manifest.name, track, submission.sha256 or ""):
            raise InputError(f"{code} was changed while the round was scored")
        result = run_protocol(
            submission, rigs, track=track, drawn=drawn, reference=own.bounds(),
            stress=DRAWS if track == "robustness" else 0, runner=runner(),
        )  # fmt: skip
        about: Mapping[str, Any] = {"round": name, "frozen": own.frozen_sha256}
        draft = create.create(result, simulators, source=about)
        path = draft.save(work / "drafts")
    except (InputError, FloatingPointError) as error:
        return {"failed": str(error)}
    return {"record": str(path)}


def _silent(what: str, done: int, count: int) -> None:
    pass
