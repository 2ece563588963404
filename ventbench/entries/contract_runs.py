"""Runs that the contract shows a controller, and its answers; :mod:`contract` judges them.

Plain runs, repetitions in the same and in another process, and unusual inputs. They run from the
submission itself; only where a controller is reset and made anew in the middle of a run is a copy
needed in which it can be.
"""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.entries.errors import Failure
from ventbench.entries.folder import CONTROLLER, Submission
from ventbench.entries.runner import ControllerSession, Runner
from ventbench.sandbox.child.cell import ROW
from ventbench.task import protocol
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNG_IDS

#: Yields observations, receives commands in %.
Script = Generator[list[float], float, None]

#: Breaths and steps of one plain run.
BREATHS = 2
STEPS = BREATHS * protocol.INSPIRATION_STEPS

_PIP = 25.0  # cmH2O
_FULL, _TIME_CONSTANT = 60.0, 0.2  # of the stand-in for a lung, cmH2O at 100 % and s


class ContractRun(NamedTuple):
    """One cell.

    Attributes:
        task: what the controller is told.
        script: what it is shown.
        unusual: what is unusual about it, for a sentence; empty if nothing is.
    """

    task: Task
    script: Script
    unusual: str = ""


def plain(tracks: Sequence[str]) -> list[ContractRun]:
    """A run for each lung on the performance track, and for the unnamed one on the other.

    Args:
        tracks: those that the submission enters.
    """
    runs = []
    for track in tracks:
        lungs = LUNG_IDS if track == "performance" else (None,)
        runs += [ContractRun(task(track, lung), breaths()) for lung in lungs]
    return runs


def repeated(told: Task) -> list[ContractRun]:
    """Return the plain run in another process; thrice in one, reset, then renewed between."""
    return [ContractRun(told, breaths()), ContractRun(told, _thrice())]


def unusual(told: Task) -> list[ContractRun]:
    """Short runs with inputs at and beyond the edge of what a bench gives."""
    random = np.random.default_rng(0)
    steps = protocol.INSPIRATION_STEPS
    wild = random.uniform(-20.0, 80.0, steps)
    uneven = random.uniform(0.005, 0.1, steps)
    inputs = {
        "a control step of 10 ms": _played(dt=0.01),
        "a control step of 60 ms": _played(dt=0.06),
        "uneven control steps": _played(dt=uneven),
        "a pressure of -20 cmH2O": _played(pressure=-20.0),
        "a pressure of 120 cmH2O": _played(pressure=120.0),
        "a very noisy pressure": _played(pressure=wild),
        "a pressure and a target of 0 cmH2O": _played(pressure=0.0, target=0.0),
        "a target of 60 cmH2O": _played(target=60.0),
    }
    return [ContractRun(told, script, f"with {what}") for what, script in inputs.items()]


def task(track: str, lung: str | None) -> Task:
    """What a controller is told of a run."""
    return Task(track, lung, protocol.DT, protocol.INSPIRATION_STEPS)


def breaths() -> Script:
    """Two breaths on a stand-in for a lung: pressure follows the valve with one time constant."""
    for _ in range(BREATHS):
        pressure, command = protocol.PEEP, 5.0
        for step in range(protocol.INSPIRATION_STEPS):
            elapsed = step * protocol.DT
            answer = yield _row(elapsed, protocol.DT, pressure, _target(elapsed), command)
            command = min(max(answer, 0.0), protocol.U_MAX)
            rest = protocol.PEEP + _FULL * command / protocol.U_MAX
            pressure += (rest - pressure) * protocol.DT / _TIME_CONSTANT


def _thrice() -> Script:
    yield from breaths()
    for moment in (RESET, RENEW):
        yield _row(moment, protocol.DT, protocol.PEEP, _PIP, 5.0)
        yield from breaths()


def _played(
    dt: float | np.ndarray = protocol.DT,
    pressure: float | np.ndarray = 20.0,
    target: float = _PIP,
) -> Script:
    steps = protocol.INSPIRATION_STEPS
    widths = np.broadcast_to(dt, steps)
    starts, pressures = np.cumsum(widths) - widths, np.broadcast_to(pressure, steps)
    command = 5.0
    columns = (starts.tolist(), widths.tolist(), pressures.tolist())
    for start, width, measured in zip(*columns, strict=True):
        answer = yield _row(start, width, measured, target, command)
        command = min(max(answer, 0.0), protocol.U_MAX)


def _target(elapsed: float, pip: float = _PIP) -> float:
    falls = (protocol.FALL_START, protocol.FALL_END)
    return float(np.interp(elapsed, falls, (pip, protocol.PEEP)))


