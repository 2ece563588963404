"""The scorer's ends: of the zygote, which starts cells, and of the pipes to all of them.

The zygote is told what cells may use, is asked for them, and says how they ended; each cell gets a
frame and gives a reply.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import random
import resource
import secrets
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.sandbox.child import wire
from ventbench.sandbox.child.cell import Failure, SubmissionError
from ventbench.sandbox.child.wire import Reply, WireError
from ventbench.sandbox.child.zygote import (
    CLOCK,
    INTERRUPT,
    KILL,
    NUMPY,
    PREPARED,
    REPORT,
    REQUEST,
    RUNNING,
    SIZE,
    START,
    TOKEN,
)
from ventbench.sandbox.reader import ENVIRONMENT, OPTIONS, ROOT, SITE, UnreadableError, read_apart
from ventbench.task.interfaces import Task


class SandboxError(InputError):
    """This machine cannot run submissions apart as was asked for; the message says what to do."""


MIB, GIB = 1 << 20, 1 << 30


@dataclass
class Budget:
    """Time that all sessions of an entry share; it is used up as they end.

    Whoever sleeps runs out of the clock's time, whoever computes of the processor's.
    """

    seconds: float  #: of each.
    clock: float = 0.0  #: time on the clock that was taken, s.
    processor: float = 0.0  #: processor time that was taken, s.

    @property
    def remaining_s(self) -> float:
        """What is left of the scarcer one, s."""
        return self.seconds - max(self.clock, self.processor)


@dataclass(frozen=True)
class Allowance:
    """Limits of a session; the processor is shared by all its cells, hence patience, not a pace."""

    memory: int = 512 * MIB  #: bytes of one cell beyond the interpreter with its libraries.
    cpu_s: int = 60  #: seconds of processor time of one cell: import, reset and three breaths.
    start_patience_s: float = 20.0  #: processor time in which a controller is imported and reset.
    #: processor time of one answer. Cells that wait for something, or for a processor, time out
    #: when none of them has answered for a multiple of it on the clock.
    patience_s: float = 5.0
    #: all cells time out when a session has taken this long on the clock, so that no entry keeps
    #: others waiting for longer.
    total_s: float = 900.0
    #: real-time priority (``SCHED_FIFO``) that cells get where the system grants it; None for none.
    priority: int | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not value > 0:
                raise ValueError(f"allowance {name} is {value}, it must be positive")


#: Packages that may be imported besides numpy and the standard library, with what to load of each.
OPTIONAL = {
    "jax": ("jax", "jax.numpy", "jax.scipy", "jax.scipy.linalg"),
    "flax": ("flax", "flax.linen", "flax.nnx"),
    "safetensors": ("safetensors", "safetensors.numpy"),
}

#: Those that start threads and reserve much address space.
_THREADED = ("jax", "flax")


def modules_needed(folder: Path) -> tuple[tuple[str, ...], bool]:
    """Modules to load before cells start, so that they share them, and whether they need threads.

    Raises:
        SubmissionError: if the sources cannot be read within the limits.
    """
    try:
        packages = read_apart("ventbench.sandbox.child.sources:imported_packages", folder)
    except UnreadableError as error:
        raise SubmissionError(f"{folder.name}: a source {error}") from None
    imported = [name for name in OPTIONAL if name in packages]
    modules = [module for name in imported for module in OPTIONAL[name]]
    return (*NUMPY, *modules), any(name in _THREADED for name in imported)


#: JAX reserves address space that it does not use.
_THREADED_MEMORY = 4 * GIB


def configuration(folder: str, label: str, allowance: Allowance) -> dict[str, object]:
    """What a zygote is told of a submission: folder, name in messages, and what cells may use."""
    modules, threads = modules_needed(Path(folder))
    memory = max(allowance.memory, _THREADED_MEMORY) if threads else allowance.memory
    return {
        "folder": folder,
        "label": label,
        "packages": modules,
        "limits": {"memory": memory, "cpu_s": allowance.cpu_s, "threads": threads},
    }


#: Of bytes that nothing had asked for, whether they are found with the reply or before the next.
_UNASKED = "bytes came after the reply"

#: How long answers of further cells are gathered after the first, s: a step of the plants costs
#: the same for few cells as for many. Slow cells keep nobody waiting for longer.
GATHERED_S = 0.05

#: What became of a cell: its reply, a breach of the wire's rules, or None: its pipe has ended.
Outcome = Reply | WireError | None


class PolledControllers(ABC):
    """Controllers of all cells of a submission, from start to close; none waits for another."""

    #: what went wrong up to now, by index of the cell; a failed cell stays failed.
    failures: dict[int, Failure]

    @abstractmethod
    def ask(self, cells: Ints, observations: Floats) -> None:
        """Give some controllers, ``(n,)``, their next observations, ``(n, ROW)``.

        Each is asked by itself, once for each step of each inspiration, in order, after its answer.
        """

    @abstractmethod
    def answers(self) -> tuple[Ints, Floats]:
        """Take the commands that have come, and wait for one if there is none.

        Cells, shape ``(m,)``, and their ``u_in``, %: finite, 0 for a failed cell, not clipped.
        """

    @abstractmethod
    def processor_time(self) -> float:
        """Processor time that the controllers have had, s, as the system counts it."""

    @abstractmethod
    def close(self) -> None:
        """End all controllers; may be called more than once."""

    def act(self, observations: Floats) -> Floats:
        """Ask every controller for its next command, and wait for all of them.

        Observations ``(cells, ROW)``; ``u_in``, %, shape ``(cells,)``.
        """
        commands, waiting = np.zeros(len(observations)), len(observations)
        self.ask(np.arange(waiting), observations)
        while waiting:
            cells, values = self.answers()
            commands[cells] = values
            waiting -= len(cells)
        return commands


class Clock:
    """The time of a session, and waiting in it; a test can put another in its place."""

    #: How long the exit status of a cell may take to arrive once its pipe has ended, s.
    status_s = 2.0

    def now(self) -> float:
        """Return the time of a clock that never goes back, s."""
        return time.monotonic()

    def wait(
        self, selector: selectors.BaseSelector, timeout_s: float, due: Set[int], kind: int
    ) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait until a pipe can be read, or the time is over: then nothing comes of it.

        A test may look at the cells whose reply of a ``kind`` is ``due``.
        """
        return selector.select(timeout_s)


