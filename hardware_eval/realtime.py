"""Real-time scheduling of this process, where the system grants it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

#: Priority among real-time processes: below the kernel's own threads.
PRIORITY = 40

#: Priority of a device: its guard comes before a host on the same machine.
DEVICE_PRIORITY = PRIORITY + 1

#: Priority of a device's deadman: it comes before what it watches.
DEADMAN_PRIORITY = PRIORITY + 2


def prefer(level: int = DEVICE_PRIORITY) -> str | None:
    """Ask for real-time scheduling (``SCHED_FIFO``) of all threads of this process, a device.

    Root has the right to it, and users with ``rtprio`` in ``/etc/security/limits.conf``.

    Returns:
        None if it was granted, else the reason why not; the process then runs as before.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "this system has none"
    try:
        threads = [int(entry.name) for entry in Path("/proc/self/task").iterdir()]
    except OSError:
        threads = [0]
    try:
        for thread in threads:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(level))
    except ProcessLookupError:  # a thread that has ended since
        return None
    except OSError as error:
        return str(error)
    return None


def take_priority() -> bool:
    """Let the calling thread run before ordinary work (``SCHED_FIFO``), but none of its children.

    Returns:
        Whether the system allowed it; it wants root, or a limit ``rtprio``.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        return False
    return True


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
