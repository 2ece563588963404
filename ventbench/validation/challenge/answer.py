"""Answering a challenge: each recording to the diagnosis, which sees nothing else."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import Any, Protocol

from ventbench import compilation, files
from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load
from ventbench.training.executor import executor, results
from ventbench.validation.challenge import requests
from ventbench.validation.challenge.folder import Folder

#: So that each process computes on one core.
_THREADS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "VENTBENCH_THREADS": "1",
}

#: Cases a process, on average, before it makes room for a new one: it grows by a MiB or two a case.
_CASES = 25

#: Cases that this process has answered.
_answered = 0


class Found(Protocol):
    """What a diagnosis must give."""

    @property
    def request(self) -> Any:
        """Breaths to record next, or None."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        ...


#: Breaths and the lung's label to a diagnosis.
Diagnose = Callable[[Breaths, str], Found]


def answer(
    folder: Folder, *, jobs: int = 2, diagnose: Diagnose | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, str]:  # fmt: skip
    """Answer what has no answer yet, each as it is found.

    Args:
        folder: of the challenge.
        jobs: processes, of one thread each; 0 for none but this one.
        diagnose: ventbench's own if None.
        progress: told how many are answered, of how many.

    Returns:
        Why a case has no answer, by name.

    Raises:
        InputError: if there is no challenge, a recording is missing, or a process has died.
    """
    entries = folder.cases()
    missing = [name for name in entries if not folder.recording(name).is_file()]
    if folder.round == 2:  # only those that have asked for more
        for name in missing:
            del entries[name]
    elif missing:
        raise InputError(f"{folder.recording(missing[0])} is missing")
    work: Mapping[str, tuple[Any, ...]] = {
        name: (folder, name, entry["lung"], diagnose)
        for name, entry in entries.items()
        if not folder.answer(name).is_file()
    }
    done, failed = len(entries) - len(work), {}
    progress(done, len(entries))
    for part in _parts(work, _CASES * max(jobs, 1)):
        with _one_thread(), executor(jobs) as pool:
            for name, problem in results(pool, _one, part):
                done += 1
                progress(done, len(entries))
                if problem:
                    failed[name] = problem
    return failed


def _parts(work: Mapping[str, tuple[Any, ...]], size: int) -> Iterator[dict[str, tuple[Any, ...]]]:
    """In order, so many at a time.

    ``max_tasks_per_child`` of an executor would do, but hangs in Python 3.11.
    """
    rest = iter(work.items())
    while part := dict(islice(rest, size)):
        yield part


def _one(folder: Folder, name: str, lung: str, diagnose: Diagnose | None) -> str:
    """Answer one case; returns what went wrong, or nothing."""
    global _answered
    began = time.perf_counter()
    try:
        breaths = load(folder.recording(name))
        found = (diagnose or _own)(breaths, lung)
        value = found.as_dict()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - began
    if found.request is not None:
        requests.write(folder.request(name), found.request, int(breaths.breath_id.max()) + 1)
    files.write_json(
        folder.answer(name),
        {
            "recording_sha256": breaths.sha256,
            "lung": lung,
            "seconds": round(seconds, 2),
            "peak_mib": round(_peak(), 1),
            "first_in_process": _answered == 0,
            "diagnosis": value,
        },
    )
    _answered += 1
    return ""


def _own(breaths: Breaths, lung: str) -> Found:
    from importlib import import_module

    compilation.keep()
    diagnosing = import_module("ventbench.diagnosis.diagnose")
    return diagnosing.diagnose(breaths, plant="physics", lung=lung)


def _peak() -> float:
    """Most memory that this process has held, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


@contextmanager
def _one_thread() -> Iterator[None]:
    """Set what processes started within inherit."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(_THREADS)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
