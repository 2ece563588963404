"""The few kernel calls that Python has no function for, through ctypes.

Why not packages: ``pyseccomp`` needs ``libseccomp.so`` on the machine, Landlock bindings on PyPI
are young and incomplete for new ABIs. What is needed of both is four system calls.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys

LINUX = sys.platform == "linux"

#: Machine of the running process: ``"x86_64"``, ``"aarch64"`` or another that has no table here.
MACHINE = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())

_libc = ctypes.CDLL(None, use_errno=True) if LINUX else None
if _libc is not None:
    _libc.syscall.restype = ctypes.c_long

PR_SET_PDEATHSIG, PR_GET_DUMPABLE, PR_SET_DUMPABLE = 1, 3, 4
PR_CAPBSET_DROP, PR_SET_SECUREBITS, PR_SET_NO_NEW_PRIVS, PR_CAP_AMBIENT = 24, 28, 38, 47


def _call(name: str, *arguments: object, what: str = "") -> int:
    """Call a function of the C library.

    Raises:
        OSError: with the kernel's reason if it answers -1, or if this is not Linux.
    """
    if _libc is None:
        raise OSError(f"{name} needs Linux, this is {sys.platform}")
    result = getattr(_libc, name)(*arguments)
    if result == -1:
        error = ctypes.get_errno()
        raise OSError(error, f"{what or name}: {os.strerror(error)}")
    return result


def prctl(option: int, *arguments: int) -> int:
    """``prctl(2)``; errors of this and of what follows as of :func:`_call`."""
    padded = (ctypes.c_ulong(a) for a in (*arguments, 0, 0, 0, 0)[:4])
    return _call("prctl", ctypes.c_int(option), *padded, what=f"prctl {option}")


def syscall(number: int, *arguments: object) -> int:
    """Raw system call; every integer argument is passed as a long."""
    longs = (ctypes.c_long(a) if isinstance(a, int) else a for a in arguments)
    return _call("syscall", ctypes.c_long(number), *longs, what=f"system call {number}")


#: A user namespace of one's own.
NEW_USER = 0x10000000


def unshare(flags: int) -> None:
    """``unshare(2)``, which Python has only since 3.12."""
    _call("unshare", ctypes.c_int(flags))


def setns(namespace: int, kind: int) -> None:
    """``setns(2)``, which Python has only since 3.12."""
    _call("setns", ctypes.c_int(namespace), ctypes.c_int(kind))


def mount(source: bytes, target: bytes, kind: bytes, flags: int, options: bytes) -> None:
    """``mount(2)``."""
    what = f"mount {target.decode(errors='replace')}"
    _call("mount", source, target, kind, ctypes.c_ulong(flags), options, what=what)


def umount(target: bytes, flags: int) -> None:
    """``umount2(2)``."""
    _call("umount2", target, ctypes.c_int(flags), what=f"umount {target.decode()}")
