"""Answering a challenge: each recording goes to the diagnosis, which sees nothing else."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import Any, Protocol

from proofs import code_version
from proofs.challenge import requests
from proofs.challenge.folder import ChallengeFolder
from ventbench.base import compilation, files
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load

#: Environment of the processes, each of which computes on one core.
_SINGLE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "VENTBENCH_THREADS": "1",
}

#: Mean number of cases after which a new process replaces an old one.
_CASES_PER_PROCESS = 8

#: Number of cases that this process has answered, and the grid that its compiled functions are for.
_answered, _grid = 0, None


class Answer(Protocol):
    """Interface of a diagnosis result."""

    @property
    def request(self) -> Any:
        """Breaths to record next, a :class:`~.requests.Commands`, or None."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        ...


#: Takes breaths and the lung's label.
Diagnose = Callable[[Breaths, str], Answer]

#: Arguments of :func:`_answer_case`, by name of the case.
Work = Mapping[str, tuple[Any, ...]]


def answer(
    folder: ChallengeFolder, *, jobs: int = 2, scheduler: str | None = None,
    diagnose: Diagnose | None = None, cases_per_process: int = _CASES_PER_PROCESS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, str]:  # fmt: skip
    """Answer all cases that have no answer yet; each answer is written as soon as it is there.

    Args:
        folder: folder of the challenge.
        jobs: number of processes of one thread each; 0 to work in this process.
        scheduler: address of a Dask scheduler instead, whose workers see the same files; ``jobs``
            then has no meaning, and each worker uses as many threads as its environment says.
        diagnose: the diagnosis; ventbench's own if None.
        cases_per_process: mean number of cases after which a new process replaces an old one.
        progress: called with the number of answered cases and the number of all cases.

    Returns:
        The reason why a case has no answer, by name.

    Raises:
        InputError: if there is no challenge, a recording is missing, or a process has died.
    """
    entries = folder.cases()
    missing = [name for name in entries if not folder.recording(name).is_file()]
    if folder.round == 2:  # has recordings only of the cases that requested breaths
        for name in missing:
            del entries[name]
    elif missing:
        raise InputError(f"{folder.recording(missing[0])} is missing")
    work: Work = {
        name: (folder, name, entry["lung"], diagnose)
        for name, entry in entries.items()
        if not folder.answer(name).is_file()
    }
    done, failed = len(entries) - len(work), {}
    progress(done, len(entries))
    if scheduler is not None:
        jobs, cases_per_process = 0, len(work)  # a cluster renews its workers itself
    for batch in _batches(work, cases_per_process * max(jobs, 1)):
        with _single_threaded(), executor(jobs, scheduler) as pool:
            for name, problem in results(pool, _answer_case, batch):
                done += 1
                progress(done, len(entries))
                if problem:
                    failed[name] = problem
    return failed


def _batches(work: Work, size: int) -> Iterator[Work]:
    """Split the work, in order.

    ``max_tasks_per_child`` of an executor would do, but hangs in Python 3.11.
    """
    rest = iter(work.items())
    while batch := dict(islice(rest, size)):
        yield batch


def _answer_case(
    folder: ChallengeFolder, name: str, lung: str, diagnose: Diagnose | None
) -> str:  # fmt: skip
    """Answer one case; returns what went wrong, or an empty text."""
    global _answered
    began = time.perf_counter()
    try:
        breaths = load(folder.recording(name))
        diagnosis = (diagnose or _ventbench_diagnosis)(breaths, lung)
        value = diagnosis.as_dict()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - began
    if diagnosis.request is not None:
        requests.write(folder.request(name), diagnosis.request, int(breaths.breath_id.max()) + 1)
    files.write_json(
        folder.answer(name),
        {
            "recording_sha256": breaths.sha256,
            "lung": lung,
            "seconds": round(seconds, 2),
            "peak_mib": round(_peak_memory(), 1),
            "first_in_process": _answered == 0,
            "code": code_version(),
            "diagnosis": value,
        },
    )
    _answered += 1
    return ""


def _ventbench_diagnosis(breaths: Breaths, lung: str) -> Answer:
    from ventbench.diagnosis.diagnose import diagnose

    compilation.keep()
    _forget_other_grids(breaths)
    # Whether somebody breathes is part of the question.
    return diagnose(breaths, simulator="physics", lung=lung, patient=True)


def _forget_other_grids(breaths: Breaths) -> None:
    """Free what was compiled for recordings of another grid of samples: 200 MiB each.

    Laboratories differ in their grids. To read the functions back from the disk takes two to four
    seconds.
    """
    global _grid
    from ventbench.physics.dead_time import resolution_of

    grid = (breaths.dt.shape[1], *resolution_of(breaths.dt))
    if _grid not in (None, grid):
        compilation.forget()
    _grid = grid


def _peak_memory() -> float:
    """Largest memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Set the environment that processes started within the block inherit."""
    before = {name: os.environ.get(name) for name in _SINGLE_THREAD}
    os.environ.update(_SINGLE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
