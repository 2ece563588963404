"""Starts cells: a new interpreter that holds nothing worth reading and forks on request.

It is executed afresh, so none of the scorer's memory is in it, and it never runs submitted code.
A cell is named by a random token and told its task as bytes that the zygote never reads. A fork
leaves the loop by returning to :func:`main`, so that no frame of the zygote stays below the
submission's, and takes along nothing but its own task and pipes. What every cell finds imported is
imported here, once; the folders of those packages are all that a cell may import more from.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from . import isolation, serve
from .isolation import RANDOM
from .lockdown import CellLimits, Lockdown

#: Imported once by the zygote, so that cells need not: what small controllers use.
STANDARD = (
    *("abc", "array", "ast", "base64", "bisect", "cmath", "collections.abc", "contextlib", "copy"),
    *("csv", "dataclasses", "decimal", "enum", "fractions", "functools", "hashlib", "heapq"),
    *("inspect", "io", "itertools", "json", "linecache", "logging", "math", "numbers", "operator"),
    *("pathlib", "pickle", "random", "re", "statistics", "string", "struct", "textwrap", "time"),
    *("traceback", "types", "typing", "warnings", "weakref", "zipfile", "zlib", "encodings.cp437"),
)
NUMPY = ("numpy", "numpy.fft", "numpy.linalg", "numpy.polynomial", "numpy.random")

_SITE = ("site-packages", "dist-packages")

#: Bytes of a token.
TOKEN = 16
#: Request: what to do, token of the cell, its task as JSON in spaces to one length (or only
#: spaces: lock down and end). A start brings the cell's ends of two pipes.
REQUEST = struct.Struct(f"<c{TOKEN}s238s")
START, INTERRUPT, KILL, CLOCK = b"s", b"i", b"k", b"c"

#: Answer: token of the cell, its status as of ``waitpid`` or :data:`RUNNING`, and its processor
#: time, s, as the kernel counts it.
REPORT = struct.Struct(f"<{TOKEN}sid")
RUNNING = -1

#: Size of the configuration, before it; and the word that follows the preparation.
SIZE = struct.Struct("<I")
PREPARED = b"prepared"


#: Linux's number of the clock of all threads of a process, beside the process in the clock's name.
_PROCESS_CLOCK = 2


class Zygote:
    """The loop between requests and children, over a socket to the scorer."""

    def __init__(self, control: socket.socket, forks: isolation.Forks, cpu_s: int):
        self._control, self._forks, self._cpu_s = control, forks, cpu_s
        self._cells: dict[int, bytes] = {}  # process -> token
        self._request = bytearray(REQUEST.size)
        self._out = bytearray()
        self._wake, self._signalled = os.pipe()
        os.set_blocking(self._signalled, False)
        os.set_blocking(self._wake, False)
        signal.signal(signal.SIGCHLD, _ignore)
        signal.set_wakeup_fd(self._signalled, warn_on_full_buffer=False)

    def run(self) -> serve.Start | None:
        """Serve until the scorer closes the socket: None then.

        In a fork that is to be a cell, what it needs, with all else forgotten.
        """
        poll = select.poll()
        poll.register(self._wake, select.POLLIN)
        while True:
            # Never block on writing: the scorer may itself be writing requests.
            poll.register(self._control, select.POLLIN | (select.POLLOUT if self._out else 0))
            for descriptor, event in poll.poll():
                if descriptor == self._wake:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self._wake, 4096)
                elif event & select.POLLIN:
                    pipes = self._receive()
                    if pipes is None:
                        return None
                    if self._request[:1] != START:
                        self._signal()
                    elif (process := self._forks.fork()) == 0:
                        return self._forget(pipes)
                    else:
                        self._cells[process] = bytes(self._request[1 : 1 + TOKEN])
                    for pipe in pipes:
                        os.close(pipe)
                    self._request[:] = bytes(REQUEST.size)
                elif event & select.POLLOUT:
                    del self._out[: self._control.send(self._out)]
                else:
                    return None
            self._reap()

    def _receive(self) -> list[int] | None:
        """Read one request in place, so that no copy of a cell's task lies anywhere else."""
        size, extra, _, _ = self._control.recvmsg_into([self._request], socket.CMSG_SPACE(8))
        if size < REQUEST.size:
            return None
        return [pipe for _, _, data in extra for pipe in struct.unpack(f"{len(data) // 4}i", data)]

    def _signal(self) -> None:
        what, token, _ = REQUEST.unpack(self._request)
        for process, name in self._cells.items():
            if name == token and what == CLOCK:
                with contextlib.suppress(OSError):  # it has ended, which is reported too
                    used = time.clock_gettime(~process << 3 | _PROCESS_CLOCK)
                    self._out += REPORT.pack(token, RUNNING, used)
            elif name == token:  # not reaped yet, hence still this process
                os.kill(process, signal.SIGTERM if what == INTERRUPT else signal.SIGKILL)

    def _forget(self, pipes: list[int]) -> serve.Start:
        """Be a zygote no more: keep this cell's task and pipes."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        task = bytes(self._request[1 + TOKEN :]).strip(b" ")
        for secret in (self._request, self._out):
            secret[:] = bytes(len(secret))
        self._cells.clear()
        self._control.close()
        os.close(self._wake)
        os.close(self._signalled)
        start = serve.Start(task, pipes, self._forks.parent)
        self.__dict__.clear()
        return start

    def _reap(self) -> None:
        while self._cells:
            process, status, used = os.wait4(-1, os.WNOHANG)
            if not process:
                return
            seconds = used.ru_utime + used.ru_stime
            if status == signal.SIGKILL and seconds >= self._cpu_s:
                # Ignored by the first process of a namespace, or on purpose.
                status = signal.SIGXCPU
            self._out += REPORT.pack(self._cells.pop(process), status, seconds)

    def end(self) -> None:
        """End all cells and leave none behind."""
        for process in self._cells:
            os.kill(process, signal.SIGKILL)
        for process in self._cells:
            os.waitpid(process, 0)


def _ignore(_signal: int, _frame: object) -> None:
    """Let a child's end wake the loop, which needs some handler."""


