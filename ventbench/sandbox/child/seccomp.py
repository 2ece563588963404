"""The cell's filter of system calls: which may be made, the filter's program, its switching on.

A cell is Python with numpy, one thread, reading what it is granted; everything not named here is
refused. What is deliberately absent, because cells could talk to each other or leave something
behind: files' times, modes and attributes (``utimensat``, ``fchmod``, ``setxattr``), locks
(``flock``, ``fcntl`` beyond flags), shared futexes, ``mincore``, ``fadvise64``, ``sysinfo``.

The program is classic BPF over the kernel's ``struct seccomp_data``: a list of rules tried in
order; the first rule whose call and arguments match decides, and what no rule matches gets the
default. Calls of another architecture's table kill the process.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from . import kernel


class CallNumber(NamedTuple):
    """Number of one system call on both machines."""

    x86_64: int | None
    aarch64: int | None


def _table(text: str) -> dict[str, CallNumber]:
    """Calls by name, of ``name x86-64 aarch64`` with commas between; ``-`` where there is none."""
    calls = {}
    for name, *numbers in (call.split() for call in text.split(",")):
        calls[name] = CallNumber(*(None if x == "-" else int(x) for x in numbers))
    return calls


#: Allowed with any argument.
PLAIN = _table("""
    read 0 63, write 1 64, readv 19 65, writev 20 66, pread64 17 67, lseek 8 62, close 3 57,
    close_range 436 436, dup 32 23, dup2 33 -, dup3 292 24, fstat 5 80, mprotect 10 226,
    munmap 11 215, mremap 25 216, brk 12 214, rt_sigaction 13 134, rt_sigprocmask 14 135,
    rt_sigreturn 15 139, sigaltstack 131 132, getpid 39 172, gettid 186 178, getppid 110 173,
    getuid 102 174, geteuid 107 175, getgid 104 176, getegid 108 177, getrusage 98 165,
    getrlimit 97 163, uname 63 160, times 100 153, time 201 -, gettimeofday 96 169,
    nanosleep 35 101, restart_syscall 219 128, sched_yield 24 124, getcpu 309 168,
    getrandom 318 278, poll 7 -, ppoll 271 73, select 23 -, pselect6 270 72, arch_prctl 158 -,
    set_robust_list 273 99, set_tid_address 218 96, rseq 334 293, exit 60 93,
    exit_group 231 94, stat 4 -, lstat 6 -, newfstatat 262 79, statx 332 291, access 21 -,
    faccessat 269 48, faccessat2 439 439, readlink 89 -, readlinkat 267 78, getdents64 217 61,
    getcwd 79 17
""")

#: Opening files, for reading only.
OPENAT, OPEN = CallNumber(257, 56), CallNumber(2, None)

#: Sets filters; not for cells.
SECCOMP = CallNumber(317, 277)

#: Allowed with the arguments that :func:`_checked` names.
CHECKED = _table("""
    mmap 9 222, ioctl 16 29, fcntl 72 25, futex 202 98, madvise 28 233, prlimit64 302 261,
    clock_gettime 228 113, clock_getres 229 114, clock_nanosleep 230 115,
    sched_getaffinity 204 123, tgkill 234 131, clone 56 220
