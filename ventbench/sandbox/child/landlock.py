"""Landlock: the files, sockets and signals that a cell may still reach, decided by the kernel.

Only reading of named folders is granted. Nothing may be written, created, renamed or executed, no
TCP port bound or connected (ABI 4), no abstract Unix socket outside reached and nobody outside
signalled (ABI 6). A kernel newer than this file is used up to ABI 7.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable

from . import libc

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


def abi() -> int:
    """Landlock ABI of the running kernel; 0 where it is absent or switched off."""
    try:
        return libc.syscall(_CREATE_RULESET, None, 0, _VERSION_FLAG)
    except OSError:
        return 0


def taken_away(version: int) -> tuple[int, int, int]:
    """File rights, network rights and scopes that an ABI, from 1, can take away: all are taken."""
    files = (1 << _FILE_RIGHTS[min(version, 5)]) - 1
    network = _NET_BIND_AND_CONNECT if version >= 4 else 0
    scopes = _SCOPE_ABSTRACT_SOCKET_AND_SIGNAL if version >= 6 else 0
    return files, network, scopes


def ruleset(readable: Iterable[str], listable: Iterable[str] = ()) -> int:
    """Prepare what :func:`enforce` puts into force.

    Args:
        readable: folders (with all below) and files that stay readable; missing ones are skipped.
        listable: folders of which, with all below, the names alone stay readable.

    Returns:
        A descriptor.

    Raises:
        OSError: if the kernel refuses.
    """
    attributes = _Ruleset(*taken_away(abi()))
    # Kernels of before a field was added take the larger structure as long as the rest is zero.
    handle = libc.syscall(_CREATE_RULESET, ctypes.byref(attributes), ctypes.sizeof(attributes), 0)
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
        libc.syscall(_RESTRICT_SELF, handle, 0)
    finally:
        os.close(handle)


def _grant(handle: int, path: str, rights: int) -> None:
    try:
        target = os.open(path, os.O_PATH | os.O_CLOEXEC)  # type: ignore[attr-defined]
    except FileNotFoundError:
        return
    try:
        rule = _PathBeneath(rights, target)
        libc.syscall(_ADD_RULE, handle, _RULE_PATH_BENEATH, ctypes.byref(rule), 0)
    finally:
        os.close(target)
