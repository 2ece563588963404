"""Namespaces of the zygote's own, and a root folder with nothing in it but what cells may read.

After :func:`enter_namespaces` and :func:`change_root` there is no network, no ``/proc``, no other
process, and no path of the machine: what cannot be named cannot be asked for its size or times.

All files in the new root are copies in memory. Files on a disk would carry messages between cells:
a page that one has read, or a name that one has asked for in vain, is found faster by the next, as
the kernel keeps both. In memory all pages are there from the start and no missing name is kept.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import stat
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from . import kernel
from .sources import walk

_NETWORK, _IPC, _HOST_NAME, _USER = 0x40000000, 0x08000000, 0x04000000, kernel.NEW_USER
_MOUNT, _PROCESSES = 0x20000, 0x20000000
_APART = _NETWORK | _IPC | _HOST_NAME | _MOUNT | _PROCESSES

_MOUNT_SETATTR, _AT_FDCWD, _RECURSIVE = 442, -100, 0x8000
_READ_ONLY, _NO_SUID, _PRIVATE = 0x1, 0x2, 1 << 18
_MS_NO_SUID, _MS_NO_DEV, _MS_BIND = 2, 4, 4096
_DETACH = 2
_PIVOT_ROOT = {"x86_64": 155, "aarch64": 41}

#: Any of these is covered while the new root is made; the machine's own is not touched.
_BASES = ("/tmp", "/mnt", "/var", "/usr")
#: Largest copy of a submission, bytes: many times what is accepted; and largest root: jax with all
#: that it needs has 150 MB.
_COPY, _ROOT = 64 << 20, 1 << 30
#: Folders of which nobody imports anything in a cell: tests, graphics, compilers, installers.
_NOT_COPIED = {
    *("test", "tests", "idlelib", "tkinter", "turtledemo", "ensurepip", "lib2to3", "include"),
    *("distutils", "f2py", "__phello__", "pydoc_data"),
}
_MODULE_FILES = ("__file__", "__cached__")
_COPIED = (".py", ".so", f".{sys.implementation.cache_tag}.pyc")

#: Name of the host, the same on every machine.
_HOST = "cell"

#: Devices of the new root.
NULL, RANDOM = "/dev/null", "/dev/urandom"


def enter_namespaces() -> bool:
    """Continue in namespaces of our own, as their first process; the caller's process waits.

    When either process ends, the other and all below the first end too.

    Returns:
        Whether that was allowed; if not, nothing has changed.
    """
    user, group = os.geteuid(), os.getegid()
    ways = (_APART, _APART | _USER) if user == 0 else (_APART | _USER,)
    for flags in ways:
        try:
            kernel.unshare(flags)
        except OSError:
            continue
        socket.sethostname(_HOST)
        if flags & _USER:
            for file, text in (
                ("uid_map", f"{user} {user} 1"),
                ("setgroups", "deny"),
                ("gid_map", f"{group} {group} 1"),
            ):
                Path("/proc/self", file).write_text(text)
        _continue_as_first_process()
        return True
    return False


class Forks:
    """Forks children, each the only process of a namespace of its own.

    All children are process number 1, and their threads are counted from there: no number says
    when a process or a thread was started, or how many others were.

    Attributes:
        parent: number that a child sees as its parent's; 0 from within a namespace.
        is_child: whether this process is one. Numbers do not tell: all may be 1.

    Args:
        apart: whether to make namespaces; else they are plain forks.
    """

    def __init__(self, apart: bool):
        self.is_child, self.parent = False, 0 if apart else os.getpid()
        # The way back, as only one namespace can wait for children at a time.
        flags = os.O_RDONLY | os.O_CLOEXEC
        self._namespace = os.open("/proc/self/ns/pid", flags) if apart else None

    def fork(self) -> int:
        """Fork: the child's number in this process, 0 in the child; OSError if it is refused."""
        if self._namespace is not None:
            kernel.unshare(_PROCESSES)
        child = os.fork()
        self.is_child = child == 0
        if self._namespace is not None:
            if self.is_child:
                os.close(self._namespace)
            else:
                kernel.setns(self._namespace, _PROCESSES)
        return child


def _continue_as_first_process() -> None:
    child = os.fork()
    if child == 0:
        kernel.prctl(kernel.PR_SET_PDEATHSIG, signal.SIGKILL)
        return
    os.closerange(0, 1 << 16)  # else the scorer would not notice that the zygote has ended
    _, status = os.waitpid(child, 0)
    os._exit(os.waitstatus_to_exitcode(status) & 0xFF)


class _MountAttributes(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint64) for name in ("set", "clear", "propagation", "userns"))


