"""Resource limits of a cell."""

from __future__ import annotations

import resource

from . import libc

#: Most descriptors: the wire, /dev/null, and a few files of weights.
_FILES = 64
_STACK = 8 << 20


def restrict(memory: int, cpu_s: int, threads: bool) -> None:
    """Limit this process, soft and hard.

    Args:
        memory: bytes of address space beyond what the process has now.
        cpu_s: seconds of processor time in total.
        threads: whether threads are allowed; the kernel counts them as processes.

    Raises:
        OSError: if the system refuses a limit.
    """
    limits = {
        "CPU": cpu_s,
        "FSIZE": 0,
        "NOFILE": _FILES,
        "CORE": 0,
        "STACK": _STACK,
        "MEMLOCK": 0,
        "MSGQUEUE": 0,
    }
    if (used := _address_space()) is not None:
        limits["AS"] = used + memory
    if not threads:
        limits["NPROC"] = 0  # not for root: there seccomp alone stops new processes
    for name, value in limits.items():
        kind = getattr(resource, f"RLIMIT_{name}", None)
        if kind is not None:  # not every system knows every limit
            # At the soft limit of processor time comes a signal with a name, at the hard one a
            # nameless end: leave a second between them.
            wanted = (value, value + 1 if name == "CPU" else value)
            _, hard = resource.getrlimit(kind)
            if hard != resource.RLIM_INFINITY:
                wanted = (min(wanted[0], hard), min(wanted[1], hard))
            resource.setrlimit(kind, wanted)


def _address_space() -> int | None:
    """Bytes of this process's address space; None on systems that do not say."""
    if not libc.LINUX:
        return None
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()
