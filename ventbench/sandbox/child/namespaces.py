"""Namespaces of its own for the zygote, where the kernel lets us.

No network; no shared memory and message queues of others; and every file system read-only. The
last does more than forbid writing, which other layers do too: reading then leaves no access time
behind that another cell could look at.
"""

from __future__ import annotations

import ctypes

from . import libc

_NETWORK, _IPC, _HOST_NAME, _USER, _MOUNT = 0x40000000, 0x08000000, 0x04000000, 0x10000000, 0x20000
_MOUNT_SETATTR, _HERE, _RECURSIVE, _NOW_READ_ONLY, _PRIVATE = 442, -100, 0x8000, 0x1, 1 << 18


class _MountAttributes(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint64) for name in ("set", "clear", "propagation", "userns"))


def enter() -> list[str]:
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
