"""Controllers in real time: a submission in its process, and the protocol's PID in this one."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from typing import Any, Protocol

from hardware_eval.bench.plan import CONTROL_GAINS, PlannedRun
from hardware_eval.realtime import take_priority
from ventbench.base.arrays import Floats
from ventbench.task.interfaces import Task


class ControllerFailedError(Exception):
    """A controller raised, returned no number, or did not answer for seconds."""


class LiveController(Protocol):
    """A controller that answers in time or not at all."""

    @property
    def longest_answer(self) -> float:
        """Longest time that an answer took so far, s."""
        ...

    def act(self, row: Floats, budget: float) -> float | None:
        """Ask for the next command.

        Args:
            row: the observation, as :func:`ventbench.entries.cells.pack` lays it out.
            budget: time for the answer, s.

        Returns:
            ``u_in``, %; None if there is no answer yet.

        Raises:
            ControllerFailedError: if there will be none.
        """
        ...

    def close(self) -> None:
        """End it."""
        ...


#: Makes the controller of a run.
MakeController = Callable[[PlannedRun], LiveController]


class SubmissionController:
    """A submission in its process, asked by a thread so that the loop need not wait for it.

    Args:
        runner: as in scoring; see :class:`ventbench.entries.cells.Runner`.
        submission: whose code runs.
        task: what the controller is told.
        real_time: whether ``budget`` holds; else answers are waited for.
    """

    def __init__(self, runner: Any, submission: Any, task: Task, *, real_time: bool = True) -> None:
        self._session = runner.start(submission, [task])
        self._real_time = real_time
        self._label = submission.manifest.name
        # A thread that waits for a pipe.
        begin = take_priority if real_time else None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="controller", initializer=begin)
        self._pending: Future[Floats] | None = None
        self._asked = self._longest = 0.0
        self._check()

    @property
    def longest_answer(self) -> float:
        """Longest time that an answer took so far, s; also one that is still to come."""
        waits = 0.0 if self._pending is None else time.perf_counter() - self._asked
        return max(self._longest, waits)

    def act(self, row: Floats, budget: float) -> float | None:
        """Ask for the next command; an answer to an earlier observation is dropped."""
        began = time.perf_counter()
        if self._pending is not None:
            if self._result(self._pending, budget) is None:
                return None
            budget -= time.perf_counter() - began
        self._asked = time.perf_counter()
        self._pending = self._thread.submit(self._answer, row)
        answer = self._result(self._pending, budget)
        return None if answer is None else float(answer[0])

    def _answer(self, row: Floats) -> Floats:
        answer = self._session.act(row)
        self._longest = max(self._longest, time.perf_counter() - self._asked)
        return answer

    def _result(self, pending: Future[Floats], budget: float) -> Floats | None:
        try:
            answer = pending.result(max(budget, 0.0) if self._real_time else None)
        except NotYet:
            return None
        self._pending = None
        self._check()
        return answer

    def _check(self) -> None:
        for failure in self._session.failures.values():
            raise ControllerFailedError(failure.message(self._label, None))

    def close(self) -> None:
        """End the process; an answer that never comes is not waited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._session.close()


class PIDController:
    """The PID of the protocol in this process, for control runs.

    Args:
        gains: P, I and D, %/cmH2O.
    """

    longest_answer = 0.0

    def __init__(self, gains: tuple[float, float, float]) -> None:
        self._gains = gains
        self._error = self._integral = self._derivative = 0.0

    def act(self, row: Floats, budget: float) -> float | None:
        """Next command; the averages restart at each breath."""
        now, dt, pressure, target = (float(value) for value in row[0, :4])
        if now == 0.0:
            self._error = self._integral = self._derivative = 0.0
        error, a = target - pressure, dt / (dt + 0.5)
        self._integral += a * (error - self._integral)
        self._derivative += a * (error - self._error - self._derivative)
        self._error = error
        P, I, D = self._gains  # noqa: E741 - the field's names
        return P * error + I * self._integral + D * self._derivative

    def close(self) -> None:
        """Nothing to end."""


def control_pid(run: PlannedRun) -> PIDController:
    """The control between scored runs."""
    return PIDController((*CONTROL_GAINS[run.lung], 0.0))
