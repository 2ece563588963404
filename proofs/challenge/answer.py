"""Answering a challenge: each case goes to a diagnoser in a process of its own."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from proofs import code_version
from proofs.challenge import contract
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.run import Diagnoser, Limits, run
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.recordings.read import load


def answer(
    folder: ChallengeFolder,
    diagnoser: Diagnoser,
    *,
    limits: Limits | None = None,
    workers: int = 0,
    only: tuple[str, ...] = (),
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> dict[str, str]:
    """Answer all cases that have no answer yet; each answer is written as soon as it is there.

    A diagnoser that fails, or answers what is no answer, loses the case.

    Args:
        folder: folder of the challenge.
        diagnoser: who answers.
        limits: what it may use on a case; the usual ones if None.
        workers: number of processes; 0 for this one alone.
        only: names of cases; all if empty.
        progress: called with the number of answered cases and the number of all cases.

    Returns:
        Why a case is lost, by name.

    Raises:
        InputError: if there is no challenge or no such case, or a recording is missing or cannot be
            read.
    """
    cases = list(folder.cases())
    if unknown := set(only) - set(cases):
        unlike = f"but {cases[0]} to {cases[-1]}"
        raise InputError(f"{folder.path} has no case {min(unknown)}, {unlike}")
    names = [name for name in cases if not only or name in only]
    missing = [name for name in names if not folder.recording(name).is_file()]
    if missing:
        raise InputError(f"{folder.recording(missing[0])} is missing")
    waiting = [name for name in names if not folder.answer(name, diagnoser.name).is_file()]
    done, lost = len(names) - len(waiting), {}
    progress(done, len(names))
    work = {name: (folder, name, diagnoser, limits or Limits()) for name in waiting}
    with executor(workers) as pool:
        for name, problem in results(pool, answer_case, work):
            done += 1
            progress(done, len(names))
            if problem:
                lost[name] = problem
    return lost


def answer_case(folder: ChallengeFolder, name: str, diagnoser: Diagnoser, limits: Limits) -> str:
    """Answer one case and write the file; returns why the case is lost, or an empty text."""
    path = folder.recording(name)
    breaths = load(path)
    withheld = tuple(folder.cases()[name]["withheld"])
    apart = np.isin(breaths.breath_id, withheld)
    samples = dict(zip(breaths.breath_id[apart], breaths.valid[apart].sum(axis=1), strict=True))
    with tempfile.TemporaryDirectory() as place:
        contract.pose(Path(place), breaths, withheld, limits.seconds)
        outcome = run(diagnoser, Path(place), limits)
    problem, value = outcome.problem, None
    if not problem:
        try:
            read = contract.decode(outcome.answer, {int(k): int(v) for k, v in samples.items()})
            value = msgspec.to_builtins(read, str_keys=True)
        except contract.AnswerError as error:
            problem = str(error)
    written: dict[str, Any] = {
        "recording_sha256": files.sha256(path),
        "seconds": round(outcome.seconds, 2),
        "peak_mib": round(outcome.peak_mib, 1),
        "layers": list(outcome.layers),
        "code": code_version(),
        "problem": problem,
        "answer": value,
    }
    files.write_json(folder.answer(name, diagnoser.name), written)
    return problem
