"""Shows a submission the runs of the contract and says what came back; judges nothing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.submissions.contract_runs import Run
from ventbench.submissions.errors import Failure
from ventbench.submissions.folder import Submission
from ventbench.submissions.runner import Runner

Floats = NDArray[np.float64]

#: Rounds whose time does not count: first calls load and compile.
_WARM_UP = 3


@dataclass(frozen=True)
class Answers:
    """What came of the runs.

    Attributes:
        commands: of each run, %, up to its end or failure.
        failures: by number of the run.
        act_seconds: of one ``act`` in each round of all runs, without the first ones.
    """

    commands: tuple[Floats, ...]
    failures: dict[int, Failure]
    act_seconds: Floats


def show(submission: Submission, runs: Sequence[Run], runner: Runner) -> Answers:
    """Run all runs side by side.

    Args:
        submission: whose controller is asked.
        runs: fresh ones.
        runner: of the controllers.

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
            start = time.perf_counter()
            answers = session.act(batch)
            seconds.append((time.perf_counter() - start) / live)
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
