"""Protocol version 2: nominal cells on each lung's reference rig, draws on all of its rigs.

Scored is the airway pressure; controllers see readings of the sensor.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ventbench import precision, protocol, rig_draws, seasons
from ventbench.environment import Scenario
from ventbench.errors import InputError
from ventbench.headroom.reference import Reference, reference_of
from ventbench.interfaces import Plant
from ventbench.lungs import LUNGS, Lung
from ventbench.metrics.score import controllable_error
from ventbench.plants import frozen
from ventbench.plants.catalog import Given, load_simulators
from ventbench.rig_draws import RigDraws
from ventbench.submissions.assembly import assemble, enter
from ventbench.submissions.folder import Submission
from ventbench.submissions.result import Score
from ventbench.submissions.runner import InProcessRunner, Runner
from ventbench.submissions.stepping import as_float64, replay, step_through


@dataclass(frozen=True, eq=False)
class Rigs:
    """Plants of lungs, each on one or several rigs.

    Attributes:
        lungs: L of them.
        plants: leaves ``(members, sessions, ...)`` where :attr:`sessions` says which are scored;
            leaves ``(L, ...)`` where each lung has one rig only.
        sessions: scored sessions of each lung, the reference rig first; None for one rig each.
        about: version and hashes, for the result.
        sha256: of the manifest of the frozen simulators; None for others.
        held_out: for each lung the scored session that no entry of ours was trained on, or None.
    """

    lungs: tuple[Lung, ...]
    plants: Plant
    sessions: tuple[tuple[int, ...], ...] | None
    about: Mapping[str, Any]
    sha256: str | None = None
    held_out: tuple[int | None, ...] = ()

    @property
    def members(self) -> int:
        """Number of members of the ensemble."""
        return 1 if self.sessions is None else jax.tree.leaves(self.plants)[0].shape[0]

    def draws(self, n: int, pips: Sequence[float] = protocol.PIPS) -> RigDraws:
        """Return the first n development draws of these rigs at some of the protocol's PIPs."""
        sessions = self.sessions or tuple((0,) for _ in self.lungs)
        return rig_draws.build(sessions, self.members, pips=pips).first(n)

    def cells(self, drawn: RigDraws | None, pips: Sequence[float]) -> tuple[Plant, Scenario]:
        """Nominal cells in front of draws, and their plants.

        Args:
            drawn: K draws; None for none.
            pips: cmH2O, length P.

        Returns:
            Plants with leaves ``(L, 1 + K, 1, ...)``, or ``(L, ...)`` where each lung has one rig;
            cells of batch shape ``(L, 1 + K, P)``.
        """
        reference = [own[0] for own in self.sessions] if self.sessions else [0] * len(self.lungs)
        cells, rig, member = rig_draws.with_nominal(drawn, reference, pips)
        if self.sessions is None:
            return self.plants, cells
        return rig_draws.plants_of(self.plants, rig, member), cells


def load_rigs(simulator: Given = "frozen") -> Rigs:
    """Load simulators for protocol version 2.

    Args:
        simulator: ``"frozen"`` for the official rigs; else see :func:`ventbench.load_simulators`:
            each lung then has one rig.

    Raises:
        InputError: if there are no such simulators, or they have no plants.
    """
    if isinstance(simulator, str) and simulator == "frozen":
        return rigs_of(frozen.load())
    simulators = load_simulators(simulator)
    return Rigs(simulators.lungs, simulators.stacked, None, simulators.about)


def rigs_of(official: Any) -> Rigs:
    """Rigs of a set of simulators, such as :func:`ventbench.plants.frozen.load` returns."""
    return Rigs(
        LUNGS,
        official.sessions_plants,
        official.rigs,
        official.about(),
        official.manifest_sha256,
        official.held_out_rigs,
    )


def season_draws(rigs: Rigs, season: Path | None, seed: Path | None = None) -> RigDraws:
    """Return the draws of a season.

    Args:
        rigs: that are drawn.
        season: its file; the development draws if not given.
        seed: file of its secret seed; not needed once the season is revealed.

    Raises:
        InputError: if the season is of another protocol, or its seed is needed and not the one of
            its commitment.
    """
    if season is None:
        return rigs.draws(rig_draws.COUNT)
    about = seasons.read_season(season)
    if about.protocol != rig_draws.VERSION:
        raise InputError(f"{season}, key protocol: {about.protocol} is not {rig_draws.VERSION}")
    secret = about.revealed
    if secret is None:
        if seed is None:
            raise InputError(f"{season} is not revealed yet: give its seed with --seed FILE")
        secret = seasons.read_seed(seed)
        seasons.require_seed(about, secret)
    sessions = rigs.sessions or tuple((0,) for _ in rigs.lungs)
    return rig_draws.build(sessions, rigs.members, seed=secret, season=about.id, n=about.draws)


def run_on_rigs(
    submission: Submission,
    rigs: Rigs,
    *,
    track: str | None = None,
    draws: int = 0,
    drawn: RigDraws | None = None,
    reference: Reference | None = None,
    pips: Sequence[float] = protocol.PIPS,
    runner: Runner | None = None,
) -> Score:
    """Score a submission by protocol version 2.

    Args:
        submission: from :func:`ventbench.submissions.folder.open_submission`.
        rigs: from :func:`load_rigs`.
        track: ``"performance"`` or ``"robustness"``; the manifest's first if not given.
        draws: how many of the development draws to run besides the nominal cells.
        drawn: other draws instead, such as those of a season.
        reference: best attainable and best PID of these simulators and draws; the published one if
            not given and it is of these.
        pips: cmH2O.
        runner: runs the controllers; in this process if not given.

    Raises:
        SubmissionError: if the submission cannot be run at all, or does not enter the track.
        InputError: if there are no such draws, or the reference is of others.
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
        run = step_through(plants, cells, runner, submission, tasks, version=2)
        nominal = jax.tree.map(lambda x: x[:, 0], cells)
        own = plants
        if rigs.sessions is not None:
            own = jax.tree.map(lambda leaf: leaf[:, 0, 0], plants)
        replayed = replay(own, nominal, run.requested[:, 0], version=2)
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
        draws_sha256=None if drawn is None else drawn.commitment,
        protocol=2,
        rig_draws=drawn,
        controllable=controllable,
        reference=reference,
    )