def change_root(readable: Iterable[str], folder: str) -> bool:
    """Make a root that holds some files of the machine, read-only, and a copy of a folder.

    Args:
        readable: absolute paths of files and folders, which keep their names. Of folders only
            modules are taken that a cell may import and this process has not imported.
        folder: whose plain files are copied too, so that they can be read whatever their modes;
            keeps its name.

    Returns:
        Whether mounting was allowed; if not, nothing has changed.

    Raises:
        OSError: if the kernel refuses half-way.
    """
    # Opened now, as some may lie below the folder that will be covered.
    sources = {path: _opened(path) for path in sorted({*readable, NULL, RANDOM})}
    copy = dict(_plain_files(folder))
    base = next(path for path in _BASES if os.path.isdir(path))
    try:
        _set_attributes("/", propagation=_PRIVATE)
        options = b"mode=0755,size=%d" % _ROOT
        kernel.mount(b"none", base.encode(), b"tmpfs", _MS_NO_SUID | _MS_NO_DEV, options)
    except OSError:
        _close(sources)
        return False
    os.umask(0o022)  # cells of another user must get through
    mounted: list[str] = []
    loaded = _loaded()
    for path, source in sources.items():
        if source is not None and not any(path.startswith(f"{top}/") for top in mounted):
            if path in (NULL, RANDOM):
                _bind(source, base + path)
            elif os.path.basename(path) not in _NOT_COPIED:
                _copy(f"/proc/self/fd/{source}", base + path, loaded)
            mounted.append(path)
    _close(sources)
    os.makedirs(base + folder, 0o755, exist_ok=True)
    for name, content in copy.items():
        target = Path(base + folder, name)
        target.parent.mkdir(0o755, parents=True, exist_ok=True)
        target.write_bytes(content)
        target.chmod(0o644)
    os.mkdir(f"{base}/.old")
    os.chdir(base)
    kernel.syscall(_PIVOT_ROOT[kernel.MACHINE], b".", b".old")
    os.chdir("/")
    kernel.umount(b"/.old", _DETACH)
    os.rmdir("/.old")
    _set_attributes("/", attributes=_READ_ONLY | _NO_SUID)
    return True


def read_only() -> bool:
    """Make every mount read-only in a root that stays; say whether that was allowed."""
    try:
        _set_attributes("/", propagation=_PRIVATE)
        _set_attributes("/", attributes=_READ_ONLY)
    except OSError:
        return False
    return True


def _set_attributes(path: str, *, attributes: int = 0, propagation: int = 0) -> None:
    request = _MountAttributes(attributes, 0, propagation, 0)
    size = ctypes.sizeof(request)
    name = path.encode()
    kernel.syscall(_MOUNT_SETATTR, _AT_FDCWD, name, _RECURSIVE, ctypes.byref(request), size)


def _opened(path: str) -> int | None:
    try:
        return os.open(path, os.O_PATH | os.O_CLOEXEC)  # type: ignore[attr-defined]
    except OSError:
        return None


def _close(sources: dict[str, int | None]) -> None:
    for source in sources.values():
        if source is not None:
            os.close(source)


def _bind(source: int, target: str) -> None:
    """Put a device into the new root."""
    os.makedirs(os.path.dirname(target), 0o755, exist_ok=True)
    os.close(os.open(target, os.O_CREAT | os.O_WRONLY, 0o644))
    kernel.mount(f"/proc/self/fd/{source}".encode(), os.fsencode(target), b"", _MS_BIND, b"")


def _loaded() -> set[tuple[int, int]]:
    """Device and inode of the files of every imported module: no cell will open them again."""
    paths = {getattr(x, name, None) for x in list(sys.modules.values()) for name in _MODULE_FILES}
    with open("/proc/self/maps") as maps:
        paths |= {line.split(None, 5)[5].rstrip("\n") for line in maps if "/" in line}
    files = set()
    for path in paths:
        with contextlib.suppress(OSError, TypeError, ValueError):
            status = os.stat(path)  # type: ignore[arg-type]
            files.add((status.st_dev, status.st_ino))
    return files


def _copy(source: str, target: str, loaded: set[tuple[int, int]]) -> None:
    """Copy a file or a folder with its times, by which Python knows compiled modules."""
    if not os.path.isdir(source):
        os.makedirs(os.path.dirname(target), 0o755, exist_ok=True)
        _copy_file(source, target, loaded)
        return
    os.makedirs(target, 0o755, exist_ok=True)
    waiting = [(source, target)]
    while waiting:
        origin, there = waiting.pop()
        with os.scandir(origin) as entries:
            for entry in entries:
                name = entry.name
                if entry.is_dir(follow_symlinks=False):
                    if name not in _NOT_COPIED:
                        os.mkdir(f"{there}/{name}", 0o755)
                        waiting.append((entry.path, f"{there}/{name}"))
                elif name.endswith(_COPIED):
                    _copy_file(entry.path, f"{there}/{name}", loaded)


def _copy_file(source: str, target: str, loaded: set[tuple[int, int]]) -> None:
    try:
        file = open(source, "rb", buffering=0)  # noqa: SIM115 - closed below
    except OSError:  # a link that leads nowhere, a file of somebody else
        return
    with file:
        status = os.fstat(file.fileno())
        if (status.st_dev, status.st_ino) in loaded or not stat.S_ISREG(status.st_mode):
            return
        copy = os.open(target, os.O_CREAT | os.O_WRONLY, 0o644)
        try:
            remaining = status.st_size
            while remaining > 0:
                sent = os.sendfile(copy, file.fileno(), None, remaining)
                if not sent:
                    break
                remaining -= sent
            os.utime(copy, ns=(status.st_atime_ns, status.st_mtime_ns))
        finally:
            os.close(copy)


def _plain_files(folder: str) -> Iterator[tuple[str, bytes]]:
    total = 0
    for parent, folders, names in walk(Path(folder)):
        folders[:] = [name for name in folders if name != "__pycache__"]
        for name in names:
            path = parent / name
            if path.is_symlink() or not path.is_file():
                continue
            total += path.stat().st_size
            if total > _COPY:
                raise OSError(f"the submission has more than {_COPY >> 20} MiB")
            yield path.relative_to(folder).as_posix(), _content(path)


def _content(path: Path) -> bytes:
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags | os.O_NOATIME)
    except PermissionError:  # not ours
        descriptor = os.open(path, flags)
    with open(descriptor, "rb") as file:
        return file.read()
