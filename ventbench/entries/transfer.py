"""How an entry does away from where it was tuned: other members, other rigs, a rig set aside.

Without noise, on every plant of the frozen simulators: the reference rig of each lung;
the same rig as the other members of the ensemble have it; the lung's other rigs; and the rig that
no entry of ours was trained on.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ventbench.base import precision
from ventbench.base.errors import InputError
from ventbench.entries.cells import Cells
from ventbench.entries.folder import Submission
from ventbench.entries.runner import InProcessRunner, Runner
from ventbench.entries.runs import Runs, number
from ventbench.entries.scoring import enter, runs_of
from ventbench.entries.stepping import run_cells
from ventbench.plants.rigs import Rigs
from ventbench.task import draws, protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.stressors import Condition

#: Where an entry is tried, in the order of the table.
GROUPS = ("reference rig", "other members", "other rigs", "held-out rig")


def transfer(
    submission: Submission, rigs: Rigs, *, track: str | None = None, runner: Runner | None = None
) -> Runs:
    """Run an entry on all plants of all scored rigs, without noise.

    Args:
        submission: from :func:`ventbench.entries.folder.open_submission`.
        rigs: from :func:`ventbench.plants.rigs.load_rigs`.
        track: ``"performance"`` or ``"robustness"``; the manifest's first if not given.
        runner: runs the controllers; in this process if not given.

    Returns:
        Figures of all PIPs on all plants; where a lung has fewer than another, its reference runs
        again in their place.

    Raises:
        SubmissionError: if the submission cannot be run, or does not enter the track.
        InputError: if each lung has one rig only.
    """
    if rigs.sessions is None:
        raise InputError("these simulators have one rig a lung: there is nothing to transfer to")
    runner = runner or InProcessRunner()
    track, tasks = enter(submission, track, tuple(lung.id for lung in rigs.lungs), runner)
    most = rigs.members - 1 + max(map(len, rigs.sessions))
    places = []
    for own in rigs.sessions:
        every = [(own[0], member) for member in range(rigs.members)]
        every += [(rig, 0) for rig in own[1:]]
        places.append(every + [every[0]] * (most - len(every)))
    rig, member = np.moveaxis(np.array(places), -1, 0)
    pips = np.broadcast_to(np.array(protocol.PIPS), (*rig.shape, len(protocol.PIPS)))
    with precision.float64():
        plants = draws.plants_of(rigs.plants, rig, member)
        scenario, every = nominal_scenario(pips), np.zeros(most, np.int64)
        cells = Cells(rigs.lungs, (Condition(),), plants, scenario, pips, every, rig, member)
        run = run_cells(cells, runner, submission, tasks)
    return dataclasses.replace(runs_of(run, cells, submission, tasks), requested=None)


def by_group(runs: Runs, rigs: Rigs) -> dict[str, Any]:
    """Errors of an entry by group and lung, as JSON values.

    Args:
        runs: from :func:`transfer`.
        rigs: on which it ran.

    Returns:
        For each of :data:`GROUPS` the mean over the lungs that have such plants, the number of
        plants, and the mean of each lung over its plants and the PIPs; null where a lung has no
        such plant or the controller failed. cmH2O.
    """
    table = runs.to_frame().drop_duplicates(["lung", "pip_cmH2O", "rig", "member"])
    assert rigs.sessions is not None
    reference = {lung: own[0] for lung, own in zip(runs.lungs, rigs.sessions, strict=True)}
    apart = dict(zip(runs.lungs, rigs.held_out, strict=False))
    at_home = table.rig == table.lung.map(reference)
    kinds = [at_home & (table.member == 0), at_home, table.rig != table.lung.map(apart)]
    table["group"] = np.select(kinds, GROUPS[:3], GROUPS[3])
    groups = {}
    for group in GROUPS:
        own = table[table.group == group].groupby("lung", sort=False).error_cmH2O
        lungs = own.agg(lambda errors: errors.mean(skipna=False))
        groups[group] = {
            "error_cmH2O": number(lungs.mean(skipna=False)),
            "plants": int(own.size().sum()) // len(protocol.PIPS),
            "lungs": {lung: number(lungs.get(lung, np.nan)) for lung in runs.lungs},
        }
    return groups
