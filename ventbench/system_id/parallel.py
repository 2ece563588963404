"""Independent computations in parallel, on the cores that this process may use.

Threads suffice: nearly all of a fit's time is spent in compiled code, which all threads share.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")

#: Environment variable with the most threads.
THREADS = "VENTBENCH_THREADS"

#: Most threads unless told otherwise: more would wait for each other.
_MOST = 4

_outermost: ContextVar[bool] = ContextVar("_outermost", default=True)


def parallel_map(work: Callable[[A], B], arguments: Iterable[A]) -> list[B]:
    """Return ``[work(argument) for argument in arguments]``, computed in parallel.

    Args:
        work: may run at the same time as itself; a ``parallel_map`` inside it runs serially.
        arguments: one for each call.
    """
    arguments = list(arguments)
    count = min(thread_count(), len(arguments))
    if count < 2 or not _outermost.get():
        return [work(argument) for argument in arguments]

    def nested(argument: A) -> B:
        _outermost.set(False)
        return work(argument)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(nested, arguments))


def thread_count() -> int:
    """Number of threads that :func:`parallel_map` uses, at least one."""
    given = os.environ.get(THREADS, "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    can = getattr(os, "sched_getaffinity", None)
    return min(_MOST, len(can(0)) if can else os.cpu_count() or 1)
