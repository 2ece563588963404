"""The order in which a cell gives everything up, and the proof that it has.

What needs no cell (capabilities, namespaces, the list of readable folders) the zygote does once;
cells inherit it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass

from . import landlock, libc, privileges, seccomp

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
    "bubblewrap",
)

#: A result may be called official only with these.
OFFICIAL = ("landlock", "seccomp")


@dataclass(frozen=True)
class CellLimits:
    """What one cell may use.

    Attributes:
        memory: bytes beyond the interpreter with its libraries.
        cpu_s: seconds of processor time in total.
        threads: whether it may start threads.
    """

    memory: int
    cpu_s: int
    threads: bool


class Lockdown:
    """What the zygote prepares and each of its cells finishes.

    Args:
        readable: folders and files that stay readable.
        listable: folders of which the names alone stay readable, with all below.
        bubblewrap: whether the zygote runs in it.
    """

    def __init__(self, readable: Sequence[str], listable: Sequence[str], *, bubblewrap: bool):
        self._layers = ["bubblewrap"] if bubblewrap else []
        self._ruleset: int | None = None
        if not libc.LINUX:
            return
        self._layers += (
            ["namespaces", "read-only-mounts"] if bubblewrap else privileges.enter_namespaces()
        )
        privileges.no_new_privs()
        privileges.drop_capabilities()
        privileges.undumpable()
        self._layers += ["no-new-privileges", "no-capabilities", "undumpable"]
        if landlock.abi():
            handle = landlock.ruleset(readable, listable)
            # Out of the way of the numbers that a cell's pipes will have.
            self._ruleset = fcntl.fcntl(handle, fcntl.F_DUPFD_CLOEXEC, 16)
            os.close(handle)

    def finish(self, limits: CellLimits, keep: int) -> list[str]:
        """Lock this process, a fork of the zygote, down for good.

        Args:
            limits: what it may use.
            keep: descriptors below this number are its wire; all others are closed.

        Returns:
            The layers that are in force, shown by trying.

        Raises:
            OSError: if one that this system has does not come into force.
        """
        privileges.limit_resources(limits.memory, limits.cpu_s, limits.threads)
        layers = [*self._layers, "rlimits"]
        if libc.LINUX:
            privileges.undumpable()  # a fork inherits it; once more costs nothing
        if self._ruleset is not None:
            landlock.enforce(self._ruleset)
            layers.append("landlock")
        os.closerange(keep, 1 << 16)
        if self._ruleset is not None:
            _prove_no_files()
        if libc.LINUX and seccomp.available():
            seccomp.restrict(limits.threads)
            _prove_no_sockets()
            layers.append("seccomp")
        return layers


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
