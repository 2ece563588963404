"""Controllers in real time: a submission in its process, and the protocol's PID in this one.

Beside a submission runs one that computes nothing, in a sandbox of its own, asked at the same
moments: what it is late by, the host is. An entry is blamed for late answers only if they are more
than chance would make of a host that is late as often as it is for the empty one (Fisher's exact
test).
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, field
from typing import Any

from scipy import stats

from hardware_eval.bench.plan import CONTROL_GAINS, PlannedRun
from hardware_eval.realtime import take_priority
from ventbench.base.arrays import Floats
from ventbench.entries.folder import CONTROLLER, open_submission
from ventbench.entries.scaffold import create
from ventbench.task import protocol
from ventbench.task.interfaces import Task

#: Chance of late answers by the host alone below which an entry is to blame; asked after each run.
CHANCE = 0.001


@dataclass(frozen=True)
class Count:
    """Answers that were asked for, and those of them that came late."""

    late: int = 0
    asked: int = 0

    def __add__(self, other: Count) -> Count:
        return Count(self.late + other.late, self.asked + other.asked)

    def __sub__(self, other: Count) -> Count:
        return Count(self.late - other.late, self.asked - other.asked)

    def __str__(self) -> str:
        return f"{self.late} of {self.asked}"


NONE = Count()  #: no answers.


@dataclass
class Lateness:
    """Late answers of a session, which tell a slow entry from a busy host."""

    host: Count = NONE  #: of the empty controller, in all attempts at runs.
    entries: dict[str, Count] = field(default_factory=dict)  #: of each entry, by name.

    def is_of_host(self, entry: str, own: Count, empty: Count) -> bool:
        """Count an attempt at a run; whether the host alone may be to blame for what is late."""
        self.host += empty
        own = self.entries[entry] = self.entries.get(entry, NONE) + own
        if not self.host.asked:
            return False
        table = [[x.late, x.asked - x.late] for x in (own, self.host)]
        chance: Any = stats.fisher_exact(table, alternative="greater")[1]
        return bool(chance >= CHANCE)


class ControllerFailedError(Exception):
    """A controller raised, returned no number, or did not answer for seconds."""


#: A controller that computes nothing.
_EMPTY = """class Controller:
    def reset(self, task):
        pass

    def act(self, observation):
        return 0.0
"""


class _Asked:
    """A submission in its process, asked by a thread that waits for a pipe."""

    def __init__(self, runner: Any, submission: Any, task: Task, real_time: bool = True) -> None:
        self._session = runner.start(submission, [task])
        self._thread = ThreadPoolExecutor(1, initializer=take_priority if real_time else None)
        self._pending: Future[Floats] | None = None
        self._began = self._took = self._longest = 0.0

    def _ask(self, row: Floats) -> Future[Floats]:
        self._began = time.perf_counter()
        self._pending = self._thread.submit(self._answer, row)
        return self._pending

    def _answer(self, row: Floats) -> Floats:
        answer = self._session.act(row)
        self._took = time.perf_counter() - self._began
        self._longest = max(self._longest, self._took)
        return answer

    def close(self) -> None:
        """End the process; an answer that never comes is not waited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._session.close()


class EmptyController(_Asked):
    """A submission that computes nothing, asked beside others to time the host.

    Args:
        runner: as that of the entries, but for a whole session.
    """

    def __init__(self, runner: Any) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="ventbench-empty-")
        folder = create("empty", "other", self._folder.name)
        (folder / CONTROLLER).write_text(_EMPTY)
        task = Task("robustness", None, protocol.DT, protocol.INSPIRATION_STEPS)
        super().__init__(runner, open_submission(str(folder)), task)
        self._budget = 0.0
        self.count = NONE  #: its answers up to now; one under way is not among them.

    def ask(self, row: Floats, budget: float) -> None:
        """Ask it, without waiting; what it has not answered by the next time was late."""
        if self._pending is not None:
            waits = not self._pending.done()
            if not waits:
                self._pending.result()  # raises what it met
            self.count += Count(waits or self._took > self._budget, 1)
            if waits:
                return
        self._budget = budget
        self._ask(row)

    def close(self) -> None:
        """End it."""
        super().close()
        self._folder.cleanup()


class SubmissionController(_Asked):
    """A submission; in real time it is asked so that the loop need not wait for it.

    Args:
        runner: as in scoring; see :class:`ventbench.entries.cells.Runner`.
        submission: whose code runs.
        task: what the controller is told.
        empty: runs beside it in real time; without it answers are waited for, whatever the budget.
    """

    def __init__(
        self,
        runner: Any,
        submission: Any,
        task: Task,
        empty: EmptyController | None = None,
    ) -> None:
        super().__init__(runner, submission, task, real_time=empty is not None)
        self._empty = empty
        self._before = NONE if empty is None else empty.count
        self._label = submission.manifest.name
        self._check()

    @property
    def longest_answer(self) -> float:
        """Longest time that an answer took so far, s; also one that is still to come."""
        waits = 0.0 if self._pending is None else time.perf_counter() - self._began
        return max(self._longest, waits)

    @property
    def beside(self) -> Count:
        """Answers of the empty controller beside it."""
        return NONE if self._empty is None else self._empty.count - self._before

    def act(self, row: Floats, budget: float) -> float | None:
        """Ask for the next command; an answer to an earlier observation is dropped.

        Args:
            row: the observation, as :func:`ventbench.entries.cells.pack` lays it out.
            budget: time for the answer, s.

        Returns:
            ``u_in``, %; None if there is no answer yet.

        Raises:
            ControllerFailedError: if there will be none.
        """
        began = time.perf_counter()
        if self._empty is not None:
            self._empty.ask(row, budget)
        if self._pending is not None:
            if self._result(self._pending, budget) is None:
                return None
            budget -= time.perf_counter() - began
        answer = self._result(self._ask(row), budget)
        return None if answer is None else float(answer[0])

    def _result(self, pending: Future[Floats], budget: float) -> Floats | None:
        try:
            answer = pending.result(None if self._empty is None else max(budget, 0.0))
        except NotYet:
            return None
        self._pending = None
        self._check()
        return answer

    def _check(self) -> None:
        for failure in self._session.failures.values():
            raise ControllerFailedError(failure.message(self._label, None))


class PIController:
    """The protocol's PID with D = 0 in this process, for control runs and self-tests.

    Args:
        gains: P and I, %/cmH2O.
    """

    longest_answer, beside = 0.0, NONE

    def __init__(self, gains: tuple[float, float]) -> None:
        self._gains, self._integral = gains, 0.0

    def act(self, row: Floats, budget: float) -> float:
        """Next command; the average restarts at each breath."""
        now, dt, pressure, target = (float(value) for value in row[0, :4])
        before, error = self._integral if now else 0.0, target - pressure
        self._integral = before + dt / (dt + 0.5) * (error - before)
        P, I = self._gains  # noqa: E741 - the field's names
        return P * error + I * self._integral

    def close(self) -> None:
        """Nothing to end."""


#: A controller that answers in time or not at all.
LiveController = SubmissionController | PIController

#: Makes the controller of a run.
MakeController = Callable[[PlannedRun], LiveController]


def control_pid(run: PlannedRun) -> PIController:
    """The control between scored runs."""
    return PIController(CONTROL_GAINS[run.lung])
