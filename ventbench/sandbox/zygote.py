"""The scorer's end of the zygote: starts it, asks it for cells, hears how they ended."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ventbench.sandbox.child.zygote import (
    CLOCK,
    INTERRUPT,
    KILL,
    PREPARED,
    REPORT,
    REQUEST,
    RUNNING,
    SIZE,
    START,
    TOKEN,
)
from ventbench.sandbox.configuration import SandboxError
from ventbench.sandbox.reader import ENVIRONMENT, OPTIONS, ROOT, SITE
from ventbench.task.interfaces import Task

_BOOT = (
    "import sys; sys.path.insert(0, sys.argv[2]); from ventbench.sandbox.child import zygote; "
    "del sys.path[0]; zygote.main(int(sys.argv[1]), sys.argv[3])"
)

_TASK = REQUEST.size - TOKEN - 1

#: Patience with the zygote, s: until it is prepared, and for an answer on processor time.
_START_S = 60.0
_CLOCK_S = 60.0


class ZygoteClient:
    """A running zygote.

    Args:
        config: what the zygote is told, but for ``site``.

    Raises:
        SandboxError: if it does not start.
    """

    def __init__(self, config: dict[str, Any]):
        config = {**config, "site": [SITE]}
        self._tokens: dict[int, bytes] = {}  # of each cell
        self._ended: dict[bytes, int] = {}
        self._used: dict[bytes, float] = {}  # processor time when last reported, s
        self._data = b""
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close()
        self._control, theirs = socket.socketpair()
        told = (str(theirs.fileno()), ROOT, "apart" if namespaces_work() else "")
        command = [sys.executable, *OPTIONS, "-c", _BOOT, *told]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._stderr,
                cwd="/",
                env=ENVIRONMENT,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        except OSError as error:
            self._control.close()
            self._stderr.close()
            raise SandboxError(f"the sandbox cannot start {command[0]}: {error}") from error
        finally:
            theirs.close()
        self._configure(json.dumps(config).encode())

    def _configure(self, config: bytes) -> None:
        self._control.settimeout(_START_S)
        answer = b""
        with contextlib.suppress(OSError):  # what it wrote to stderr says more
            self._control.sendall(SIZE.pack(len(config)) + config)
            answer = self._control.recv(len(PREPARED), socket.MSG_WAITALL)
        self._control.settimeout(None)
        if answer != PREPARED:
            self._process.kill()
            self._process.wait()
            self._stderr.seek(0)
            said = self._stderr.read()[-2000:].decode(errors="replace").strip()
            self.close()
            raise SandboxError(f"the sandbox's process ended before it was ready: {said}")

    def start(self, cell: int, task: Task | None, pipes: Sequence[int]) -> None:
        """Start a cell.

        Args:
            cell: names it in this process; the zygote knows it by a random token.
            task: what it is told, or None for one that only locks itself down.
            pipes: the ends for its observations and its replies; may be closed afterwards.
        """
        self._tokens[cell] = secrets.token_bytes(TOKEN)
        told = b"" if task is None else json.dumps(task).encode()
        if len(told) > _TASK:
            raise SandboxError(f"a task of {len(told)} bytes, at most {_TASK} are possible")
        self._ask(START, cell, told, pipes)

    def interrupt(self, cell: int) -> None:
        """Ask a cell to say where it is and end."""
        self._ask(INTERRUPT, cell)

    def kill(self, cell: int) -> None:
        """End a cell."""
        self._ask(KILL, cell)

    def _ask(self, what: bytes, cell: int, told: bytes = b"", pipes: Sequence[int] = ()) -> None:
        request = REQUEST.pack(what, self._tokens[cell], told.ljust(_TASK))
        socket.send_fds(self._control, [request], pipes)

    def status(self, cell: int, timeout_s: float) -> int | None:
        """How a cell ended.

        Args:
            cell: which one.
            timeout_s: how long to wait for it to end.

        Returns:
            Exit code, or minus the signal's number; None if it has not ended.
        """
        token = self._tokens[cell]
        self._hear(lambda: token in self._ended, timeout_s)
        return self._ended.get(token)

    def processor_time(self, cells: Iterable[int]) -> dict[int, float]:
        """Processor time of cells since they were started, s, as the kernel counts it.

        Raises:
            SandboxError: if the zygote does not answer.
        """
        asked = {cell: self._tokens[cell] for cell in cells}
        for cell, token in asked.items():
            if token not in self._ended:
                self._used.pop(token, None)
                self._ask(CLOCK, cell)
        if not self._hear(lambda: set(asked.values()) <= self._used.keys(), _CLOCK_S):
            raise SandboxError("the sandbox's process does not say how long cells have computed")
        return {cell: self._used[token] for cell, token in asked.items()}

    def _hear(self, heard: Callable[[], bool], timeout_s: float) -> bool:
        """Take reports until what is waited for was heard; say whether it was in time."""
        deadline = time.monotonic() + timeout_s
        while not heard():
            self._control.settimeout(max(deadline - time.monotonic(), 1e-3))
            try:
                data = self._control.recv(4096)
            except OSError:
                data = b""
            finally:
                self._control.settimeout(None)
            if not data:
                return False
            self._data += data
            while len(self._data) >= REPORT.size:
                token, status, self._used[token] = REPORT.unpack_from(self._data)
                if status != RUNNING:
                    self._ended[token] = os.waitstatus_to_exitcode(status)
                self._data = self._data[REPORT.size :]
        return True

    def close(self) -> None:
        """End it and all its cells; may be called more than once."""
        self._control.close()
        self._stderr.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()  # its cells die with it
            self._process.wait()


def signal_name(status: int) -> str:
    """Name of the signal of a negative exit status, such as ``"SIGSEGV"``."""
    try:
        return signal.Signals(-status).name
    except ValueError:
        return f"signal {-status}"


@functools.cache
def namespaces_work() -> bool:
    """Whether a zygote can make its own namespaces and root here."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); "
        "from ventbench.sandbox.child import isolation as i; "
        "sys.exit(not (i.enter_namespaces() and i.change_root([], '/nonexistent')))"
    )
    if sys.platform != "linux":
        return False
    command = (sys.executable, *OPTIONS, "-c", code, ROOT)

    try:
        run = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return run.returncode == 0