class Pipes:
    """Two pipes for each cell; a clock waits for replies."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or Clock()
        self._ends: dict[int, tuple[int, int]] = {}  # cell -> observations, replies
        self._partial: dict[int, bytes] = {}  # of replies, until the rest of them comes
        self._selector = selectors.DefaultSelector()
        self._random = random.Random()  # seeded by the system; nobody else's stream is touched

    def open(self, cell: int, start: Callable[[list[int]], None]) -> None:
        """Make the pipes of a cell; ``start`` gives it the far ends, for observations and replies.

        Raises:
            OSError: if there are not enough descriptors.
        """
        child_reader, observations = os.pipe()
        try:
            replies, child_writer = os.pipe()
        except OSError:
            os.close(child_reader)
            os.close(observations)
            raise
        os.set_blocking(observations, False)
        os.set_blocking(replies, False)
        self._ends[cell] = observations, replies
        self._selector.register(replies, selectors.EVENT_READ, cell)
        try:
            start([child_reader, child_writer])
        finally:
            os.close(child_reader)
            os.close(child_writer)

    def close(self, cell: int) -> None:
        """Close the pipes of a cell if they are open; it then ends by itself."""
        ends = self._ends.pop(cell, None)
        if ends:
            with contextlib.suppress(KeyError):  # when it was found to have ended
                self._selector.unregister(ends[1])
            os.close(ends[0])
            os.close(ends[1])

    def close_all(self) -> None:
        """Close everything; may be called more than once."""
        for cell in list(self._ends):
            self.close(cell)
        self._selector.close()

    def early(self, due: Set[int] = frozenset()) -> dict[int, Outcome]:
        """Cells that have written although nothing was due, or have ended; not those in ``due``."""
        outcomes: dict[int, Outcome] = {}
        for key, _ in self._selector.select(0):
            if key.data not in due:
                data = self._read(key.fd)
                outcomes[key.data] = WireError(_UNASKED) if data else None
        return outcomes

    def send(self, frames: Mapping[int, bytes]) -> None:
        """Send each cell its frame, in random order; one that has ended is found by reading."""
        for cell in self._random.sample(list(frames), len(frames)):
            with contextlib.suppress(OSError):
                os.write(self._ends[cell][0], frames[cell])

    def collect(
        self,
        due: set[int],
        sequence: Mapping[int, int] | Sequence[int],
        kind: int,
        patience_s: float,
        deadline: float,
        *,
        some: bool = False,
    ) -> dict[int, Outcome]:
        """Wait for one reply of each cell.

        Args:
            due: the cells; those that have not answered in time are left in it.
            sequence: number of the observation that each cell answers.
            kind: what kind of reply is due, besides a failure.
            patience_s: how long to wait for the next cell to answer.
            deadline: when to stop waiting altogether, by the clock, s.
            some: take what is there once half have answered, or :data:`GATHERED_S` after the
                first, and wait for nobody else.

        Returns:
            By cell, what came.
        """
        outcomes: dict[int, Outcome] = {}
        progress, requested, gathered = self._clock.now(), len(due), float("inf")
        while due:
            wait = min(progress + patience_s, deadline, gathered) - self._clock.now()
            if some and 2 * len(outcomes) >= requested:
                wait = 0.0
            events = self._clock.wait(self._selector, max(wait, 0.0), due, kind)
            if not events and wait <= 0:
                break
            for key, _ in events:
                cell, data = key.data, self._read(key.fd)
                try:
                    if cell not in due and data:
                        raise WireError(_UNASKED)
                    data = self._partial.pop(cell, b"") + data if data else data
                    outcome = wire.unpack_reply(data, sequence[cell], (kind,)) if data else None
                except WireError as error:
                    outcome = error
                if data and outcome is None:
                    self._partial[cell] = data
                    continue
                # A cell that has answered and then ends, or writes more, is found here too.
                outcomes[cell] = outcome
                if some and len(outcomes) == 1:
                    gathered = self._clock.now() + GATHERED_S
                due.discard(cell)
                progress = self._clock.now()
                if not isinstance(outcome, Reply) or outcome.kind == wire.FAILED:
                    self._selector.unregister(key.fd)  # nothing that follows counts
        return outcomes

    def _read(self, descriptor: int) -> bytes:
        # One byte more than fits: an endless stream is told from the longest reply.
        try:
            return os.read(descriptor, wire.REPLY.size + wire.TEXT_LIMIT + 1)
        except BlockingIOError:
            return b""


_BOOT = (
    "import sys; sys.path.insert(0, sys.argv[2]); from ventbench.sandbox.child import zygote; "
    "del sys.path[0]; zygote.main(int(sys.argv[1]), sys.argv[3])"
)

_TASK = REQUEST.size - TOKEN - 1

#: Patience with the zygote, s: until it is prepared, and for an answer on processor time.
_START_S = 60.0
_CLOCK_S = 60.0


class ZygoteClient:
    """A running zygote, that is told all of the configuration but ``site``.

    Raises:
        SandboxError: if it does not start.
    """

    def __init__(self, config: dict[str, Any]):
        config = {**config, "site": [SITE]}
        self._tokens: dict[int, bytes] = {}  # of each cell
        self._exit_status: dict[bytes, int] = {}
        self._used: dict[bytes, float] = {}  # processor time when last reported, s
        self._data = b""
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close()
        self._control, theirs = socket.socketpair()
        arguments = (str(theirs.fileno()), ROOT, "apart" if namespaces_work() else "")
        command = [sys.executable, *OPTIONS, "-c", _BOOT, *arguments]
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
            message = self._stderr.read()[-2000:].decode(errors="replace").strip()
            self.close()
            raise SandboxError(f"the sandbox's process ended before it was ready: {message}")

    def prefer(self, level: int, longest_s: float) -> None:
        """Let cells run before ordinary work, where it is granted; the kernel ends those in a loop.

        Args:
            level: priority of ``SCHED_FIFO``.
            longest_s: processor time without a pause after which a process is ended, s.
        """
        limit = round(1e6 * longest_s)
        with contextlib.suppress(OSError):
            resource.prlimit(self._process.pid, resource.RLIMIT_RTTIME, (limit, limit))
            os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(level))

    def start(self, cell: int, task: Task | None, pipes: Sequence[int]) -> None:
        """Start a cell, which the zygote knows by a random token, with far ends of its two pipes.

        Those may be closed afterwards; without a task it only locks itself down.
        """
        self._tokens[cell] = secrets.token_bytes(TOKEN)
        payload = b"" if task is None else json.dumps(task).encode()
        if len(payload) > _TASK:
            raise SandboxError(f"a task of {len(payload)} bytes, at most {_TASK} are possible")
        self._ask(START, cell, payload, pipes)

    def interrupt(self, cell: int) -> None:
        """Ask a cell to say where it is and end."""
        self._ask(INTERRUPT, cell)

    def kill(self, cell: int) -> None:
        """End a cell."""
        self._ask(KILL, cell)

    def _ask(
        self, operation: bytes, cell: int, payload: bytes = b"", pipes: Sequence[int] = ()
    ) -> None:
        request = REQUEST.pack(operation, self._tokens[cell], payload.ljust(_TASK))
        socket.send_fds(self._control, [request], pipes)

    def status(self, cell: int, timeout_s: float) -> int | None:
        """How a cell ended: exit code, or minus the signal's number; None if not within a time."""
        token = self._tokens[cell]
        self._hear(lambda: token in self._exit_status, timeout_s)
        return self._exit_status.get(token)

    def processor_time(self, cells: Iterable[int]) -> dict[int, float]:
        """Processor time of cells since they were started, s, as the kernel counts it.

        Raises:
            SandboxError: if the zygote does not answer.
        """
        tokens = {cell: self._tokens[cell] for cell in cells}
        for cell, token in tokens.items():
            if token not in self._exit_status:
                self._used.pop(token, None)
                self._ask(CLOCK, cell)
        if not self._hear(lambda: set(tokens.values()) <= self._used.keys(), _CLOCK_S):
            raise SandboxError("the sandbox's process does not say how long cells have computed")
        return {cell: self._used[token] for cell, token in tokens.items()}

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
                    self._exit_status[token] = os.waitstatus_to_exitcode(status)
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
