"""Kernel calls that Python has no function for, and what the zygote and its cells give up by them.

They give up capabilities, their user, being looked into, resources. All functions raise OSError if
the kernel refuses.

Why not packages: ``pyseccomp`` needs ``libseccomp.so`` on the machine, Landlock bindings on PyPI
are young and incomplete for new ABIs. What is needed of both is four system calls.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import platform
import resource
import signal
import sys
from collections.abc import Iterable

LINUX = sys.platform == "linux"

#: Machine of the running process: ``"x86_64"``, ``"aarch64"`` or another that has no table here.
MACHINE = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())

_libc = ctypes.CDLL(None, use_errno=True) if LINUX else None
if _libc is not None:
    _libc.syscall.restype = ctypes.c_long

PR_SET_PDEATHSIG, PR_GET_DUMPABLE, PR_SET_DUMPABLE = 1, 3, 4
PR_CAPBSET_DROP, PR_SET_SECUREBITS, PR_SET_NO_NEW_PRIVS, PR_CAP_AMBIENT = 24, 28, 38, 47


def _call(name: str, *arguments: object, operation: str = "") -> int:
    """Call a function of the C library.

    Raises:
        OSError: with the kernel's reason if it answers -1, or if this is not Linux.
    """
    if _libc is None:
        raise OSError(f"{name} needs Linux, this is {sys.platform}")
    result = getattr(_libc, name)(*arguments)
    if result == -1:
        error = ctypes.get_errno()
        raise OSError(error, f"{operation or name}: {os.strerror(error)}")
    return result


def prctl(option: int, *arguments: int) -> int:
    """``prctl(2)``; errors of this and of what follows as of :func:`_call`."""
    padded = (ctypes.c_ulong(a) for a in (*arguments, 0, 0, 0, 0)[:4])
    return _call("prctl", ctypes.c_int(option), *padded, operation=f"prctl {option}")


def syscall(number: int, *arguments: object) -> int:
    """Raw system call; every integer argument is passed as a long."""
    longs = (ctypes.c_long(a) if isinstance(a, int) else a for a in arguments)
    return _call("syscall", ctypes.c_long(number), *longs, operation=f"system call {number}")


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
    operation = f"mount {target.decode(errors='replace')}"
    _call("mount", source, target, kind, ctypes.c_ulong(flags), options, operation=operation)


def umount(target: bytes, flags: int) -> None:
    """``umount2(2)``."""
    _call("umount2", target, ctypes.c_int(flags), operation=f"umount {target.decode()}")


_CAPSET = {"x86_64": 126, "aarch64": 91}
_CAPABILITY_VERSION_3 = 0x20080522
_CLEAR_AMBIENT = 4
_NO_ROOT_LOCKED = 0b101111  # noroot, no-setuid-fixup, no-ambient-raise, each locked


def no_new_privs() -> None:
    """No program started from here gains rights (set-uid files); Landlock and seccomp need it."""
    prctl(PR_SET_NO_NEW_PRIVS, 1)


def undumpable() -> None:
    """Nobody else of the same user may trace this process or read its memory."""
    prctl(PR_SET_DUMPABLE, 0)


def die_with(parent: int) -> None:
    """End this process when its parent, the process ``parent``, ends."""
    prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the line above
        os._exit(1)


def drop_capabilities() -> None:
    """Root without root's rights: no capability now, none to be had later.

    Raises:
        OSError: if some remain.
    """
    number = _CAPSET.get(MACHINE)
    if number is None:
        raise OSError(f"no table of system calls for {MACHINE}")
    for capability in range(64):
        try:
            prctl(PR_CAPBSET_DROP, capability)
        except OSError:  # an ordinary user may not, or the kernel has no more
            break
    try:
        prctl(PR_CAP_AMBIENT, _CLEAR_AMBIENT)
        prctl(PR_SET_SECUREBITS, _NO_ROOT_LOCKED)
    except OSError:
        pass  # the latter only root can; without capabilities an ordinary user need not
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    nothing = (ctypes.c_uint32 * 6)()
    syscall(number, ctypes.byref(header), ctypes.byref(nothing))


#: The user that cells of a scorer run by root become: one that owns nothing. Any number would do
#: that no system gives away.
_STRANGER = 1_879_048_193


def become_stranger() -> bool:
    """Stop being root; say whether that was allowed. Capabilities stay until they are dropped."""
    try:
        os.setgroups([])
        os.setresgid(_STRANGER, _STRANGER, _STRANGER)
        os.setresuid(_STRANGER, _STRANGER, _STRANGER)
    except OSError:  # a container that does not know the number
        return False
    return True


def count_processes_apart() -> bool:
    """Enter a user namespace of one's own, in which the kernel counts one's processes from 1.

    Returns:
        Whether that was allowed, and the kernel (from 5.14) counts so.
    """
    release = os.uname().release.split(".")
    if not LINUX or (int(release[0]), int(release[1].partition("-")[0])) < (5, 14):
        return False
    try:
        unshare(NEW_USER)
    except OSError:
        return False
    return True


#: Most descriptors: the wire, /dev/null, and a few files of weights.
_FILES = 64
#: Most threads of a cell that may have some: what JAX starts on a machine with many processors.
THREADS = 32
_STACK = 8 << 20
#: Linux's number of a limit that Python has no name for.
_SIGPENDING = 11


def limit_resources(memory: int | None, cpu_s: int, processes: int | None) -> None:
    """Limit this process, soft and hard.

    Args:
        memory: bytes of address space; None for no limit.
        cpu_s: seconds of processor time in total.
        processes: how many more may be started, threads among them; None for no limit.

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
        # Queued signals are counted over all processes of a user: cells could count each other's.
        "SIGPENDING": 0,
    }
    if memory is not None:
        limits["AS"] = memory
    if processes is not None:
        limits["NPROC"] = processes  # does not bind root
    for name, value in limits.items():
        kind = getattr(resource, f"RLIMIT_{name}", None)
        if kind is None and name == "SIGPENDING" and LINUX:
            kind = _SIGPENDING
        if kind is not None:  # not every system knows every limit
            # At the soft limit of processor time comes a signal with a name, at the hard one a
            # nameless end: leave a second between them.
            bounds = (value, value + 1 if name == "CPU" else value)
            _, hard = resource.getrlimit(kind)
            if hard != resource.RLIM_INFINITY:
                bounds = (min(bounds[0], hard), min(bounds[1], hard))
            resource.setrlimit(kind, bounds)


