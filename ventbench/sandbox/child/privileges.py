"""Giving up what a process may do: capabilities, new privileges, being looked into."""

from __future__ import annotations

import ctypes
import os
import signal

from . import libc

_CAPSET = {"x86_64": 126, "aarch64": 91}
_CAPABILITY_VERSION_3 = 0x20080522
_CLEAR_AMBIENT = 4
_NO_ROOT_LOCKED = 0b101111  # noroot, no-setuid-fixup, no-ambient-raise, each locked


def no_new_privs() -> None:
    """No program started from here gains rights (set-uid files); Landlock and seccomp need it.

    Raises:
        OSError: if the kernel refuses.
    """
    libc.prctl(libc.PR_SET_NO_NEW_PRIVS, 1)


def undumpable() -> None:
    """Nobody else of the same user may trace this process or read its memory.

    Raises:
        OSError: if the kernel refuses.
    """
    libc.prctl(libc.PR_SET_DUMPABLE, 0)


def die_with(parent: int) -> None:
    """End this process when its parent, the process ``parent``, ends.

    Raises:
        OSError: if the kernel refuses.
    """
    libc.prctl(libc.PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the line above
        os._exit(1)


def drop_capabilities() -> None:
    """Root without root's rights: no capability now, none to be had later.

    Raises:
        OSError: if some remain.
    """
    number = _CAPSET.get(libc.MACHINE)
    if number is None:
        raise OSError(f"no table of system calls for {libc.MACHINE}")
    for capability in range(64):
        try:
            libc.prctl(libc.PR_CAPBSET_DROP, capability)
        except OSError:  # an ordinary user may not, or the kernel has no more
            break
    try:
        libc.prctl(libc.PR_CAP_AMBIENT, _CLEAR_AMBIENT)
        libc.prctl(libc.PR_SET_SECUREBITS, _NO_ROOT_LOCKED)
    except OSError:
        pass  # the latter only root can; without capabilities an ordinary user need not
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    nothing = (ctypes.c_uint32 * 6)()
    libc.syscall(number, ctypes.byref(header), ctypes.byref(nothing))
