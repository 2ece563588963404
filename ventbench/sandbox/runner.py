"""The runner that a scorer uses by default: every cell in a locked-down process of its own.

While cells run, this process has room for the descriptors of their pipes and cannot be read by
other processes of the same user. Whatever a cell says was written by the submission: it is cut,
escaped and believed in nothing.
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import random
import resource
import signal
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.sandbox.child import kernel, lockdown, wire
from ventbench.sandbox.child.cell import Failure, SubmissionError, printable
from ventbench.sandbox.child.lockdown import FLOOR, OFFICIAL
from ventbench.sandbox.child.wire import Reply
from ventbench.sandbox.pipes import (
    Allowance,
    Budget,
    Clock,
    Outcome,
    Pipes,
    PolledControllers,
    SandboxError,
    ZygoteClient,
    configuration,
    signal_name,
)
from ventbench.task import protocol
from ventbench.task.interfaces import Task

_PROBE_S = 30.0

#: What submitted code could do without a line of the floor, and what gives it.
_EXPOSURE = {
    ("empty-root", "landlock"): (
        "read every file of this user",
        "allow user namespaces (docs/security.md) or boot a kernel with Landlock",
    ),
    ("seccomp",): (
        "reach the network and other processes",
        "use a kernel that filters system calls, on x86-64 or ARM64",
    ),
}


@functools.cache
def layers() -> tuple[str, ...]:
    """Layers that come into force in every cell on this machine, found by starting one.

    It may start threads, as one with JAX may: where the kernel cannot count them, that shows.

    Raises:
        SandboxError: if a cell cannot be started or does not lock itself down.
    """
    pipes = Pipes()
    with tempfile.TemporaryDirectory() as folder:
        settings = configuration(os.path.realpath(folder), "probe", Allowance())
        limits = {**dict(settings["limits"]), "threads": True}  # type: ignore[call-overload]
        zygote = ZygoteClient({**settings, "limits": limits})
        try:
            pipes.open(0, lambda ends: zygote.start(0, None, ends))
            outcomes = pipes.collect({0}, [0], wire.LOCKED, _PROBE_S, float("inf"))
        finally:
            pipes.close_all()
            zygote.close()
    reply = outcomes.get(0)
    if not isinstance(reply, Reply) or reply.kind != wire.LOCKED:
        raise SandboxError(f"a submission cannot be locked down here: {lockdown_message(reply)}")
    return lockdown.names(reply.value)


def check_floor(in_force: Sequence[str]) -> None:
    """Refuse to go on where the layers in force confine too little for any foreign code.

    Raises:
        SandboxError: naming the missing layers first.
    """
    lacking = [line for line in FLOOR if not set(line) & set(in_force)]
    if lacking:
        missing = " and ".join("/".join(line) for line in lacking)
        could, advice = (
            " and ".join(parts) for parts in zip(*map(_EXPOSURE.get, lacking), strict=True)
        )
        raise SandboxError(
            f"{missing} missing on this machine ({platform.system()} {platform.release()}): "
            f"submitted code could {could}, so it does not run. To run it: {advice}; or use "
            "--in-process, which gives it all your rights, for code that you trust"
        )


class SandboxRunner:
    """Runs controllers apart: a :class:`ventbench.entries.cells.Runner`.

    It does not exist below the floor of :data:`~ventbench.sandbox.child.lockdown.FLOOR`.

    Args:
        require_official: refuse to run where a layer is missing that official results need.
        allowance: what a submission may use.
        clock: times the cells out; the system's if not given.
        budget: what all sessions that this runner starts may take together.

    Raises:
        SandboxError: if a cell cannot be locked down, or not far enough.
    """

    def __init__(
        self,
        *,
        require_official: bool = False,
        allowance: Allowance | None = None,
        clock: Clock | None = None,
        budget: Budget | None = None,
    ):
        self._budget = budget
        self._layers = layers() if kernel.LINUX else ()
        check_floor(self._layers)
        self._allowance = allowance or Allowance()
        self._clock = clock
        if require_official and self.missing:
            raise SandboxError(
                f"an official score needs {' and '.join(OFFICIAL)}; missing here: "
                f"{', '.join(self.missing)} (kernel {platform.release()} on {platform.machine()})"
            )

    @property
    def missing(self) -> tuple[str, ...]:
        """Layers that an official result needs and this machine does not have."""
        return tuple(layer for layer in OFFICIAL if layer not in self._layers)

    @property
    def sandbox(self) -> Mapping[str, Any]:
        """Layers in force in every cell, for the record."""
        return {
            "layers": list(self._layers),
            "landlock_abi": kernel.landlock_abi(),
            "kernel": f"{platform.system()} {platform.release()}",
            "official": not self.missing,
        }

    def start(self, submission: SubmittedFolder, tasks: Sequence[Task]) -> SandboxSession:
        """Start the cells of a submission, as :class:`ventbench.entries.cells.Runner` says.

        Raises:
            SandboxError: if a cell does not show the layers of :attr:`sandbox`.
            SubmissionError: if the code cannot be imported, or the budget is spent.
        """
        budget, allowance = self._budget, self._allowance
        if budget is not None:
            if budget.remaining_s <= 0.0:
                raise SubmissionError(
                    f"{submission.label}: took {budget.clock:.0f} s and {budget.processor:.0f} s "
                    f"of processor time; an entry has {budget.seconds:g} s for all of its runs"
                )
            allowance = replace(allowance, total_s=min(allowance.total_s, budget.remaining_s))
        return SandboxSession(submission, tasks, self._layers, allowance, self._clock, budget)


#: A silent cell is waited for this many patiences: the machine may be busy with others. But not
#: once it has had a patience of processor time; of a processor alone it gets nearly all.
_SILENCES, _BUSY = 6, 0.9

#: How long an interrupted cell may take to say where it was, s.
_GRACE_S = 0.5


class SubmittedFolder(Protocol):
    """What a session needs of a submission: where its code lies, and how messages name it."""

    @property
    def folder(self) -> Path:
        """Absolute path."""
        ...

    @property
    def label(self) -> str:
        """As the person named it."""
        ...


class SandboxSession(PolledControllers):
    """Fresh, locked-down controllers, one process each, which must show some layers to be in force.

    It begins with a task a cell.

    Raises:
        SandboxError: if a cell does not lock itself down.
        SubmissionError: if the code cannot be imported.
    """

    def __init__(
        self,
        submission: SubmittedFolder,
        tasks: Sequence[Task],
        layers: tuple[str, ...],
        allowance: Allowance,
        clock: Clock | None = None,
        budget: Budget | None = None,
    ):
        self.failures: dict[int, Failure] = {}
        self._count, self._live = len(tasks), set(range(len(tasks)))
        self._allowance, self._sequence = allowance, [0] * len(tasks)
        self._pending, self._void = set[int](), set[int]()
        self._clock = clock or Clock()
        self._started = self._clock.now()
        self._deadline = self._started + allowance.total_s
        with contextlib.ExitStack() as stack:
            stack.enter_context(descriptors_for(2 * len(tasks)))
            hide_process()
            stack.callback(show_process)
            self._pipes = Pipes(self._clock)
            stack.callback(self._pipes.close_all)
            self._zygote = ZygoteClient(
                configuration(str(submission.folder), submission.label, allowance)
            )
            stack.callback(self._zygote.close)
            if allowance.priority is not None and kernel.LINUX:
                self._zygote.prefer(allowance.priority, allowance.patience_s)
            # Ended first: cells then leave by themselves, and the zygote need not kill.
            stack.callback(self._pipes.close_all)
            if budget is not None:
                stack.callback(self._charge, budget)
            self._lock_down(tasks, layers)
            self._reset()
            self._stack = stack.pop_all()

    def _charge(self, budget: Budget) -> None:
        """Take from a budget what this session has had."""
        budget.clock += self._clock.now() - self._started
        with contextlib.suppress(SandboxError, KeyError):  # of cells that were never started
            budget.processor += self.processor_time()

    def _lock_down(self, tasks: Sequence[Task], layers: tuple[str, ...]) -> None:
        # In an order that nobody knows: a process's number says nothing about its cell.
        for cell in random.SystemRandom().sample(range(self._count), self._count):

            def start(ends: list[int], cell: int = cell) -> None:
                self._zygote.start(cell, tasks[cell], ends)

            self._pipes.open(cell, start)
        due = set(self._live)
        replies, late = self._round(due, wire.LOCKED, self._allowance.start_patience_s)
        for reply in replies.values():
            if not isinstance(reply, Reply) or reply.kind != wire.LOCKED:
                raise SandboxError(f"a cell could not be locked down: {lockdown_message(reply)}")
            lacking = set(layers) - set(lockdown.names(reply.value))
            if lacking:
                raise SandboxError(f"a cell lacks {', '.join(sorted(lacking))}")
        if late:
            if self._clock.now() >= self._deadline:
                raise SubmissionError(f"its time was over before {len(late)} cells had started")
            raise SandboxError(f"{len(late)} cells did not start in time")

    def _reset(self) -> None:
        self._pipes.send(dict.fromkeys(self._live, wire.BEGIN))
        due = set(self._live)
        replies, late = self._round(due, wire.READY, self._allowance.start_patience_s)
        for cell, reply in replies.items():
            failure = self._judge(cell, reply)
            if failure is not None and failure.kind == "import":
                raise SubmissionError(failure.what)
        self._give_up(late)

    def ask(self, cells: Ints, observations: Floats) -> None:
        """Ask some controllers for their next commands, as of the base class."""
        for cell, outcome in self._pipes.early(self._pending).items():
            self._judge(cell, outcome)
        rows, frames = np.ascontiguousarray(observations, "<f8"), {}
        for cell, row in zip(cells.tolist(), rows, strict=True):
            self._sequence[cell] += 1
            if cell in self._live:
                frames[cell] = wire.pack_observation(self._sequence[cell], row.tobytes())
        self._pending |= frames.keys()
        self._void |= set(cells.tolist()) - frames.keys()
        self._pipes.send(frames)

    def answers(self) -> tuple[Ints, Floats]:
        """Take the commands that are there, as of the base class."""
        commands = dict.fromkeys(self._void, 0.0)
        if self._pending and not self._void:
            patience = self._allowance.patience_s
            replies, late = self._round(set(self._pending), wire.COMMAND, patience, some=True)
            for cell, reply in replies.items():
                failed = self._judge(cell, reply) is not None
                if cell in self._pending:  # else it wrote what nobody had asked for
                    commands[cell] = 0.0 if failed else reply.value  # type: ignore[union-attr]
            self._pending -= replies.keys()
            self._give_up(late)
            self._pending -= late
            commands |= dict.fromkeys(late, 0.0)
        self._void.clear()
        return np.array(list(commands), np.int64), np.array(list(commands.values()))

    def processor_time(self) -> float:
        """Processor time that all cells have had, s, as the kernel counts it."""
        return sum(self._zygote.processor_time(range(self._count)).values())

    def close(self) -> None:
        """End all controllers; may be called more than once."""
        self._live.clear()
        self._stack.close()

    def _round(
        self, due: set[int], kind: int, patience_s: float, *, some: bool = False
    ) -> tuple[dict[int, Outcome], set[int]]:
        """Wait for replies; cells that compute or are kept from it are waited for.

        For as long as a reply may take of processor time, and :data:`_SILENCES` times as long on
        the clock; ``some`` takes what is there once there is any.

        Returns:
            What came, by cell, and the cells that are out of time, their own or the session's.
        """
        over, outcomes = set[int](), dict[int, Outcome]()
        used: dict[int, float] = {}  # when a cell was first found silent
        for _ in range(_SILENCES):
            outcomes |= self._pipes.collect(
                due, self._sequence, kind, patience_s, self._deadline, some=some
            )
            if not due or (some and outcomes):
                return outcomes, over
            if self._clock.now() >= self._deadline:
                break
            now = self._zygote.processor_time(due)
            over |= {c for c in due if now[c] - used.setdefault(c, now[c]) >= _BUSY * patience_s}
            due -= over
        return outcomes, due | over

    def _judge(self, cell: int, outcome: Outcome) -> Failure | None:
        """End a cell that has failed."""
        if isinstance(outcome, Reply) and outcome.kind != wire.FAILED:
            if np.isfinite(outcome.value):
                return None
            return self._fail(cell, Verdict("value", f"act returned {outcome.value}"))
        if isinstance(outcome, Reply):
            return self._fail(cell, failed(outcome.text, self._sequence[cell]))
        if outcome is None:
            return self._fail(cell, exit_verdict(self._zygote.status(cell, self._clock.status_s)))
        return self._fail(
            cell, Verdict("wire", "the controller broke the wire's rules", str(outcome))
        )

    def _give_up(self, late: set[int]) -> None:
        """Time out cells; first ask each where it is."""
        if not late:
            return
        outcomes: dict[int, Outcome] = {}
        if not self._pending - late:  # nobody else may answer meanwhile
            for cell in late:
                self._zygote.interrupt(cell)
            deadline = self._clock.now() + _GRACE_S + 0.01 * len(late)
            outcomes = self._pipes.collect(
                set(late), self._sequence, wire.FAILED, _GRACE_S, deadline
            )
        limit = f"the {self._allowance.total_s:.0f} s that were left for its runs"
        if self._clock.now() < self._deadline:
            patience = self._allowance.patience_s
            limit = f"{patience:g} s of processor time, or {_SILENCES * patience:g} s in all"
        for cell in outcomes.keys() - late:  # had answered, and then wrote more or ended
            self._judge(cell, outcomes[cell])
        for cell in late:
            self._fail(cell, not_answered(outcomes.get(cell), limit))

    def _fail(self, cell: int, verdict: Verdict) -> Failure:
        breath = step = None
        if self._sequence[cell]:
            breath, step = divmod(self._sequence[cell] - 1, protocol.INSPIRATION_STEPS)
            breath, step = breath + 1, step + 1
        self.failures[cell] = failure = Failure(*verdict, breath, step)
        self._live.discard(cell)
        self._pipes.close(cell)
        self._zygote.kill(cell)
        return failure


def lockdown_message(outcome: Outcome) -> str:
    """Words of a cell that could not be locked down: before that it runs our code alone."""
    if isinstance(outcome, Reply):
        return outcome.text.decode(errors="replace").replace("\0", " ").strip()
    return "it ended" if outcome is None else str(outcome)


#: What else a process has open.
_DESCRIPTOR_RESERVE = 256


@contextlib.contextmanager
def descriptors_for(count: int) -> Iterator[None]:
    """Raise the limit of open descriptors if need be, and restore it afterwards.

    Raises:
        SandboxError: if the system's own limit is too low.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = count + _DESCRIPTOR_RESERVE
    sufficient = soft == resource.RLIM_INFINITY or soft >= needed
    if not sufficient:
        if hard != resource.RLIM_INFINITY and hard < needed:
            raise SandboxError(
                f"{count} pipes are needed and the system allows {hard} open files; "
                f"raise it (ulimit -Hn {needed}) or score fewer cells at a time"
            )
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
    try:
        yield
    finally:
        if not sufficient:
            with contextlib.suppress(OSError, ValueError):
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


