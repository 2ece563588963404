"""The order in which a cell gives everything up, and the proof that it has.

What needs no cell (capabilities, namespaces, the list of readable folders) the zygote does once;
cells inherit it.
"""

from __future__ import annotations

import errno
import fcntl
import importlib
import json
import os
import socket
import stat
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

from . import isolation, kernel, seccomp

#: Every layer, in the order of the bits of a ``LOCKED`` reply.
LAYERS = (
    "rlimits",
    "no-new-privileges",
    "no-capabilities",
    "undumpable",
    "namespaces",
    "read-only-mounts",
    "landlock",
    "seccomp",
    "empty-root",
    "own-descriptors",
    "clean-fork",
    "counted-threads",
)

#: Nothing foreign runs without one layer of each line: no file of the machine, no other process.
FLOOR = (("empty-root", "landlock"), ("seccomp",))

#: A result may be called official only with these. Older records name fewer: theirs are data.
OFFICIAL = (
    *("namespaces", "empty-root", "own-descriptors", "clean-fork", "landlock", "seccomp"),
    "counted-threads",
)


@dataclass(frozen=True)
class CellLimits:
    """What a cell may use: bytes beyond the interpreter with libraries, processor time, threads."""

    memory: int
    cpu_s: int
    threads: bool


class Lockdown:
    """What the zygote prepares and each of its cells finishes.

    Args:
        readable: folders and files that stay readable.
        listable: folders of which the names alone stay readable, with all below.
        layers: those that are in force already.
        folder: the submission's, readable too.
        change_root: whether to leave the machine's root for one with these files alone.
    """

    def __init__(
        self,
        readable: Sequence[str],
        listable: Sequence[str],
        *,
        layers: Sequence[str] = (),
        folder: str | None = None,
        change_root: bool = False,
    ):
        self._layers = list(layers)
        self._ruleset: int | None = None
        # Another user must be able to read the interpreter.
        self._root = os.geteuid() == 0 and bool(os.stat(os.__file__).st_mode & stat.S_IROTH)
        self._used = kernel.address_space()
        if not kernel.LINUX:
            return
        kernel.no_new_privs()
        if folder is not None and change_root:
            if isolation.change_root(readable, folder):
                self._layers += ["empty-root", "read-only-mounts"]
            elif isolation.read_only():
                self._layers.append("read-only-mounts")
        kernel.undumpable()
        if kernel.landlock_abi():
            readable = [*readable, *([folder] if folder else [])]
            handle = kernel.ruleset(readable, listable)
            # Out of the way of the numbers that a cell's pipes will have.
            self._ruleset = fcntl.fcntl(handle, fcntl.F_DUPFD_CLOEXEC, 16)
            os.close(handle)

    def finish(self, limits: CellLimits, keep: int, parent: int | None = None) -> list[str]:
        """Lock this process, a fork of the zygote, down for good.

        Descriptors below ``keep`` are its wire, all others are closed; it ends with ``parent``.

        Returns:
            The layers that are in force, shown by trying.

        Raises:
            OSError: if one that this system has does not come into force.
        """
        layers = [*self._layers, "rlimits"]
        if self._root and "empty-root" in self._layers:
            kernel.become_stranger()
        processes = None if limits.threads else 0
        if limits.threads and kernel.count_processes_apart():
            processes = kernel.THREADS
        if processes is not None and kernel.LINUX:
            layers.append("counted-threads")
        memory = None if self._used is None else self._used + limits.memory
        kernel.limit_resources(memory, limits.cpu_s, processes)
        if kernel.LINUX:
            kernel.drop_capabilities()
            kernel.undumpable()  # a fork inherits it, but another user is another matter
            if parent is not None:
                kernel.die_with(parent)
            layers += ["no-new-privileges", "no-capabilities", "undumpable"]
        if self._ruleset is not None:
            kernel.enforce(self._ruleset)
            layers.append("landlock")
        os.closerange(keep, 1 << 16)
        if self._ruleset is not None:
            _prove_no_files()
        if "empty-root" in self._layers:
            _prove_no_names()
        if kernel.LINUX and seccomp.available():
            seccomp.restrict(limits.threads)
            _prove_no_sockets()
            layers.append("seccomp")
        return layers


def _prove_no_names() -> None:
    for path in ("/proc", "/etc", "/sys", "/tmp/.old"):
        try:
            os.stat(path)
        except FileNotFoundError:
            continue
        raise OSError(f"the root was changed and {path} is there nevertheless")


def _prove_no_files() -> None:
    try:
        os.close(os.open("/", os.O_RDONLY))
    except OSError as error:
        if error.errno == errno.EACCES:
            return
        raise
    raise OSError("Landlock was switched on and / can be read nevertheless")


def _prove_no_sockets() -> None:
    try:
        socket.socket(socket.AF_UNIX).close()
    except OSError as error:
        if error.errno == errno.EPERM:
            return
        raise
    raise OSError("seccomp was switched on and a socket was opened nevertheless")


def bits(layers: Sequence[str]) -> int:
    """Layers as the number that a ``LOCKED`` reply carries."""
    return sum(1 << LAYERS.index(layer) for layer in layers)


def names(number: float) -> tuple[str, ...]:
    """Layers of such a number; none if it is not one."""
    if not 0 <= number < 1 << len(LAYERS):
        return ()
    return tuple(layer for bit, layer in enumerate(LAYERS) if int(number) >> bit & 1)


#: Exit codes of a reader: the parser ran out of memory or of recursion depth.
OUT_OF_MEMORY, TOO_DEEP = 3, 4

#: Descriptors of a reader from here on are closed: 1 takes the answer.
_READER_END = 3


def read(request: str) -> NoReturn:
    """Answer one request on hostile files on standard output, locked down like a cell.

    One function of ventbench is imported, the process locks itself down, the function reads, and
    its answer leaves as JSON. Whatever a parser does with a hostile file ends here.

    Args:
        request: JSON with ``function`` (``"module:name"``), ``arguments``, ``readable`` folders,
            ``site``, ``memory`` in bytes, ``cpu_s``.
    """
    task = json.loads(request)
    sys.path.append(task["site"])
    module, _, name = task["function"].partition(":")
    function = getattr(importlib.import_module(module), name)
    limits = CellLimits(task["memory"], task["cpu_s"], threads=False)
    Lockdown(task["readable"], []).finish(limits, _READER_END)
    try:
        data = json.dumps(function(*task["arguments"])).encode()
        while data:
            data = data[os.write(1, data) :]
    except MemoryError:
        os._exit(OUT_OF_MEMORY)
    except RecursionError:
        os._exit(TOO_DEEP)
    os._exit(0)