def address_space() -> int | None:
    """Return the bytes of this process's address space; None on systems that do not say."""
    if not LINUX:
        return None
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[0]) * resource.getpagesize()
    except OSError:
        return _smallest_limit()


def _smallest_limit() -> int:
    """Where there is no /proc: the least limit of address space under which a page is to be had."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    low, high = 0, 1 << 46
    while high - low > resource.getpagesize():
        middle = (low + high) // 2
        resource.setrlimit(resource.RLIMIT_AS, (middle, hard))
        try:
            mmap.mmap(-1, resource.getpagesize()).close()
            high = middle
        except OSError:
            low = middle
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    return high


_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on every machine
_VERSION_FLAG = 1
_RULE_PATH_BENEATH = 1

_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
#: Number of file rights each ABI knows: 13; +refer; +truncate; (4: network); +ioctl_dev.
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
_NET_BIND_AND_CONNECT = 0b11
_SCOPE_ABSTRACT_SOCKET_AND_SIGNAL = 0b11


class _Ruleset(ctypes.Structure):
    _fields_ = (
        ("handled_access_fs", ctypes.c_uint64),
        ("handled_access_net", ctypes.c_uint64),
        ("scoped", ctypes.c_uint64),
    )


class _PathBeneath(ctypes.Structure):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("allowed_access", ctypes.c_uint64), ("parent_fd", ctypes.c_int32))


def landlock_abi() -> int:
    """Landlock ABI of the running kernel; 0 where it is absent or switched off."""
    try:
        return syscall(_CREATE_RULESET, None, 0, _VERSION_FLAG)
    except OSError:
        return 0


def handled_rights(version: int) -> tuple[int, int, int]:
    """File rights, network rights and scopes that an ABI, from 1, can take away: all are taken."""
    files = (1 << _FILE_RIGHTS[min(version, 5)]) - 1
    network = _NET_BIND_AND_CONNECT if version >= 4 else 0
    scopes = _SCOPE_ABSTRACT_SOCKET_AND_SIGNAL if version >= 6 else 0
    return files, network, scopes


def ruleset(readable: Iterable[str], listable: Iterable[str] = ()) -> int:
    """Prepare a descriptor of what :func:`enforce` puts into force.

    Folders (with all below) and files stay readable, missing ones are skipped; of others the names
    alone stay readable.

    Raises:
        OSError: if the kernel refuses.
    """
    attributes = _Ruleset(*handled_rights(landlock_abi()))
    # Kernels of before a field was added take the larger structure as long as the rest is zero.
    handle = syscall(_CREATE_RULESET, ctypes.byref(attributes), ctypes.sizeof(attributes), 0)
    try:
        for path in readable:
            # For a file the kernel takes no right that only a folder has.
            _grant(handle, path, _READ_FILE | (_READ_DIR if os.path.isdir(path) else 0))
        for path in listable:
            _grant(handle, path, _READ_DIR)
    except OSError:
        os.close(handle)
        raise
    return handle


def enforce(handle: int) -> None:
    """Confine this process, and all it will start, for good; closes the ruleset here.

    Raises:
        OSError: if the kernel refuses. ``no_new_privs`` must be set.
    """
    try:
        syscall(_RESTRICT_SELF, handle, 0)
    finally:
        os.close(handle)


def _grant(handle: int, path: str, rights: int) -> None:
    try:
        target = os.open(path, os.O_PATH | os.O_CLOEXEC)  # type: ignore[attr-defined]
    except FileNotFoundError:
        return
    try:
        rule = _PathBeneath(rights, target)
        syscall(_ADD_RULE, handle, _RULE_PATH_BENEATH, ctypes.byref(rule), 0)
    finally:
        os.close(target)
