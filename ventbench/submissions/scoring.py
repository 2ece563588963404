"""Scoring a submission: the nominal cells, the published draws, the safety gate."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench import draws as published
from ventbench import environment, precision, protocol
from ventbench.environment import Scenario
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.lungs import LUNGS, Lung
from ventbench.plants import frozen
from ventbench.plants.catalog import Given, load_simulators
from ventbench.plants.hybrid import Hybrid
from ventbench.submissions import rig_scoring
from ventbench.submissions.assembly import assemble, enter
from ventbench.submissions.folder import Submission, as_submission
from ventbench.submissions.result import Score
from ventbench.submissions.runner import (
    CountingRunner,
    InProcessRunner,
    Progress,
    Runner,
    runner_of,
)
from ventbench.submissions.stepping import as_float64, replay, step_through

Floats = NDArray[np.float64]


def score(
    submission: Any,
    *,
    simulator: Given = "frozen",
    track: str | None = None,
    draws: int = 0,
    sandbox: bool = True,
    protocol: int = 1,
    progress: Progress | None = None,
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
        protocol: version of the protocol. Version 2 scores airway pressure, draws on the rigs of
            each lung, and adds the normalised score.
        progress: called after each round of commands with rounds done and all rounds.

    Returns:
        The score; ``print`` and notebooks show one row a lung.

    Raises:
        SubmissionError: if there is no such submission, it cannot be run at all, or it does not
            enter the track.
        SandboxError: if this machine cannot run submissions apart.
        InputError: if there are no such simulators, draws or protocol.
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
    if protocol == 2:
        rigs = rig_scoring.load_rigs(simulator)
        return rig_scoring.run_on_rigs(entry, rigs, track=track, draws=draws, runner=runner)
    if protocol != 1:
        raise InputError(f"protocol {protocol} is not known; the versions are 1 and 2")
    simulators = load_simulators(simulator)
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
    names, pips = tuple(lung.id for lung in lungs), tuple(float(pip) for pip in pips)
    track, tasks = enter(submission, track, names, runner)
    with precision.float64():
        plants = as_float64(plants, len(names))
        frozen_sha256 = _frozen_sha256(plants)
        cells = protocol_cells(pips, draws)
        run = step_through(plants, cells, runner, submission, tasks, version=1)
        nominal = jax.tree.map(lambda x: x[0], cells)
        replayed = replay(plants, nominal, run.requested[:, 0], version=1)
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
        simulators=simulators,
        frozen_sha256=frozen_sha256,
        draws_sha256=published.SHA256 if draws else None,
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