def _configuration(control: socket.socket) -> dict[str, Any]:
    with control.makefile("rb", buffering=0) as file:
        size = SIZE.unpack(file.read(SIZE.size) or b"\0\0\0\0")[0]
        data = b""
        while len(data) < size:
            data += file.read(size - len(data)) or b" "
        return json.loads(data)


def _serve(
    descriptor: int, forks: isolation.Forks, layers: list[str]
) -> list[tuple[serve.Setup, Lockdown, serve.Start]]:
    """Prepare, say so, serve: nothing at the end; in each cell, once, for :func:`serve.run`."""
    control = socket.socket(fileno=descriptor)
    config = _configuration(control)
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")  # if memory runs out, a cell ends and not the scorer
    readable, listable = load_packages(config["packages"], config["site"])
    prepared = Lockdown(
        [RANDOM, *readable],
        listable,
        layers=layers,
        folder=config["folder"],
        change_root="namespaces" in layers,
    )
    setup = serve.Setup(Path(config["folder"]), config["label"], CellLimits(**config["limits"]))
    sys.argv[:], sys.orig_argv[:] = [""], []
    cpu_s = config["limits"]["cpu_s"]
    del config
    zygote = Zygote(control, forks, cpu_s)
    gc.collect()
    gc.freeze()  # else the first collection in each cell copies all of the zygote's memory
    control.sendall(PREPARED)
    try:
        start = zygote.run()
    finally:
        if not forks.is_child:
            zygote.end()
    return [] if start is None else [(setup, prepared, start)]


def load_packages(packages: Iterable[str], site: Iterable[str]) -> tuple[list[str], list[str]]:
    """Import what cells share, then take the folders of packages off the search path.

    Only packages that are imported here can be imported in a cell: others, ventbench's simulators
    and data among them, are neither on its path nor readable.

    Args:
        packages: modules beyond the standard library; those that are not installed are skipped.
        site: folders of installed packages.

    Returns:
        What a cell may read, and the folders of which it may read the names alone.
    """
    for name in STANDARD:
        importlib.import_module(name)
    standard = [path for path in sys.path if os.path.isdir(path)]
    site = list(site)
    sys.path.extend(site)
    for name in packages:
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(name)
    sys.path[:] = standard
    for path in site:
        sys.path_importer_cache.pop(path, None)
    packages = [folder for path in site for folder in _imported(path)]
    return [*packages, *(entry for path in standard for entry in _entries(path))], standard


def _imported(site: str) -> list[str]:
    """Files and folders of what has been imported from there, with shared libraries beside it."""
    imported = set()
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and file.startswith(site + os.sep):
            top = file[len(site) + 1 :].split(os.sep)[0]
            imported |= {top, f"{top}.libs"}
    return sorted(os.path.join(site, name) for name in imported - {"ventbench", "ventbench.libs"})


def _entries(folder: str) -> list[str]:
    """Everything in a folder of the standard library but the packages installed there."""
    return [os.path.join(folder, name) for name in os.listdir(folder) if name not in _SITE]


def main(descriptor: int, apart: str) -> None:
    """Be the zygote, and in each fork a cell, which runs from here and not from the loop.

    Over a socket to the scorer; ``apart``, with namespaces and a root of its own if not empty.
    """
    layers: list[str] = []
    if apart and isolation.enter_namespaces():
        layers.append("namespaces")
    forks = isolation.Forks(apart="namespaces" in layers)
    try:
        cell = _serve(descriptor, forks, layers)
        if cell:
            serve.run(cell)
    finally:
        if forks.is_child:
            os._exit(70)
