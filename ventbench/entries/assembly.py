"""From a run of all cells to its score."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ventbench.entries.errors import SubmissionError
from ventbench.entries.folder import Submission
from ventbench.entries.result import CellFailure, Score
from ventbench.entries.runner import Runner
from ventbench.entries.stepping import ProtocolRun
from ventbench.task import protocol
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Task
from ventbench.task.metrics.figures import InspirationSignals, figures
from ventbench.task.metrics.score import passes_safety_gate, run_error
from ventbench.task.rollouts import Expirations, Inspirations
from ventbench.trajectories import end_to_end


def enter(
    submission: Submission, track: str | None, lungs: Sequence[str], runner: Runner
) -> tuple[str, list[Task]]:
    """Say what a submission is told of each lung on a track.

    Args:
        submission: that is to be scored.
        track: ``"performance"`` or ``"robustness"``; the manifest's first if not given.
        lungs: ids.
        runner: that will run it.

    Returns:
        The track, and a task for each lung.

    Raises:
        SubmissionError: if it does not enter the track, or the runner cannot run it.
    """
    if submission.controller is not None and runner.sandbox is not None:
        raise SubmissionError(f"{submission.label}: only a folder can run in a sandbox")
    entered = submission.manifest.tracks
    track = track or entered[0]
    if track not in entered:
        raise SubmissionError(
            f"{submission.label}: submission.toml, key tracks: enters {', '.join(entered)}; "
            f"it cannot be scored for {track}"
        )
    known = track == "performance"
    return track, [
        Task(track, name if known else None, protocol.DT, protocol.INSPIRATION_STEPS)
        for name in lungs
    ]


def assemble(
    submission: Submission,
    tasks: Sequence[Task],
    lungs: tuple[str, ...],
    pips: tuple[float, ...],
    cells: Scenario,
    run: ProtocolRun,
    replayed: tuple[Inspirations, Expirations],
    *,
    seconds: float,
    **about: Any,
) -> Score:
    """Make the result of a run; L lungs, P PIPs, K draws.

    Args:
        submission: that ran.
        tasks: what it was told of each lung.
        lungs: ids.
        pips: nominal PIPs, cmH2O.
        cells: nominal cells and draws, batch shape ``(L, 1 + K, P)``.
        run: of all cells.
        replayed: the nominal run with its expirations, shape ``(L, P, BREATHS, steps)``.
        seconds: that the run took.
        **about: further attributes of the :class:`~ventbench.entries.result.Score`.
    """
    track, shape = tasks[0].track, run.pressure.shape[:3]
    # The expiration of the last breath is run for the picture only; no score depends on either.
    joined = [
        np.concatenate([getattr(part, name) for part in replayed], axis=-1)
        for name in ("pressure", "u_in")
    ]
    timing = {
        "seconds": seconds,
        "act_median_us": 1e6 * float(np.median(run.act_seconds)),
        "act_max_us": 1e6 * float(np.max(run.act_seconds)),
    }
    # The target of every inspiratory step is PIP.
    peep, pip, dt = (
        np.broadcast_to(np.asarray(x), shape)[..., None] for x in (cells.peep, cells.pip, cells.dt)
    )
    errors = run_error(run.pressure, pip[..., None])
    for cell in run.failures:
        errors[cell] = np.nan
    requested = run.requested[:, 0]
    pressure, u_in, asked = (
        x[:, 0][:, :, protocol.SCORED_BREATHS, :] for x in (run.pressure, run.u_in, run.requested)
    )
    return Score(
        submission=submission,
        track=track,
        lungs=lungs,
        pips=pips,
        nominal=errors[:, 0],
        drawn=np.moveaxis(errors[:, 1:], 1, 0),
        safe=np.all(passes_safety_gate(run.pressure, pip, dt), axis=(1, 2, 3)),
        peak=run.pressure.max(axis=(1, 2, 3, 4)),
        figures=figures(InspirationSignals(pressure, u_in, asked, peep[:, 0], pip[:, 0], dt[:, 0])),
        below=np.sum(requested < 0.0, axis=(1, 2, 3)),
        above=np.sum(requested > protocol.U_MAX, axis=(1, 2, 3)),
        commands=requested[0].size,
        failures=_failures(run, submission, tasks, lungs, pips),
        requested=run.requested,
        trajectories=end_to_end(submission.manifest.name, track, lungs, pips, *joined),
        timing=timing,
        **about,
    )


def _failures(
    run: ProtocolRun,
    submission: Submission,
    tasks: Sequence[Task],
    lungs: tuple[str, ...],
    pips: tuple[float, ...],
) -> tuple[CellFailure, ...]:
    return tuple(
        CellFailure(
            lungs[i], pips[p], k or None, failure, failure.message(submission.label, tasks[i].lung)
        )
        for (i, k, p), failure in sorted(run.failures.items())
    )
