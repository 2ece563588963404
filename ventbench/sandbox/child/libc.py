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

PR_SET_PDEATHSIG, PR_GET_DUMPABLE, PR_SET_DUMPABLE = 1, 3, 4
PR_CAPBSET_DROP, PR_SET_SECUREBITS, PR_SET_NO_NEW_PRIVS, PR_CAP_AMBIENT = 24, 28, 38, 47


def checked(result: int, what: str) -> int:
    """Return the result of a kernel call.

    Raises:
        OSError: if it is -1, with the kernel's reason.
    """
    if result == -1:
        error = ctypes.get_errno()
        raise OSError(error, f"{what}: {os.strerror(error)}")
    return result


def prctl(option: int, *arguments: int) -> int:
    """``prctl(2)``.

    Raises:
        OSError: if the kernel refuses or this is not Linux.
    """
    if _libc is None:
        raise OSError(f"prctl needs Linux, this is {sys.platform}")
    padded = (*arguments, 0, 0, 0, 0)[:4]
    return checked(
        _libc.prctl(ctypes.c_int(option), *(ctypes.c_ulong(a) for a in padded)), f"prctl {option}"
    )


def syscall(number: int, *arguments: object) -> int:
    """Raw system call; every integer argument is passed as a long.

    Raises:
        OSError: if the kernel refuses or this is not Linux.
    """
    if _libc is None:
        raise OSError(f"system calls need Linux, this is {sys.platform}")
    longs = (ctypes.c_long(a) if isinstance(a, int) else a for a in arguments)
    _libc.syscall.restype = ctypes.c_long
    return checked(_libc.syscall(ctypes.c_long(number), *longs), f"system call {number}")


#: A user namespace of one's own.
NEW_USER = 0x10000000


def unshare(flags: int) -> None:
    """``unshare(2)``, which Python has only since 3.12.

    Raises:
        OSError: if the kernel refuses or this is not Linux.
    """
    if _libc is None:
        raise OSError(f"unshare needs Linux, this is {sys.platform}")
    checked(_libc.unshare(ctypes.c_int(flags)), "unshare")


def setns(namespace: int, kind: int) -> None:
    """``setns(2)``, which Python has only since 3.12.

    Raises:
        OSError: if the kernel refuses or this is not Linux.
    """
    if _libc is None:
        raise OSError(f"setns needs Linux, this is {sys.platform}")
    checked(_libc.setns(ctypes.c_int(namespace), ctypes.c_int(kind)), "setns")


def mount(source: bytes, target: bytes, kind: bytes, flags: int, options: bytes) -> None:
    """``mount(2)``.

    Raises:
        OSError: if the kernel refuses or this is not Linux.
    """
    if _libc is None:
        raise OSError(f"mount needs Linux, this is {sys.platform}")
    result = _libc.mount(source, target, kind, ctypes.c_ulong(flags), options)
    checked(result, f"mount {target.decode(errors='replace')}")


def umount(target: bytes, flags: int) -> None:
    """``umount2(2)``.

    Raises:
        OSError: if the kernel refuses or this is not Linux.
    """
    if _libc is None:
        raise OSError(f"umount needs Linux, this is {sys.platform}")
    checked(_libc.umount2(target, ctypes.c_int(flags)), f"umount {target.decode()}")
