"""Who runs the controllers: an interface that a sandbox fills, and the plain way in this process.

A runner starts one fresh controller for each cell and then answers a batch of observations at a
time. Only numbers cross: a :class:`Task` for each cell at the start, then at every step
:data:`~ventbench.sandbox.child.cell.ROW` floats to each controller and one float back.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.entries.errors import Failure
from ventbench.entries.folder import Submission
from ventbench.sandbox.child.cell import Cell, Failed, controller_class
from ventbench.sandbox.pipes import Asked
from ventbench.task.interfaces import Observation, Task


class ControllerSession(Protocol):
    """Controllers of all cells of one submission, between start and close."""

    @property
    def failures(self) -> Mapping[int, Failure]:
        """What went wrong up to now, by index of the cell; a failed cell stays failed."""
        ...

    def ask(self, cells: Ints, observations: Floats) -> None:
        """Give some controllers, ``(n,)``, their next observations, ``(n, ROW)``; see :func:`pack`.

        Each is asked by itself, once for each step of each inspiration, in order, after its answer.
        """
        ...

    def answers(self) -> tuple[Ints, Floats]:
        """Take the commands that have come, and wait for one if there is none.

        Cells, shape ``(m,)``, and their ``u_in``, %: finite, 0 for a failed cell, not clipped.
        """
        ...

    def act(self, observations: Floats) -> Floats:
        """Ask every controller and wait for all, see :class:`ventbench.sandbox.pipes.Asked`."""
        ...

    def processor_time(self) -> float:
        """Processor time that the controllers have had, s, as the system counts it."""
        ...

    def close(self) -> None:
        """End all controllers; may be called more than once."""
        ...


class Runner(Protocol):
    """Starts sessions."""

    @property
    def sandbox(self) -> Mapping[str, Any] | None:
        """Layers that keep a submission apart, for the record; None makes a result not official."""
        ...

    def start(self, submission: Submission, tasks: Sequence[Task]) -> ControllerSession:
        """Make and reset one fresh controller of a submission for each task, which is a cell's.

        A controller that cannot be made or reset is a failure of its cell, found in the session.

        Raises:
            SubmissionError: if the code cannot be imported or lacks what it must have.
        """
        ...


def pack(observation: Observation) -> Floats:
    """Lay a batch of observations out as rows, batch axes flattened.

    Fields of shape ``(...)``, ``targets_ahead`` ``(..., TARGETS_AHEAD)``; float64, shape
    ``(cells, ROW)``, the fields in their order.
    """
    shape = np.shape(observation.pressure)
    columns = [
        np.broadcast_to(np.asarray(field, float), shape)[..., None]
        if name != "targets_ahead"
        else np.asarray(field, float)
        for name, field in zip(Observation._fields, observation, strict=True)
    ]
    rows = np.concatenate(columns, axis=-1)
    return rows.reshape(-1, rows.shape[-1])


class InProcessSession(Asked):
    """Controllers of all cells in this process; :class:`InProcessRunner` starts them."""

    def __init__(self, submission: Submission, tasks: Sequence[Task]):
        controller = submission.controller
        source = None if controller is None else submission.label
        if controller is None:
            controller = controller_class(submission.folder, submission.label)
        self.failures: dict[int, Failure] = {}
        self._answers: dict[int, float] = {}
        self._cells: dict[int, Cell] = {}
        for index, task in enumerate(tasks):
            try:
                self._cells[index] = Cell(controller, task, submission.folder, source)
            except Failed as failed:
                self.failures[index] = failed.failure

    def ask(self, cells: Ints, observations: Floats) -> None:
        """Ask some controllers for their next command; see :class:`ControllerSession`."""
        for index, row in zip(cells.tolist(), observations.tolist(), strict=True):
            self._answers[index] = 0.0
            if index in self._cells:
                try:
                    self._answers[index] = self._cells[index].act(row)
                except Failed as failed:
                    self.failures[index] = failed.failure
                    del self._cells[index]

    def answers(self) -> tuple[Ints, Floats]:
        """Take the commands; see :class:`ControllerSession`."""
        given, self._answers = self._answers, {}
        return np.array(list(given), np.int64), np.array(list(given.values()))

    def processor_time(self) -> float:
        """Processor time of this process, s; see :class:`ControllerSession`."""
        return time.process_time()

    def close(self) -> None:
        """Forget the controllers."""
        self._cells.clear()


class InProcessRunner:
    """Runs controllers in this process, with all of its rights: for code that you trust.

    Quick, and good for one's own development. Nothing stops a submission from reading the
    simulators or keeping state from cell to cell, so results carry ``"sandbox": null`` and
    ``"official": false``.
    """

    sandbox: Mapping[str, Any] | None = None

    def start(self, submission: Submission, tasks: Sequence[Task]) -> ControllerSession:
        """Make and reset one fresh controller for each cell; see :class:`Runner`."""
        return InProcessSession(submission, tasks)


def runner_of(submission: Submission, *, sandbox: bool) -> Runner:
    """Choose how a submission runs: a folder in locked-down processes unless ``sandbox`` is False.

    A class or function always runs in this process.

    Raises:
        SandboxError: if this machine cannot run submissions apart.
    """
    if not sandbox or submission.controller is not None:
        return InProcessRunner()
    from ventbench.sandbox.runner import SandboxRunner

    return SandboxRunner()
