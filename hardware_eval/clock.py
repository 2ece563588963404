"""Clocks: real time, and a virtual one on which many breaths pass in a second."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from typing import Protocol

#: Priority of a real-time thread: above ordinary work, below the kernel's own (50).
_PRIORITY = 20


class Clock(Protocol):
    """Time that never goes back."""

    def now(self) -> float:
        """Time since an arbitrary start, s."""
        ...

    def sleep_until(self, instant: float) -> None:
        """Return at ``instant``, s, or at once if it has passed."""
        ...


class RealClock:
    """The system's monotonic clock."""

    def now(self) -> float:
        """Time since an arbitrary start, s."""
        return time.monotonic()

    def sleep_until(self, instant: float) -> None:
        """Sleep; accurate to what the system's scheduler gives."""
        while (left := instant - time.monotonic()) > 0.0:
            time.sleep(left)


class VirtualClock:
    """A clock that moves when it is told to, and takes along what runs on it."""

    def __init__(self, start: float = 0.0) -> None:
        """Start at ``start``, s."""
        self._now = start
        self._passengers: list[Callable[[float], None]] = []

    def now(self) -> float:
        """Time, s."""
        return self._now

    def carry(self, run_until: Callable[[float], None]) -> None:
        """Call ``run_until(instant)`` whenever time passes, before :meth:`now` shows it."""
        self._passengers.append(run_until)

    def sleep_until(self, instant: float) -> None:
        """Let time pass until ``instant``, s."""
        if instant > self._now:
            for run_until in self._passengers:
                run_until(instant)
            self._now = instant

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self.sleep_until(self._now + seconds)


def take_priority() -> bool:
    """Let the calling thread run before ordinary work (``SCHED_FIFO``), but none of its children.

    Returns:
        Whether the system allowed it; it wants root, or a limit ``rtprio`` of 20.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(_PRIORITY))
    except OSError:
        return False
    return True


def share_priority() -> None:
    """Give all threads of the process the priority of this one, if it has any.

    A compiled plant computes in threads of its own.
    """
    if not has_priority():
        return
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    with contextlib.suppress(OSError):  # where there is no /proc, or a thread has just ended
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), policy, os.sched_param(_PRIORITY))


def has_priority() -> bool:
    """Whether the calling thread runs before ordinary work."""
    return hasattr(os, "sched_getscheduler") and (
        os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    )


@contextlib.contextmanager
def priority() -> Iterator[bool]:
    """Take priority for a while; see :func:`take_priority`."""
    taken = not has_priority() and take_priority()
    try:
        yield taken
    finally:
        if taken:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