""")

#: Answered with "no such call", so that the C library falls back to one that is looked into.
MISSING = {"clone3": CallNumber(435, 435), "openat2": CallNumber(437, 437)}

#: What becomes of a call.
ALLOW, KILL = 0x7FFF0000, 0x80000000

_LOAD, _AND, _RETURN = 0x20, 0x54, 0x06  # ld [k]; and #k; ret #k
_EQUAL, _AT_LEAST = 0x15, 0x35  # jeq #k, true, false; jge
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16  # offsets in struct seccomp_data

#: Name of the architecture in the kernel's audit table.
AUDIT = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

#: x86-64 answers to a second table of calls (x32) from here on.
_X32 = 0x40000000


def errno_action(error: int) -> int:
    """Action: the call fails with this error number."""
    return 0x00050000 | error


class Condition(NamedTuple):
    """Holds when ``argument & mask`` is one of the values."""

    argument: int  #: index of the argument.
    values: Sequence[int]  #: what may be left.
    mask: int = 0xFFFFFFFF  #: bits of its lower 32 that count.
    #: the upper 32 bits must be zero (pointers); elsewhere the kernel drops them.
    whole: bool = False


class Rule(NamedTuple):
    """The action for one call if all conditions hold; else later rules are tried."""

    number: int
    action: int
    conditions: tuple[Condition, ...] = ()


def _instruction(code: int, k: int, true: int = 0, false: int = 0) -> bytes:
    return struct.pack("<HBBI", code, true, false, k)


def _test(condition: Condition, skip: int) -> list[bytes]:
    """Instructions of a condition: fall through if it holds, else jump over ``skip`` more."""
    low = _ARGUMENTS + 8 * condition.argument
    code = [_instruction(_LOAD, low), _instruction(_AND, condition.mask)]
    for remaining, value in zip(
        range(len(condition.values) - 1, -1, -1), condition.values, strict=True
    ):
        # A match jumps over the other values; the last one that fails leaves the rule.
        code.append(_instruction(_EQUAL, value, remaining, 0 if remaining else skip))
    if condition.whole:
        # Checked first, so that its failure skips the code above too.
        high = [_instruction(_LOAD, low + 4), _instruction(_EQUAL, 0, 0, len(code) + skip)]
        code = high + code
    return code


def _rule(rule: Rule) -> list[bytes]:
    body = [_instruction(_RETURN, rule.action)]
    for condition in reversed(rule.conditions):
        body = _test(condition, len(body)) + body
    reload = [_instruction(_LOAD, _NUMBER)] if rule.conditions else []
    # The accumulator holds the number again for the next rule, whichever way this one is left.
    return [_instruction(_EQUAL, rule.number, 0, len(body)), *body, *reload]


def assemble(machine: str, rules: Iterable[Rule], default: int) -> bytes:
    """Return the filter as an array of ``struct sock_filter``.

    Args:
        machine: ``"x86_64"`` or ``"aarch64"``.
        rules: tried in order.
        default: action for calls that no rule decides.
    """
    kill = _instruction(_RETURN, KILL)
    code = [_instruction(_LOAD, _ARCHITECTURE), _instruction(_EQUAL, AUDIT[machine], 1, 0), kill]
    code.append(_instruction(_LOAD, _NUMBER))
    if machine == "x86_64":
        code += [_instruction(_AT_LEAST, _X32, 0, 1), kill]
    for rule in rules:
        code += _rule(rule)
    code.append(_instruction(_RETURN, default))
    if len(code) > 4096:
        raise ValueError(f"a filter of {len(code)} instructions; the kernel takes 4096")
    return b"".join(code)


_SET_MODE_FILTER, _GET_ACTION_AVAILABLE, _TSYNC = 1, 2, 1

_REFUSED, _NO_SUCH_CALL = errno_action(errno.EPERM), errno_action(errno.ENOSYS)

# Linux's numbers, equal on x86-64 and aarch64 (os.O_* of the running system may differ).
_O_TMPFILE, _O_PATH = 0o20000000, 0o10000000
_WRITING = 0o3 | 0o100 | 0o1000 | _O_TMPFILE | _O_PATH  # access mode, O_CREAT, O_TRUNC
_TERMINAL_QUESTION, _CLOSE_ON_EXEC = 0x5401, (0x5450, 0x5451)
# F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_DUPFD_CLOEXEC. Not F_SETFL: whoever shares an open file
# would see the flags.
_FCNTL = (0, 1, 2, 3, 1030)
_FUTEX_PRIVATE, _FUTEX_JOIN = 128, 9 | 256
_MADVISE = (0, 4, 8, 14, 15)  # normal, don't need, free, huge page, no huge page
_CLONE_THREAD, _MAP_HUGE = 0x10000, 0x40000
# The system's clocks and one's own. Larger numbers are the processor time of any process.
_CLOCKS = tuple(range(12))

_Rules = list[Rule]


def available() -> bool:
    """Whether this kernel filters and this machine has a table here."""
    if kernel.MACHINE not in AUDIT:
        return False
    action = ctypes.c_uint32(ALLOW)
    try:
        number = getattr(SECCOMP, kernel.MACHINE)
        kernel.syscall(number, _GET_ACTION_AVAILABLE, 0, ctypes.byref(action))
    except OSError:
        return False
    return True


def _allow(machine: str, call: CallNumber, *conditions: Condition) -> _Rules:
    number = getattr(call, machine)
    return [] if number is None else [Rule(number, ALLOW, conditions)]


def _checked(machine: str, pid: int, threads: bool) -> _Rules:
    rules = []
    for name, conditions in (
        # Not huge pages: all processes take them from one store, whose end the next one notices.
        ("mmap", [Condition(3, (0,), _MAP_HUGE)]),
        ("ioctl", [Condition(1, (_TERMINAL_QUESTION, *_CLOSE_ON_EXEC))]),
        ("fcntl", [Condition(1, _FCNTL)]),
        # A futex in a file's page would reach every process that maps the file; waiting for a
        # thread of one's own to end is the one shared use, and alone it says nothing.
        ("futex", [Condition(1, (_FUTEX_PRIVATE,), _FUTEX_PRIVATE)]),
        ("futex", [Condition(1, (_FUTEX_JOIN,))]),
        ("madvise", [Condition(2, _MADVISE)]),
        # One's own limits, to be read.
        ("prlimit64", [Condition(0, (0,)), Condition(2, (0,), whole=True)]),
        ("tgkill", [Condition(0, (pid,))]),  # abort()
        ("clock_gettime", [Condition(0, _CLOCKS)]),
        ("clock_getres", [Condition(0, _CLOCKS)]),
        ("clock_nanosleep", [Condition(0, _CLOCKS)]),
        # Of others it would say whether they live.
        ("sched_getaffinity", [Condition(0, (0, pid))]),
    ):
        rules += _allow(machine, CHECKED[name], *conditions)
    if threads:
        rules += _allow(machine, CHECKED["clone"], Condition(0, (_CLONE_THREAD,), _CLONE_THREAD))
    return rules


def cell_filter(machine: str, pid: int, threads: bool) -> bytes:
    """Filter of a cell: what is not allowed fails with EPERM.

    Args:
        machine: ``"x86_64"`` or ``"aarch64"``.
        pid: the cell's process, which may signal itself alone.
        threads: whether threads may be started (JAX needs them); processes never.
    """
    rules: _Rules = []
    for call in PLAIN.values():
        rules += _allow(machine, call)
    for call, flags in ((OPENAT, 2), (OPEN, 1)):
        rules += _allow(machine, call, Condition(flags, (0,), _WRITING))
    rules += _checked(machine, pid, threads)
    rules += [
        Rule(number, _NO_SUCH_CALL)
        for call in MISSING.values()
        if (number := getattr(call, machine)) is not None
    ]
    return assemble(machine, rules, _REFUSED)


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def install(program: bytes) -> None:
    """Put a filter on every thread of this process, for good.

    Raises:
        OSError: if the kernel refuses. ``no_new_privs`` must be set.
    """
    buffer = ctypes.create_string_buffer(program, len(program))
    header = _Program(len(program) // 8, ctypes.addressof(buffer))
    number = getattr(SECCOMP, kernel.MACHINE)
    # With TSYNC a positive result names a thread that could not be filtered.
    if kernel.syscall(number, _SET_MODE_FILTER, _TSYNC, ctypes.byref(header)):
        raise OSError("a thread could not be filtered")


def restrict(threads: bool) -> None:
    """Confine this process to the calls of a cell; OSError if the kernel refuses."""
    install(cell_filter(kernel.MACHINE, os.getpid(), threads))
