"""Independent computations in parallel: by threads, by processes, or on a Dask cluster.

:func:`parallel_map` uses threads, which suffice for fits: nearly all of their time is spent in
compiled code, which all threads share. :func:`executor` opens a
:class:`concurrent.futures.Executor` in this process, in processes beside it or on a cluster; its
jobs must be functions of a module with small arguments made of numpy arrays.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent import futures
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

from ventbench.base.errors import InputError, require

ArgumentT = TypeVar("ArgumentT")
ResultT = TypeVar("ResultT")

#: Told how much of something is done, and how much there is of it.
Progress = Callable[[int, int], object]

#: Environment variable with the most threads.
THREADS = "VENTBENCH_THREADS"

#: Most threads unless told otherwise: more would wait for each other.
_MOST = 4

_outermost: ContextVar[bool] = ContextVar("_outermost", default=True)

#: How long a cluster may take to answer, s.
PATIENCE = "15s"


class InProcess(futures.Executor):
    """Runs each job at once, where it is handed in."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> futures.Future[Any]:
        """Run the job; its exception, unless it ends the program, is kept for who asks."""
        future: futures.Future[Any] = futures.Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def executor(workers: int = 0, scheduler: str | None = None) -> Iterator[futures.Executor]:
    """Open an executor; what has not begun when the block is left by an error never runs.

    An interrupt also ends the jobs that run in processes of this machine.

    Args:
        workers: processes on this machine; 0 for none but this one.
        scheduler: address of a Dask scheduler instead, such as ``tcp://host:8786``.

    Raises:
        InputError: if both are given, or the scheduler cannot be reached, or Dask is missing.
    """
    if scheduler is not None:
        if workers:
            raise InputError(
                f"--workers {workers} and --scheduler {scheduler}: give one of the two"
            )
        with _dask(scheduler) as pool:
            yield pool
        return
    if workers < 0:
        raise InputError(f"--workers {workers} must not be negative")
    if workers == 0:
        yield InProcess()
        return
    earlier = set(multiprocessing.active_children())
    # Not forked: JAX has threads, whose locks a fork would leave closed.
    pool = futures.ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_end_with_parent
    )
    try:
        yield pool
    except KeyboardInterrupt:
        # An interrupt may reach this process alone, and a job may run for minutes.
        for worker in set(multiprocessing.active_children()) - earlier:
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this worker when its parent ends, however that ends: nobody would take the results."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch(sentinel: int) -> None:
        multiprocessing.connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()


@contextmanager
def _dask(scheduler: str) -> Iterator[futures.Executor]:
    require("distributed", extra="dask", what="--scheduler and its workers")
    from distributed import Client

    try:
        client = Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {scheduler}: {error}; start one with `dask scheduler`"
        ) from error
    with client:
        pool = client.get_executor(pure=False)
        try:
            yield pool
        finally:
            pool.shutdown(wait=False)


def results(
    pool: futures.Executor,
    function: Callable[..., ResultT],
    jobs: Mapping[str, tuple[Any, ...]],
) -> Iterator[tuple[str, ResultT]]:
    """Run jobs, arguments by name, and yield the name and the result of each as it ends.

    Raises:
        InputError: if a worker process has died.
        Exception: whatever a job raises.
    """
    if isinstance(pool, InProcess):  # each is told before the next begins
        for name, arguments in jobs.items():
            yield name, pool.submit(function, *arguments).result()
        return
    running = {pool.submit(function, *arguments): name for name, arguments in jobs.items()}
    for future in futures.as_completed(running):
        name = running.pop(future)
        try:
            result = future.result()
        except futures.BrokenExecutor as error:
            raise InputError(
                "a worker process died (out of memory?); what was finished is kept: run the same "
                "command again, with fewer --workers"
            ) from error
        except Exception as error:
            if type(error).__name__ != "KilledWorker":  # of Dask, which need not be installed
                raise
            raise InputError(
                f"the cluster's workers died, one after the other, with {name} (out of memory?); "
                "what was finished is kept: run the same command again, without it or with more "
                "memory"
            ) from error
        yield name, result


def in_order(
    pool: futures.Executor,
    function: Callable[..., ResultT],
    arguments: Iterable[tuple[Any, ...]],
    progress: Progress | None = None,
) -> list[ResultT]:
    """Return the results of jobs in the order of their arguments; errors as of :func:`results`.

    ``progress`` is called with the number of jobs that are done and the number of all.
    """
    jobs = {str(index): job for index, job in enumerate(arguments)}
    outcomes: dict[str, ResultT] = {}
    for name, result in results(pool, function, jobs):
        outcomes[name] = result
        if progress is not None:
            progress(len(outcomes), len(jobs))
    return [outcomes[name] for name in jobs]


def parallel_map(
    work: Callable[[ArgumentT], ResultT], arguments: Iterable[ArgumentT]
) -> list[ResultT]:
    """Return ``[work(argument) for argument in arguments]``, computed in parallel.

    Args:
        work: may run at the same time as itself; a ``parallel_map`` inside it runs serially.
        arguments: one for each call.
    """
    arguments = list(arguments)
    count = min(thread_count(), len(arguments))
    if count < 2 or not _outermost.get():
        return [work(argument) for argument in arguments]

    def nested(argument: ArgumentT) -> ResultT:
        _outermost.set(False)
        return work(argument)

    with futures.ThreadPoolExecutor(count) as pool:
        return list(pool.map(nested, arguments))


def thread_count() -> int:
    """Number of threads that :func:`parallel_map` uses, at least one."""
    setting = os.environ.get(THREADS, "")
    if setting.isdigit() and int(setting) > 0:
        return int(setting)
    can = getattr(os, "sched_getaffinity", None)
    return min(_MOST, len(can(0)) if can else os.cpu_count() or 1)
