"""Scoring a submission: nominal cells on each lung's reference rig, draws on all of its rigs.

Scored is the airway pressure; controllers see readings of the sensor.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ventbench.base import precision
from ventbench.base.errors import InputError
from ventbench.entries.assembly import assemble, enter
from ventbench.entries.folder import Submission, as_submission
from ventbench.entries.result import Score
from ventbench.entries.runner import (
    CountingRunner,
    InProcessRunner,
    Progress,
    Runner,
    runner_of,
)
from ventbench.entries.stepping import as_float64, replay, step_through
from ventbench.headroom.reference import Reference, reference_of
from ventbench.plants.catalog import Given
from ventbench.plants.rigs import Rigs, load_rigs
from ventbench.task import protocol
from ventbench.task.draws import Draws
from ventbench.task.metrics.score import controllable_error


def score(
    submission: Any,
    *,
    simulator: Given = "frozen",
    track: str | None = None,
    draws: int = 0,
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
        sandbox: run a folder in locked-down processes. Without it, its code runs in this process
            with all rights: only for code that you trust, and never official.
        progress: called after each round of commands with rounds done and all rounds.

    Returns:
        The score; ``print`` and notebooks show one row a lung.

    Raises:
        SubmissionError: if there is no such submission, it cannot be run at all, or it does not
            enter the track.
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
    runner: Runner = runner_of(entry, sandbox=sandbox)
    if progress is not None:
        runner = CountingRunner(runner, progress)
    return run_protocol(entry, load_rigs(simulator), track=track, draws=draws, runner=runner)


def run_protocol(
    submission: Submission,
    rigs: Rigs,
    *,
    track: str | None = None,
    draws: int = 0,
    drawn: Draws | None = None,
    reference: Reference | None = None,
    pips: Sequence[float] = protocol.PIPS,
    runner: Runner | None = None,
) -> Score:
    """Run a submission through the protocol, on any rigs and by any runner.

    Args:
        submission: from :func:`ventbench.entries.folder.open_submission`.
        rigs: from :func:`ventbench.plants.rigs.load_rigs`.
        track: ``"performance"`` or ``"robustness"``; the manifest's first if not given.
        draws: how many of the development draws to run besides the nominal cells.
        drawn: other draws instead.
        reference: best attainable and best PID of these simulators and draws; the published one if
            not given and it is of these.
        pips: cmH2O.
        runner: runs the controllers; in this process if not given.

    Raises:
        SubmissionError: if the submission cannot be run at all, or does not enter the track.
        InputError: if there are no such draws, or the reference is of others.
        ValueError: if the plants are not those of the lungs.
        FloatingPointError: if a plant answers with NaN or infinity.
    """
    started = time.perf_counter()
    runner = runner or InProcessRunner()
    names, pips = tuple(lung.id for lung in rigs.lungs), tuple(float(pip) for pip in pips)
    track, tasks = enter(submission, track, names, runner)
    if drawn is None and draws:
        drawn = rigs.draws(draws, pips)
    elif draws < 0:
        raise InputError(f"{draws} draws: there cannot be fewer than none")
    if pips == protocol.PIPS:
        about = None if drawn is None else drawn.about()
        reference = reference_of(rigs.about, about, reference)
    with precision.float64():
        plants, cells = rigs.cells(drawn, pips)
        plants = as_float64(plants, len(names))
        run = step_through(plants, cells, runner, submission, tasks)
        nominal = jax.tree.map(lambda x: x[:, 0], cells)
        own = plants
        if rigs.sessions is not None:
            own = jax.tree.map(lambda leaf: leaf[:, 0, 0], plants)
        replayed = replay(own, nominal, run.requested[:, 0])
    pip = np.asarray(cells.pip)[..., None, None]
    controllable = controllable_error(run.pressure, pip)
    for cell in run.failures:
        controllable[cell] = np.nan
    return assemble(
        submission,
        tasks,
        names,
        pips,
        cells,
        run,
        replayed,
        seconds=time.perf_counter() - started,
        sandbox=runner.sandbox,
        simulators=rigs.about,
        frozen_sha256=rigs.sha256,
        rig_draws=drawn,
        controllable=controllable,
        reference=reference,
    )
