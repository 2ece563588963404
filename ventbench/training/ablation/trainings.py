"""Trainings of a study: those that are not finished, here or beside each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from ventbench.executor import InProcess, executor, results
from ventbench.resume import WorkFolder

#: Called with what is trained and the share of all that is done.
Progress = Callable[[str, float], None]

#: Takes the share of a training that is done.
Tell = Callable[[float], None]


def finish(
    work: WorkFolder,
    function: Callable[..., Any],
    jobs: Mapping[str, tuple[Any, ...]],
    *,
    workers: int = 0,
    scheduler: str | None = None,
    progress: Progress = lambda *_: None,
) -> None:
    """Compute the results that a folder does not have yet.

    Args:
        work: keeps each result as soon as it is there.
        function: of a module; takes the arguments of a job, then :data:`Tell` or None, and returns
            JSON values.
        jobs: arguments by name of the result.
        workers: processes, each with a training at a time; 0 for this one alone.
        scheduler: address of a Dask scheduler instead, whose workers see the same files.
        progress: what happens within a training can only be told where it runs in this process.

    Raises:
        InputError: if the scheduler cannot be reached, or a worker process has died.
    """
    done = 0

    def tell(name: str, share: float) -> None:
        progress(name, (done + share) / len(jobs))

    missing = {}
    for name, arguments in jobs.items():
        if work.has(name):
            tell(name, 0.0)
            done += 1
        else:
            missing[name] = arguments
    with executor(workers, scheduler) as pool:
        here = isinstance(pool, InProcess)
        told = {
            name: (*arguments, partial(tell, name) if here else None)
            for name, arguments in missing.items()
        }
        for name, result in results(pool, function, told):
            work.put(name, result)
            done += 1
            tell(name, 0.0)
