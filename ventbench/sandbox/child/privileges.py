"""What the zygote and its cells give up: capabilities, being looked into, namespaces, resources.

Namespaces: no network; no shared memory and message queues of others; and every file system
read-only. The last does more than forbid writing, which other layers do too: reading then leaves no
access time behind that another cell could look at.
"""

from __future__ import annotations

import ctypes
import os
import resource
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


_NETWORK, _IPC, _HOST_NAME, _USER, _MOUNT = 0x40000000, 0x08000000, 0x04000000, 0x10000000, 0x20000
_MOUNT_SETATTR, _HERE, _RECURSIVE, _NOW_READ_ONLY, _PRIVATE = 442, -100, 0x8000, 0x1, 1 << 18


class _MountAttributes(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint64) for name in ("set", "clear", "propagation", "userns"))


def enter_namespaces() -> list[str]:
    """Leave the machine's network, shared memory, host name and writable file systems behind.

    Returns:
        Which layers that gave: none where it is not allowed.
    """
    apart = _NETWORK | _IPC | _HOST_NAME | _MOUNT
    for flags in (apart, apart | _USER):  # root; an ordinary user
        try:
            libc.unshare(flags)
        except OSError:
            continue
        return ["namespaces", *(["read-only-mounts"] if _read_only() else [])]
    return []


def _read_only() -> bool:
    # First apart from the machine's own mounts, lest those become read-only.
    for attributes in (_MountAttributes(propagation=_PRIVATE), _MountAttributes(_NOW_READ_ONLY)):
        size = ctypes.sizeof(attributes)
        try:
            libc.syscall(_MOUNT_SETATTR, _HERE, b"/", _RECURSIVE, ctypes.byref(attributes), size)
        except OSError:
            return False
    return True


#: Most descriptors: the wire, /dev/null, and a few files of weights.
_FILES = 64
_STACK = 8 << 20


def limit_resources(memory: int, cpu_s: int, threads: bool) -> None:
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
