"""Clocks, real and virtual, and real-time scheduling of this process where it is granted."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path


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

    def __init__(self) -> None:
        """Start at 0 s."""
        self._now = 0.0
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


#: Time that never goes back.
Clock = RealClock | VirtualClock


#: Signals that end a process.
ENDING = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


def told_to_end() -> Callable[[], bool]:
    """Return what says whether a signal came that would end this process; it no longer does."""
    came: list[int] = []
    for number in ENDING:
        signal.signal(number, lambda number, frame: came.append(number))
    return lambda: bool(came)


#: Priority among real-time processes: below the kernel's own threads.
PRIORITY = 40

#: Priority of an entry's process: the loop that asks it comes first.
ENTRY_PRIORITY = PRIORITY - 1

#: What a person is told where the system grants none.
DENIED = (
    "real-time priority is denied: it needs root, or a line such as `@users - rtprio 50` in "
    "/etc/security/limits.conf"
)

#: Priority of a device: its guard comes before a host on the same machine.
DEVICE_PRIORITY = PRIORITY + 1

#: Priority of a device's deadman: it comes before what it watches.
DEADMAN_PRIORITY = PRIORITY + 2


#: Processor time without a pause, s, after which a process is no longer real-time: it is in a loop,
#: and nothing else on its processor gets on, the shell that would end it included.
LONGEST_RUN_S = 5


def prefer(level: int = DEVICE_PRIORITY) -> str | None:
    """Ask for real-time scheduling (``SCHED_FIFO``) of all threads of this process, a device.

    Root has the right to it, and users with ``rtprio`` in ``/etc/security/limits.conf``.

    Returns:
        None if it was granted, else the reason why not; the process then runs as before.
    """
    try:
        threads = [int(entry.name) for entry in Path("/proc/self/task").iterdir()]
    except OSError:
        threads = [0]
    return _scheduled(level, threads, inherited=True)


def take_priority() -> bool:
    """Let the calling thread run before ordinary work (``SCHED_FIFO``), but none of its children.

    Returns:
        Whether the system allowed it; it wants root, or a limit ``rtprio``.
    """
    return _scheduled(PRIORITY, [0], inherited=False) is None


def _scheduled(level: int, threads: Sequence[int], inherited: bool) -> str | None:
    """Make threads real-time, by number; returns why not, or None."""
    if not hasattr(os, "sched_setscheduler"):
        return "this system has none"
    policy = os.SCHED_FIFO | (0 if inherited else os.SCHED_RESET_ON_FORK)
    _limit_runs()
    try:
        for thread in threads:
            os.sched_setscheduler(thread, policy, os.sched_param(level))
    except ProcessLookupError:  # a thread that has ended since
        return None
    except OSError as error:
        return str(error)
    return None


def _limit_runs() -> None:
    """Have the system tell this process when it is in a loop; what it has started is ended then."""
    if threading.current_thread() is not threading.main_thread():
        return  # a handler is set by the main thread alone, and without one the process would end
    import resource  # not on every system

    signal.signal(signal.SIGXCPU, _give_up)
    hard = resource.getrlimit(resource.RLIMIT_RTTIME)[1]
    soft = LONGEST_RUN_S * 1_000_000
    resource.setrlimit(resource.RLIMIT_RTTIME, (soft if hard < 0 else min(soft, hard), hard))


def _give_up(number: int, frame: object) -> None:
    """Go back to ordinary scheduling, with all threads."""
    for entry in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            os.sched_setscheduler(int(entry.name), os.SCHED_OTHER, os.sched_param(0))


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
