"""Scoring a submission: nominal cells on each lung's reference rig, draws on all of its rigs.

Scored is the airway pressure; controllers see readings of the sensor.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.base.executor import Progress
from ventbench.entries.cells import (
    ROUNDS,
    Cells,
    Protocol,
    ProtocolRun,
    Runner,
    counted,
    protocol_of,
    run_cells,
    runner_of,
)
from ventbench.entries.folder import Submission, as_submission
from ventbench.entries.manifest import TRACKS
from ventbench.entries.result import Score
from ventbench.entries.runs import PLATEAU_SHARE, PLATEAU_TOLERANCE, CellFailure, Runs
from ventbench.plants.catalog import SimulatorLike
from ventbench.plants.rigs import load_rigs
from ventbench.sandbox.child.cell import SubmissionError
from ventbench.task import protocol
from ventbench.task.interfaces import Task
from ventbench.task.metrics.score import (
    InspirationSignals,
    controllable_error,
    figures,
    passes_safety_gate,
    run_error,
    steady_error,
    time_above_alarm,
)
from ventbench.task.waveform import expiratory_command
from ventbench.trajectories import end_to_end


def score(
    submission: Any,
    *,
    simulator: SimulatorLike = "frozen",
    track: str | None = None,
    draws: int = 0,
    stress: int = 0,
    stressors: Sequence[str] = (),
    sandbox: bool = True,
    progress: Progress | None = None,
) -> Score:
    """Score a controller on the lungs of a set of simulators.

    Lower is better. The paper's score is mean |pressure - target| over the inspirations of the
    nominal cells, cmH2O; the ranked score is the normalised one over all draws.

    Args:
        submission: folder of a submission, the name of a bundled one, a class with ``reset(task)``
            and ``act(observation)``, or a function from an observation to ``u_in``, %. Classes and
            functions run in this process.
        simulator: simulators with plants; see :func:`ventbench.load_simulators`.
        track: ``"performance"`` (the controller is told the lung) or ``"robustness"``; the first
            that the submission enters if not given.
        draws: how many of the 20 development draws to run besides the nominal cells.
        stress: how many of them to run under missing physics that the controller is not told of,
            one PIP of each lung and draw; the robustness track only, 6 for an official score.
        stressors: names of some stressors alone, such as ``["leak", "sensor_low"]``.
        sandbox: run a folder in locked-down processes. Without it, its code runs in this process
            with all rights: only for code that you trust, and never official.
        progress: called after each round of commands with rounds done and all rounds.

    Returns:
        The score; ``print`` and notebooks show one row a lung.

    Raises:
        SubmissionError: if there is no such submission, it cannot be run at all, it does not enter
            the track, or a class or function fails in every run.
        SandboxError: if this machine cannot run submissions apart.
        InputError: if there are no such simulators or draws.
        FloatingPointError: if a plant answers with NaN or infinity.

    Examples:
        >>> from ventbench import score
        >>> def proportional(observation):
        ...     return 5.0 + 2.0 * (observation.target - observation.pressure)
        >>> result = score(proportional, simulator="physics")
        >>> result.official
        False
    """
    entry = as_submission(submission)
    runner = runner_of(entry, sandbox=sandbox)
    protocol_ = protocol_of(load_rigs(simulator), draws=draws, stress=stress, stressors=stressors)
    result = run_protocol(entry, protocol_, track=track, runner=runner, progress=progress)
    if len(result.failures) == result.requested[..., 0, 0].size and entry.sha256 is None:
        first = result.failures[0]  # a class or function that never works
        raise SubmissionError(first.message) from first.failure.cause
    return result


def run_protocol(
    submission: Submission,
    protocol_: Protocol,
    *,
    track: str | None = None,
    runner: Runner | None = None,
    progress: Progress | None = None,
) -> Score:
    """Run a submission through the protocol, on any rigs and by any runner.

    What is run is from :func:`ventbench.entries.cells.protocol_of`, on the manifest's first track
    if none is given. Without a runner a folder runs in the sandbox, a class or function in this
    process. ``progress`` is called after each round of commands with rounds done and all rounds.

    Raises:
        SubmissionError: if the submission cannot be run at all, or does not enter the track.
        ValueError: if the plants are not those of the lungs.
        FloatingPointError: if a plant answers with NaN or infinity.
    """
    started = time.perf_counter()
    runner = runner or runner_of(submission, sandbox=True)
    names = tuple(lung.id for lung in protocol_.rigs.lungs)
    track, tasks = enter(submission, track, names, runner)
    stressed = protocol_.stressed
    if stressed is not None and track != "robustness":
        raise SubmissionError(
            f"{submission.label}: submission.toml, key tracks: is scored for {track}; missing "
            "physics does not tell the lung and needs an entry of the robustness track"
        )
    stressed_draws = 0 if stressed is None else len(stressed.draw)
    count = counted(progress, (1 + stressed_draws) * ROUNDS)
    with compilation.float64():
        run = run_cells(protocol_.cells, runner, submission, tasks, count)
        under_stress = None
        if stressed is not None:
            run_under_stress = run_cells(stressed, runner, submission, tasks, count)
            under_stress = runs_of(run_under_stress, stressed, submission, tasks)
    scenario = protocol_.cells.scenario
    inspired = run.u_in[0, :, 0]
    fixed = expiratory_command(np.arange(protocol.INSPIRATION_STEPS, protocol.BREATH_STEPS))
    fixed = np.broadcast_to(fixed, (*inspired.shape[:-1], len(fixed)))
    joined = run.breaths[0, :, 0], np.concatenate([inspired, fixed], axis=-1)
    # The target of every inspiratory step is PIP.
    pip = np.asarray(scenario.pip)
    controllable = controllable_error(run.pressure[0], pip[..., None, None])
    for _, *cell in run.failures:
        controllable[tuple(cell)] = np.nan
    signals = (
        x[0, :, 0][:, :, protocol.SCORED_BREATHS, :]
        for x in (run.pressure, run.u_in, run.requested)
    )
    levels = (
        np.broadcast_to(np.asarray(x), pip.shape)[:, 0, :, None]
        for x in (scenario.peep, pip, scenario.dt)
    )
    return Score(
        submission=submission,
        track=track,
        protocol=protocol_,
        runs=runs_of(run, protocol_.cells, submission, tasks),
        stressed=under_stress,
        controllable=controllable,
        figures=figures(InspirationSignals(*signals, *levels)),
        trajectories=end_to_end(submission.manifest.name, track, names, protocol_.pips, *joined),
        sandbox=runner.sandbox,
        timing={
            "seconds": time.perf_counter() - started,
            "act_median_us": 1e6 * float(np.median(run.act_seconds)),
            "act_max_us": 1e6 * float(np.max(run.act_seconds)),
        },
    )


def enter(
    submission: Submission, track: str | None, lungs: Sequence[str], runner: Runner
) -> tuple[str, list[Task]]:
    """Say what a submission is told of each lung on a track, which is the manifest's first if None.

    Returns:
        The track, and a task for each lung.

    Raises:
        SubmissionError: if it does not enter the track, or the runner cannot run it.
    """
    if submission.controller is not None and runner.sandbox is not None:
        raise SubmissionError(f"{submission.label}: only a folder can run in a sandbox")
    entered = submission.manifest.tracks
    track = track or entered[0]
    if track not in TRACKS:
        raise InputError(f"track is {track!r}; choose {' or '.join(TRACKS)}")
    if track not in entered:
        raise SubmissionError(
            f"{submission.label}: submission.toml, key tracks: enters {', '.join(entered)}; "
            f"it cannot be scored for {track}"
        )
    named = track == "performance"
    return track, [
        Task(track, name if named else None, protocol.DT, protocol.INSPIRATION_STEPS)
        for name in lungs
    ]


def runs_of(
    run: ProtocolRun, cells: Cells, submission: Submission | None = None, tasks: Sequence[Task] = ()
) -> Runs:
    """Figures of a run of cells, batch shape ``(S, L, n, P)``; a task for each lung.

    Without a submission failures have no messages.
    """
    pip, dt = (
        np.broadcast_to(np.asarray(x), cells.pips.shape)
        for x in (cells.scenario.pip, cells.scenario.dt)
    )
    by_breath = pip[..., None], dt[..., None]
    safe = np.all(passes_safety_gate(run.breaths, *by_breath), axis=-1)
    plateau = steady_error(run.pressure[..., -1, :], pip)
    error = run_error(run.pressure, pip[..., None, None])
    survived = safe & (plateau <= PLATEAU_TOLERANCE + PLATEAU_SHARE * pip)
    for cell in run.failures:  # a controller that ended gave no command to be safe with
        error[cell], plateau[cell] = np.nan, np.nan
        safe[cell] = survived[cell] = False
    lungs = tuple(lung.id for lung in cells.lungs)
    count, (draws, pips) = len(lungs), cells.pips.shape[1:]

    def flat(values: Any) -> Any:
        return values.reshape(len(cells.conditions), count, draws * pips, *values.shape[4:])

    return Runs(
        conditions=cells.conditions,
        lungs=lungs,
        pips=cells.pips.reshape(count, -1),
        rig=np.repeat(cells.rig, pips, axis=1),
        member=np.repeat(cells.member, pips, axis=1),
        error=flat(error),
        safe=flat(safe),
        survived=flat(survived),
        alarm_s=flat(time_above_alarm(run.pressure, *by_breath).max(axis=-1)),
        peak=flat(run.pressure.max(axis=(-2, -1))),
        volume=flat(run.volume[..., protocol.SCORED_BREATHS, -1].mean(axis=-1)),
        draw=np.repeat(cells.draw, pips),
        plateau_error=flat(plateau),
        requested=flat(run.requested),
        failures=[
            CellFailure(
                *cells.name(at), failure, failure.message(submission.label, tasks[at[1]].lung)
            )
            for at, failure in sorted(run.failures.items())
            if submission is not None
        ],
    )
