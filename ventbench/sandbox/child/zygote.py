"""Starts cells: a new interpreter that holds nothing worth reading and forks on request.

It is executed afresh, so none of the scorer's memory is in it, and it never runs submitted code.
Requests and answers are of fixed size; the configuration comes first, as JSON.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import json
import os
import select
import signal
import socket
import struct
import sys
from pathlib import Path
from typing import Any, NoReturn

from ventbench.interfaces import Task

from . import libc, preload, privileges, serve
from .lockdown import CellLimits, Lockdown

#: Request: what to do, cell, index of its task. A start brings the cell's ends of two pipes.
REQUEST = struct.Struct("<cIH")
START, INTERRUPT, KILL = b"s", b"i", b"k"
NO_TASK = 0xFFFF

#: Answer: a cell has ended, with this status as of ``waitpid``.
ENDED = struct.Struct("<Ii")

#: Size of the configuration, before it; and the word that follows the preparation.
SIZE = struct.Struct("<I")
PREPARED = b"prepared"

#: Read by C++ libraries to seed their generators.
RANDOM = "/dev/urandom"


class Zygote:
    """The loop between requests and children.

    Args:
        control: socket to the scorer.
        setup: what cells share.
        prepared: their lock-down.
        tasks: what requests choose from.
    """

    def __init__(
        self, control: socket.socket, setup: serve.Setup, prepared: Lockdown, tasks: list[Task]
    ):
        self._control, self._setup, self._prepared, self._tasks = control, setup, prepared, tasks
        self._cells: dict[int, int] = {}  # process -> cell
        self._out = bytearray()
        self._wake, wake = os.pipe2(os.O_NONBLOCK) if libc.LINUX else os.pipe()
        os.set_blocking(wake, False)
        os.set_blocking(self._wake, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        self._pid = os.getpid()

    def run(self) -> None:
        """Serve until the scorer closes the socket."""
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
                    if not self._request():
                        return
                elif event & select.POLLOUT:
                    del self._out[: self._control.send(self._out)]
                else:
                    return
            self._reap()

    def _request(self) -> bool:
        data, pipes, _, _ = socket.recv_fds(self._control, REQUEST.size, 2)
        if len(data) < REQUEST.size:
            return False
        what, cell, task = REQUEST.unpack(data)
        if what == START:
            self._start(cell, self._tasks[task] if task != NO_TASK else None, pipes)
            return True
        for process, number in self._cells.items():
            if number == cell:  # not reaped yet, hence still this process
                os.kill(process, signal.SIGTERM if what == INTERRUPT else signal.SIGKILL)
        return True

    def _start(self, cell: int, task: Task | None, pipes: list[int]) -> None:
        process = os.fork()
        if process == 0:
            try:
                self._become_cell(task, pipes)
            finally:
                os._exit(70)
        self._cells[process] = cell
        for descriptor in pipes:
            os.close(descriptor)

    def _become_cell(self, task: Task | None, pipes: list[int]) -> NoReturn:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        if libc.LINUX:
            privileges.die_with(self._pid)
        # Away from the numbers they shall have, then there.
        away = [fcntl.fcntl(pipe, fcntl.F_DUPFD, 16) for pipe in pipes]
        null = 0
        numbers = (1, 2, serve.OBSERVATIONS, serve.REPLIES)
        for source, number in zip((null, null, *away), numbers, strict=True):
            os.dup2(source, number)
        os.chdir(self._setup.folder)
        setup, prepared = self._setup, self._prepared
        self.__dict__.clear()
        serve.run(setup, prepared, task)

    def _reap(self) -> None:
        while self._cells:
            process, status = os.waitpid(-1, os.WNOHANG)
            if not process:
                return
            self._out += ENDED.pack(self._cells.pop(process), status)

    def end(self) -> None:
        """End all cells and leave none behind."""
        for process in self._cells:
            os.kill(process, signal.SIGKILL)
        for process in self._cells:
            os.waitpid(process, 0)


def _receive(control: socket.socket) -> dict[str, Any]:
    with control.makefile("rb", buffering=0) as file:
        size = SIZE.unpack(file.read(SIZE.size) or b"\0\0\0\0")[0]
        data = b""
        while len(data) < size:
            data += file.read(size - len(data)) or b" "
        return json.loads(data)


def main(descriptor: int) -> None:
    """Prepare, say so, serve.

    Args:
        descriptor: the socket to the scorer.
    """
    control = socket.socket(fileno=descriptor)
    config = _receive(control)
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")  # if memory runs out, a cell ends and not the scorer
    readable, listable = preload.load(config["packages"], config["site"])
    prepared = Lockdown(
        [config["folder"], RANDOM, *readable], listable, bubblewrap=config["bubblewrap"]
    )
    setup = serve.Setup(Path(config["folder"]), config["label"], CellLimits(**config["limits"]))
    sys.argv[:] = [""]
    zygote = Zygote(control, setup, prepared, [Task(*task) for task in config["tasks"]])
    gc.collect()
    gc.freeze()  # else the first collection in each cell copies all of the zygote's memory
    control.sendall(PREPARED)
    try:
        zygote.run()
    finally:
        zygote.end()
