"""Independent fits side by side, on the cores that this process may use.

Threads, since nearly all of a fit's time is spent in compiled code, which all of them share.
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

_alone: ContextVar[bool] = ContextVar("_alone", default=True)


def each(work: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """Results in the order of the items, as ``[work(item) for item in items]`` gives them.

    Args:
        work: safe to run at the same time as itself; what it calls through here runs in turn.
        items: one for each call.
    """
    items = list(items)
    count = min(threads(), len(items))
    if count < 2 or not _alone.get():
        return [work(item) for item in items]

    def inside(item: A) -> B:
        _alone.set(False)
        return work(item)

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(inside, items))


def threads() -> int:
    """Number of threads that :func:`each` uses; at least one."""
    given = os.environ.get(THREADS, "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    can = getattr(os, "sched_getaffinity", None)
    return min(_MOST, len(can(0)) if can else os.cpu_count() or 1)
