"""Real-time scheduling of this process, where the system grants it."""

from __future__ import annotations

import os
from pathlib import Path

#: Priority among real-time processes: below the kernel's own threads.
PRIORITY = 40


def prefer() -> str | None:
    """Ask for real-time scheduling (``SCHED_FIFO``) of all threads of this process.

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
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except ProcessLookupError:  # a thread that has ended since
        return None
    except OSError as error:
        return str(error)
    return None
