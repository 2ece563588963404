"""Scoring a submission: the nominal cells, the published draws, the safety gate."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench import draws as published
from ventbench import environment, precision, protocol
from ventbench.environment import Scenario
from ventbench.interfaces import Plant, Task
from ventbench.lungs import LUNGS, Lung
from ventbench.metrics.figures import InspirationSignals, figures
from ventbench.metrics.score import passes_safety_gate, run_error
from ventbench.plants import frozen
from ventbench.plants.catalog import Given, load_simulators
from ventbench.plants.hybrid import Hybrid
from ventbench.submissions.errors import SubmissionError
from ventbench.submissions.folder import Submission, open_submission, submission_of
from ventbench.submissions.result import CellFailure, Score
from ventbench.submissions.runner import InProcessRunner, Runner
from ventbench.submissions.stepping import ProtocolRun, as_float64, replay, step_through
from ventbench.trajectories import end_to_end

Floats = NDArray[np.float64]


def score(
    submission: Any,
    *,
    simulator: Given = "frozen",
    track: str | None = None,
    draws: int = 0,
    sandbox: bool = True,
) -> Score:
    """Score a controller on the lungs of a set of simulators.

    Lower is better: mean |pressure - target| over the inspirations, cmH2O.

    Args:
        submission: folder of a submission, the name of a bundled one, a class with ``reset(task)``
            and ``act(observation)``, or a function from an observation to ``u_in``, %. Classes and
            functions run in this process.
        simulator: simulators with plants; see :func:`ventbench.load_simulators`.
        track: ``"performance"`` (the controller is told the lung) or ``"robustness"``; the first
            that the submission enters if not given.
        draws: how many of the 20 published draws to run besides the nominal cells.
        sandbox: run a folder in locked-down processes. Without it, its code runs in this process
            with all rights: only for code that you trust, and never official.

    Returns:
        The score; ``print`` and notebooks show one row a lung.

    Raises:
        SubmissionError: if there is no such submission, it cannot be run at all, or it does not
            enter the track.
        SandboxError: if this machine cannot run submissions apart.
        InputError: if there are no such simulators or draws.
        FloatingPointError: if a plant answers with NaN or infinity.

    Example:
        >>> from ventbench import score
        >>> def proportional(observation):
        ...     return 5.0 + 2.0 * (observation.target - observation.pressure)
        >>> result = score(proportional, simulator="physics")
        >>> result.official
        False
    """
    runner: Runner = InProcessRunner()
    if isinstance(submission, Submission):
        entry = submission
    elif isinstance(submission, str | Path):
        entry = open_submission(str(submission))
    else:
        entry = submission_of(submission)
    simulators = load_simulators(simulator)
    if sandbox and entry.controller is None:
        from ventbench.sandbox.runner import SandboxRunner

        runner = SandboxRunner()
    return run_protocol(
        entry,
        simulators.stacked,
        track=track,
        draws=draws,
        lungs=simulators.lungs,
        runner=runner,
        simulators=simulators.about,
    )


def run_protocol(
    submission: Submission,
    plants: Plant,
    *,
    track: str | None = None,
    draws: int = 0,
    lungs: Sequence[Lung] = LUNGS,
    pips: Sequence[float] = protocol.PIPS,
    runner: Runner | None = None,
    simulators: Mapping[str, Any] | None = None,
) -> Score:
    """Run a submission through the protocol, on any stacked plants and by any runner.

    Args:
        submission: from :func:`ventbench.submissions.folder.open_submission`.
        plants: one plant, stacked over the lungs on the leading axis of every leaf.
        track: ``"performance"`` or ``"robustness"``; the manifest's first if not given.
        draws: how many of the published draws to run besides the nominal cells, 0..20.
        lungs: those of ``plants``, in their order.
        pips: cmH2O.
        runner: runs the controllers; in this process if not given.
        simulators: what is known of the plants (version, hashes), to be written into the result.

    Raises:
        SubmissionError: if the submission cannot be run at all, or does not enter the track.
        InputError: if there are no such draws.
        ValueError: if the plants are not stacked over the lungs.
        FloatingPointError: if a plant answers with NaN or infinity.
    """
    started = time.perf_counter()
    runner = runner or InProcessRunner()
    if submission.controller is not None and runner.sandbox is not None:
        raise SubmissionError(f"{submission.label}: only a folder can run in a sandbox")
    entered = submission.manifest.tracks
    track = track or entered[0]
    if track not in entered:
        raise SubmissionError(
            f"{submission.label}: submission.toml, key tracks: enters {', '.join(entered)}; "
            f"it cannot be scored for {track}"
        )
    names, pips = tuple(lung.id for lung in lungs), tuple(float(pip) for pip in pips)
    known = track == "performance"
    tasks = [
        Task(track, name if known else None, protocol.DT, protocol.INSPIRATION_STEPS)
        for name in names
    ]
    with precision.float64():
        plants = as_float64(plants, len(names))
        frozen_sha256 = _frozen_sha256(plants)
        cells = protocol_cells(pips, draws)
        run = step_through(plants, cells, runner, submission, tasks)
        nominal = jax.tree.map(lambda x: x[0], cells)
        inspired, expired = replay(plants, nominal, run.requested[:, 0])

    # The expiration of the last breath is run for the picture only; no score depends on either.
    joined = [
        np.concatenate([getattr(inspired, name), getattr(expired, name)], axis=-1)
        for name in ("pressure", "u_in")
    ]
    trajectories = end_to_end(submission.manifest.name, track, names, pips, *joined)

    timing = {
        "seconds": time.perf_counter() - started,
        "act_median_us": 1e6 * float(np.median(run.act_seconds)),
        "act_max_us": 1e6 * float(np.max(run.act_seconds)),
    }
    pip = cells.pip[..., None]  # the target of every inspiratory step
    errors = run_error(run.pressure, pip[..., None])
    for cell in run.failures:
        errors[cell] = np.nan
    requested = run.requested[:, 0]
    return Score(
        submission=submission,
        track=track,
        lungs=names,
        pips=pips,
        nominal=errors[:, 0],
        drawn=np.moveaxis(errors[:, 1:], 1, 0),
        safe=np.all(passes_safety_gate(run.pressure, pip, cells.dt[..., None]), axis=(1, 2, 3)),
        peak=run.pressure.max(axis=(1, 2, 3, 4)),
        figures=_figures(run, cells),
        below=np.sum(requested < 0.0, axis=(1, 2, 3)),
        above=np.sum(requested > protocol.U_MAX, axis=(1, 2, 3)),
        commands=requested[0].size,
        failures=_failures(run, submission, tasks, names, pips),
        requested=run.requested,
        sandbox=runner.sandbox,
        simulators=simulators,
        frozen_sha256=frozen_sha256,
        draws_sha256=published.SHA256 if draws else None,
        trajectories=trajectories,
        timing=timing,
    )


def _frozen_sha256(plants: Plant) -> str | None:
    """SHA-256 of the frozen simulators' manifest if float64 plants are exactly those, else None."""
    if type(plants) is not Hybrid:
        return None
    official = frozen.load()
    leaves, wanted = jax.tree.leaves(plants), jax.tree.leaves(official.plants)
    same = all(map(np.array_equal, leaves, (np.asarray(leaf, np.float64) for leaf in wanted)))
    return official.manifest_sha256 if same else None


def protocol_cells(pips: tuple[float, ...], draws: int) -> Scenario:
    """Nominal cells and draws, batch shape ``(1 + draws, P)``."""
    # In numpy: each eager JAX operation would compile a kernel of its own.
    cells = jax.tree.map(
        lambda x: np.asarray(x)[None], environment.nominal_scenario(np.asarray(pips))
    )
    if draws == 0:
        return cells
    return jax.tree.map(lambda *x: np.concatenate(x), cells, published.scenarios(pips, draws))


def _figures(run: ProtocolRun, cells: Scenario) -> dict[str, Floats]:
    """Secondary figures of the scored nominal inspirations, shape ``(L, P, scored breaths)``."""
    pressure, u_in, requested = (
        x[:, 0][:, :, protocol.SCORED_BREATHS, :] for x in (run.pressure, run.u_in, run.requested)
    )
    peep, pip, dt = (np.asarray(x)[0, :, None] for x in (cells.peep, cells.pip, cells.dt))
    return figures(InspirationSignals(pressure, u_in, requested, peep, pip, dt))


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
