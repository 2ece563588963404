"""The cell's filter of system calls, and how it is switched on."""

from __future__ import annotations

import ctypes
import errno
import os

from . import bpf, libc
from .bpf import Check, Rule
from .syscalls import CHECKED, MISSING, OPEN, OPENAT, PLAIN, SECCOMP, Number

_SET_MODE_FILTER, _GET_ACTION_AVAILABLE, _TSYNC = 1, 2, 1

_REFUSED, _NO_SUCH_CALL = bpf.errno_action(errno.EPERM), bpf.errno_action(errno.ENOSYS)

# Linux's numbers, equal on x86-64 and aarch64 (os.O_* of the running system may differ).
_O_TMPFILE, _O_PATH = 0o20000000, 0o10000000
_WRITING = 0o3 | 0o100 | 0o1000 | _O_TMPFILE | _O_PATH  # access mode, O_CREAT, O_TRUNC
_TERMINAL_QUESTION, _CLOSE_ON_EXEC = 0x5401, (0x5450, 0x5451)
_FCNTL = (0, 1, 2, 3, 4, 1030)  # F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_SETFL, F_DUPFD_CLOEXEC
_FUTEX_PRIVATE, _FUTEX_JOIN = 128, 9 | 256
_MADVISE = (0, 4, 8, 14, 15)  # normal, don't need, free, huge page, no huge page
_CLONE_THREAD = 0x10000

_Rules = list[Rule]


def available() -> bool:
    """Whether this kernel filters and this machine has a table here."""
    if libc.MACHINE not in bpf.AUDIT:
        return False
    action = ctypes.c_uint32(bpf.ALLOW)
    try:
        number = getattr(SECCOMP, libc.MACHINE)
        libc.syscall(number, _GET_ACTION_AVAILABLE, 0, ctypes.byref(action))
    except OSError:
        return False
    return True


def _allow(machine: str, call: Number, *checks: Check) -> _Rules:
    number = getattr(call, machine)
    return [] if number is None else [Rule(number, bpf.ALLOW, checks)]


def _checked(machine: str, pid: int, threads: bool) -> _Rules:
    rules = []
    for name, checks in (
        ("ioctl", [Check(1, (_TERMINAL_QUESTION, *_CLOSE_ON_EXEC))]),
        ("fcntl", [Check(1, _FCNTL)]),
        # A futex in a file's page would reach every process that maps the file; waiting for a
        # thread of one's own to end is the one shared use, and alone it says nothing.
        ("futex", [Check(1, (_FUTEX_PRIVATE,), _FUTEX_PRIVATE)]),
        ("futex", [Check(1, (_FUTEX_JOIN,))]),
        ("madvise", [Check(2, _MADVISE)]),
        ("prlimit64", [Check(0, (0,)), Check(2, (0,), whole=True)]),  # one's own, reading
        ("tgkill", [Check(0, (pid,))]),  # abort()
    ):
        rules += _allow(machine, CHECKED[name], *checks)
    if threads:
        rules += _allow(machine, CHECKED["clone"], Check(0, (_CLONE_THREAD,), _CLONE_THREAD))
    return rules


def cell_filter(machine: str, pid: int, threads: bool) -> bytes:
    """Filter of a cell: what is not allowed fails with EPERM.

    Args:
        machine: ``"x86_64"`` or ``"aarch64"``.
        pid: of the cell, which may signal itself alone.
        threads: whether threads may be started (JAX needs them); processes never.
    """
    rules: _Rules = []
    for call in PLAIN.values():
        rules += _allow(machine, call)
    for call, flags in ((OPENAT, 2), (OPEN, 1)):
        rules += _allow(machine, call, Check(flags, (0,), _WRITING))
    rules += _checked(machine, pid, threads)
    rules += [
        Rule(number, _NO_SUCH_CALL)
        for call in MISSING.values()
        if (number := getattr(call, machine)) is not None
    ]
    return bpf.assemble(machine, rules, _REFUSED)


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def install(program: bytes) -> None:
    """Put a filter on every thread of this process, for good.

    Raises:
        OSError: if the kernel refuses. ``no_new_privs`` must be set.
    """
    buffer = ctypes.create_string_buffer(program, len(program))
    header = _Program(len(program) // 8, ctypes.addressof(buffer))
    number = getattr(SECCOMP, libc.MACHINE)
    # With TSYNC a positive result names a thread that could not be filtered.
    if libc.syscall(number, _SET_MODE_FILTER, _TSYNC, ctypes.byref(header)):
        raise OSError("a thread could not be filtered")


def restrict(threads: bool) -> None:
    """Confine this process to the calls of a cell.

    Raises:
        OSError: if the kernel refuses.
    """
    install(cell_filter(libc.MACHINE, os.getpid(), threads))