def _row(elapsed: float, dt: float, pressure: float, target: float, command: float) -> list[float]:
    ahead = [_target(elapsed + k * dt, target) for k in range(1, protocol.TARGETS_AHEAD + 1)]
    row = [elapsed, dt, pressure, target, *ahead, command]
    assert len(row) == ROW
    return row


#: Observations with these times, which no run has, ask for a reset, or a new controller and reset.
RESET, RENEW = -1.0, -2.0

# Runs at the end of controller.py, under a name of its own: the author's lines keep their numbers,
# and the driver's are never taken for the author's. The class itself stays, as its code may name
# it; only its `act` is replaced.
_DRIVER = f"""
def _drive(theirs):
    from inspect import getattr_static

    act, news, tasks = getattr_static(theirs, "act"), {{}}, {{}}
    reset = getattr_static(theirs, "reset")

    def bound(function, self):
        return function.__get__(self, type(self)) if hasattr(function, "__get__") else function

    def driven_reset(self, task):
        tasks[id(self)] = task
        return bound(reset, self)(task)

    def driven_act(self, observation):
        if observation.time >= 0.0:
            return bound(act, news.get(id(self), self))(observation)
        if observation.time == {RENEW}:
            news[id(self)] = theirs()
        bound(reset, news.get(id(self), self))(tasks[id(self)])
        return 0.0

    theirs.reset, theirs.act = driven_reset, driven_act


_found = globals().get("Controller")
if isinstance(_found, type) and hasattr(_found, "reset") and hasattr(_found, "act"):
    _drive(_found)
"""


@contextlib.contextmanager
def driven(submission: Submission) -> Iterator[Submission]:
    """Give a submission whose controller obeys :data:`RESET` and :data:`RENEW`.

    Args:
        submission: stays as it is.
    """
    with tempfile.TemporaryDirectory() as parent:
        # Links resolved: Landlock and messages compare real paths.
        folder = Path(parent).resolve() / submission.folder.name
        shutil.copytree(submission.folder, folder, ignore=shutil.ignore_patterns("__pycache__"))
        path = folder / CONTROLLER
        path.chmod(0o644)
        with open(path, "ab") as file:
            code = f'\nexec(compile({_DRIVER!r}, "<contract>", "exec"))\n'
            file.write(code.encode())
        yield dataclasses.replace(submission, folder=folder)


#: Rounds whose time does not count: first calls load and compile.
_WARM_UP = 3


@dataclass(frozen=True)
class Answers:
    """What came of the runs.

    Attributes:
        commands: answers of each run, %, up to its end or failure.
        failures: what failed, by number of the run.
        act_seconds: processor time of one ``act`` in each round, s, without the first ones.
    """

    commands: tuple[Floats, ...]
    failures: dict[int, Failure]
    act_seconds: Floats


def joined(first: Answers, second: Answers) -> Answers:
    """Return the answers of two sets of runs as those of one, with the times of the first."""
    shift = len(first.commands)
    failures = {**first.failures, **{k + shift: v for k, v in second.failures.items()}}
    return Answers((*first.commands, *second.commands), failures, first.act_seconds)


def processor_time(session: ControllerSession) -> float:
    """Time by the system's count, s: neither an entry nor a busy machine changes it."""
    return session.processor_time()


def run_all(
    submission: Submission,
    runs: Sequence[ContractRun],
    runner: Runner,
    clock: Callable[[ControllerSession], float] = processor_time,
    count: Callable[[], None] = lambda: None,
) -> Answers:
    """Run all runs side by side.

    Args:
        submission: whose controller is asked.
        runs: fresh ones.
        runner: runs the controllers.
        clock: times the calls of ``act``, s; by default as the system counts a process's time.
        count: called after each round.

    Raises:
        SubmissionError: if the code cannot be imported.
    """
    commands: list[list[float]] = [[] for _ in runs]
    failures: dict[int, Failure] = {}
    seconds = []
    session = runner.start(submission, [run.task for run in runs])
    try:
        rows = [next(run.script) for run in runs]  # of one that has ended, its last again
        waiting = set(range(len(runs)))
        while waiting:
            batch = np.array(rows)
            live = max(1, len(runs) - len(session.failures))
            start = clock(session)
            answers = session.act(batch)
            seconds.append((clock(session) - start) / live)
            count()
            for k in sorted(waiting):
                if k in session.failures:
                    failures[k] = session.failures[k]
                    waiting.remove(k)
                    continue
                commands[k].append(float(answers[k]))
                try:
                    rows[k] = runs[k].script.send(float(answers[k]))
                except StopIteration:
                    waiting.remove(k)
    finally:
        session.close()
    kept = tuple(np.array(values) for values in commands)
    return Answers(kept, failures, np.array(seconds[_WARM_UP:]))
