"""The cells of one submission, from start to close."""

from __future__ import annotations

import contextlib
import random
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ventbench import protocol
from ventbench.interfaces import Task
from ventbench.sandbox import descriptors, dumpable
from ventbench.sandbox.allowance import Allowance
from ventbench.sandbox.child import lockdown, wire
from ventbench.sandbox.child.wire import Reply
from ventbench.sandbox.configuration import configuration
from ventbench.sandbox.errors import SandboxError
from ventbench.sandbox.pipes import Outcome, Pipes
from ventbench.sandbox.verdict import Verdict, ended, failed, not_answered
from ventbench.sandbox.zygote import Zygote
from ventbench.submissions.errors import Failure, SubmissionError
from ventbench.submissions.folder import Submission

Floats = NDArray[np.float64]

#: How long an interrupted cell may take to say where it was, s.
_GRACE_S = 0.5


class SandboxSession:
    """Fresh, locked-down controllers, one process each: a ``runner.ControllerSession``.

    Args:
        submission: whose code runs.
        tasks: one for each cell.
        layers: what every cell must show to be in force.
        allowance: what they may use.

    Raises:
        SandboxError: if a cell does not lock itself down.
        SubmissionError: if the code cannot be imported.
    """

    def __init__(
        self,
        submission: Submission,
        tasks: Sequence[Task],
        layers: tuple[str, ...],
        allowance: Allowance,
    ):
        self.failures: dict[int, Failure] = {}
        self._count, self._live = len(tasks), set(range(len(tasks)))
        self._allowance, self._sequence = allowance, 0
        self._deadline = time.monotonic() + allowance.total_s
        with contextlib.ExitStack() as stack:
            stack.enter_context(descriptors.room_for(2 * len(tasks)))
            dumpable.hide()
            stack.callback(dumpable.show)
            self._pipes = Pipes()
            stack.callback(self._pipes.close_all)
            distinct = sorted(set(tasks), key=repr)
            self._zygote = Zygote(
                configuration(str(submission.folder), submission.label, distinct, allowance)
            )
            stack.callback(self._zygote.close)
            # Ended first: cells then leave by themselves, and the zygote need not kill.
            stack.callback(self._pipes.close_all)
            self._lock_down([distinct.index(task) for task in tasks], layers)
            self._reset()
            self._stack = stack.pop_all()

    def _lock_down(self, tasks: list[int], layers: tuple[str, ...]) -> None:
        # In an order that nobody knows: a process's number says nothing about its cell.
        for cell in random.SystemRandom().sample(range(self._count), self._count):

            def start(far: list[int], cell: int = cell) -> None:
                self._zygote.start(cell, tasks[cell], far)

            self._pipes.open(cell, start)
        replies, late = self._round({}, wire.LOCKED, self._allowance.start_patience_s)
        for reply in replies.values():
            if not isinstance(reply, Reply) or reply.kind != wire.LOCKED:
                raise SandboxError(f"a cell could not be locked down: {said(reply)}")
            if set(lockdown.names(reply.value)) != set(layers):
                raise SandboxError(
                    f"a cell has {lockdown.names(reply.value)} in force instead of {layers}"
                )
        if late:
            raise SandboxError(f"{len(late)} cells did not start in time")

    def _reset(self) -> None:
        frames = dict.fromkeys(self._live, wire.BEGIN)
        replies, late = self._round(frames, wire.READY, self._allowance.start_patience_s)
        for cell, reply in replies.items():
            failure = self._judge(cell, reply)
            if failure is not None and failure.kind == "import":
                raise SubmissionError(failure.what)
        self._give_up(late)

    def act(self, observations: Floats) -> Floats:
        """See ``submissions.runner.ControllerSession``."""
        self._sequence += 1
        for cell, outcome in self._pipes.early().items():
            self._judge(cell, outcome)
        rows = np.ascontiguousarray(observations, "<f8")
        frames = {
            cell: wire.pack_observation(self._sequence, rows[cell].tobytes()) for cell in self._live
        }
        replies, late = self._round(frames, wire.COMMAND, self._allowance.patience_s)
        commands = np.zeros(self._count)
        for cell, reply in replies.items():
            if self._judge(cell, reply) is None:
                commands[cell] = reply.value  # type: ignore[union-attr]
        self._give_up(late)
        return commands

    def close(self) -> None:
        """See ``submissions.runner.ControllerSession``."""
        self._live.clear()
        self._stack.close()

    def _round(
        self, frames: dict[int, bytes], kind: int, patience_s: float
    ) -> tuple[dict[int, Outcome], set[int]]:
        self._pipes.send(frames)
        late = set(self._live)
        found = self._pipes.collect(late, self._sequence, kind, patience_s, self._deadline)
        return found, late

    def _judge(self, cell: int, outcome: Outcome) -> Failure | None:
        """End a cell that has failed."""
        if isinstance(outcome, Reply) and outcome.kind != wire.FAILED:
            if np.isfinite(outcome.value):
                return None
            return self._fail(cell, Verdict("value", f"act returned {outcome.value}"))
        if isinstance(outcome, Reply):
            return self._fail(cell, failed(outcome.text, self._sequence))
        if outcome is None:
            return self._fail(cell, ended(self._zygote.status(cell, 2.0)))
        return self._fail(
            cell, Verdict("wire", "the controller broke the wire's rules", str(outcome))
        )

    def _give_up(self, late: set[int]) -> None:
        """Time out cells; first ask each where it is."""
        if not late:
            return
        for cell in late:
            self._zygote.interrupt(cell)
        waiting = set(late)
        deadline = time.monotonic() + _GRACE_S + 0.01 * len(late)
        said = self._pipes.collect(waiting, self._sequence, wire.FAILED, _GRACE_S, deadline)
        total = time.monotonic() >= self._deadline
        limit = self._allowance.total_s if total else self._allowance.patience_s
        for cell in said.keys() - late:  # had answered, and then wrote more or ended
            self._judge(cell, said[cell])
        for cell in late:
            self._fail(cell, not_answered(said.get(cell), limit, total))

    def _fail(self, cell: int, verdict: Verdict) -> Failure:
        breath = step = None
        if self._sequence:
            breath, step = divmod(self._sequence - 1, protocol.INSPIRATION_STEPS)
            breath, step = breath + 1, step + 1
        self.failures[cell] = failure = Failure(*verdict, breath, step)
        self._live.discard(cell)
        self._pipes.close(cell)
        self._zygote.kill(cell)
        return failure


def said(outcome: Outcome) -> str:
    """Words of a cell that could not be locked down: before that it runs our code alone."""
    if isinstance(outcome, Reply):
        return outcome.text.decode(errors="replace").replace("\0", " ").strip()
    return "it ended" if outcome is None else str(outcome)