_dumpable_lock = threading.Lock()
_hiders = 0
_dumpable_before = 1


def hide_process() -> None:
    """No tracing, no ``/proc/PID/mem`` for others; counts how often it was asked for."""
    global _hiders, _dumpable_before
    with _dumpable_lock:
        if kernel.LINUX and _hiders == 0:
            _dumpable_before = kernel.prctl(kernel.PR_GET_DUMPABLE)
            kernel.prctl(kernel.PR_SET_DUMPABLE, 0)
        _hiders += 1


def show_process() -> None:
    """Undo one :func:`hide_process`; the last one restores what was before."""
    global _hiders
    with _dumpable_lock:
        _hiders -= 1
        # 2, "for root alone", cannot be set again by hand; 0 is what it means for others.
        if kernel.LINUX and _hiders == 0 and _dumpable_before == 1:
            kernel.prctl(kernel.PR_SET_DUMPABLE, 1)


#: Kinds that a cell may give itself, before the first observation and after it.
_BEFORE, _DURING = ("reset", "import", "construct"), ("act", "type", "value")


class Verdict(NamedTuple):
    """Kind, words and detail of a ``child.cell.Failure``."""

    kind: str
    what: str
    detail: str = ""


def failed(text: bytes, sequence: int) -> Verdict:
    """Verdict on a cell that reported a failure itself, as of :meth:`serve._Replies.fail`.

    It was answering the observation of a number; 0 before the first.
    """
    kind, message, detail, printed = _fields(text)
    kinds = _DURING if sequence else _BEFORE
    kind = kind if kind in kinds else kinds[0]
    # An import's problems are one on a line, and each is cut and escaped by itself.
    message = "\n".join(printable(line) for line in message.splitlines()[:20])
    return Verdict(kind, message or "the submission ended itself", _with_prints(detail, printed))


def exit_verdict(status: int | None) -> Verdict:
    """Verdict on a cell whose pipe closed without an answer, by its exit status, if it has one."""
    if status is None:
        return Verdict("wire", "the controller closed its pipe")
    if status >= 0:
        return Verdict("exit", f"the controller ended its process (exit code {status})")
    if -status == signal.SIGXCPU:
        return Verdict("cpu", "the controller used up its processor time (SIGXCPU)")
    return Verdict("crash", f"the controller's process was ended by {signal_name(status)}")


def not_answered(outcome: Outcome, limit: str) -> Verdict:
    """Verdict on a cell that was out of time, by what it said when it was asked where it is."""
    _, _, detail, printed = _fields(outcome.text if isinstance(outcome, Reply) else b"")
    message = f"the controller did not answer within {limit}"
    return Verdict("timeout", message, _with_prints(detail, printed))


def _fields(text: bytes) -> list[str]:
    fields = text.decode(errors="replace").split("\0", 3)
    return [*fields, "", "", ""][:4]


def _with_prints(detail: str, printed: str) -> str:
    parts = [printable(detail)] if detail else []
    if printed:
        parts.append(f"it printed {printable(printed[-400:], 400)}")
    return "; ".join(parts)
