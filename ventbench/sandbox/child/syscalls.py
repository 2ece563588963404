"""System calls that a cell may make: Python with numpy, one thread, reading what it is granted.

Everything not named here is refused. Numbers are (x86-64, aarch64); None where a machine has no
such call. What is deliberately absent, because cells could talk to each other or leave something
behind: files' times, modes and attributes (``utimensat``, ``fchmod``, ``setxattr``), locks
(``flock``, ``fcntl`` beyond flags), shared futexes, ``mincore``, ``fadvise64``, ``sysinfo``.
"""

from __future__ import annotations

from typing import NamedTuple


class Number(NamedTuple):
    """Number of one system call on both machines."""

    x86_64: int | None
    aarch64: int | None


#: Allowed with any argument.
PLAIN = {
    "read": Number(0, 63),
    "write": Number(1, 64),
    "readv": Number(19, 65),
    "writev": Number(20, 66),
    "pread64": Number(17, 67),
    "lseek": Number(8, 62),
    "close": Number(3, 57),
    "close_range": Number(436, 436),
    "dup": Number(32, 23),
    "dup2": Number(33, None),
    "dup3": Number(292, 24),
    "fstat": Number(5, 80),
    "mmap": Number(9, 222),
    "mprotect": Number(10, 226),
    "munmap": Number(11, 215),
    "mremap": Number(25, 216),
    "brk": Number(12, 214),
    "rt_sigaction": Number(13, 134),
    "rt_sigprocmask": Number(14, 135),
    "rt_sigreturn": Number(15, 139),
    "sigaltstack": Number(131, 132),
    "getpid": Number(39, 172),
    "gettid": Number(186, 178),
    "getppid": Number(110, 173),
    "getuid": Number(102, 174),
    "geteuid": Number(107, 175),
    "getgid": Number(104, 176),
    "getegid": Number(108, 177),
    "getrusage": Number(98, 165),
    "getrlimit": Number(97, 163),
    "uname": Number(63, 160),
    "times": Number(100, 153),
    "time": Number(201, None),
    "gettimeofday": Number(96, 169),
    "clock_gettime": Number(228, 113),
    "clock_getres": Number(229, 114),
    "clock_nanosleep": Number(230, 115),
    "nanosleep": Number(35, 101),
    "restart_syscall": Number(219, 128),
    "sched_yield": Number(24, 124),
    "sched_getaffinity": Number(204, 123),
    "getcpu": Number(309, 168),
    "getrandom": Number(318, 278),
    "poll": Number(7, None),
    "ppoll": Number(271, 73),
    "select": Number(23, None),
    "pselect6": Number(270, 72),
    "arch_prctl": Number(158, None),
    "set_robust_list": Number(273, 99),
    "set_tid_address": Number(218, 96),
    "rseq": Number(334, 293),
    "exit": Number(60, 93),
    "exit_group": Number(231, 94),
    "stat": Number(4, None),
    "lstat": Number(6, None),
    "newfstatat": Number(262, 79),
    "statx": Number(332, 291),
    "access": Number(21, None),
    "faccessat": Number(269, 48),
    "faccessat2": Number(439, 439),
    "readlink": Number(89, None),
    "readlinkat": Number(267, 78),
    "getdents64": Number(217, 61),
    "getcwd": Number(79, 17),
}

#: Opening files, for reading only.
OPENAT, OPEN = Number(257, 56), Number(2, None)

#: Sets filters; not for cells.
SECCOMP = Number(317, 277)

#: Allowed with the arguments that :mod:`seccomp` names.
CHECKED = {
    "ioctl": Number(16, 29),
    "fcntl": Number(72, 25),
    "futex": Number(202, 98),
    "madvise": Number(28, 233),
    "prlimit64": Number(302, 261),
    "tgkill": Number(234, 131),
    "clone": Number(56, 220),
}

#: Answered with "no such call", so that the C library falls back to one that is looked into.
MISSING = {"clone3": Number(435, 435), "openat2": Number(437, 437)}
