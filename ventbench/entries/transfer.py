"""How an entry does away from where it was tuned: other members, other rigs, a rig set aside.

Without noise, on every plant of the frozen simulators: the reference rig of each lung;
the same rig as the other members of the ensemble have it; the lung's other rigs; and the rig that
no entry of ours was trained on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench.base import precision
from ventbench.base.errors import InputError
from ventbench.entries.assembly import enter
from ventbench.entries.folder import Submission
from ventbench.entries.runner import InProcessRunner, Runner
from ventbench.entries.stepping import as_float64, step_through
from ventbench.plants.rigs import Rigs
from ventbench.task import draws, protocol
from ventbench.task.metrics.score import run_error

#: Where an entry is tried, in the order of the table.
GROUPS = ("reference rig", "other members", "other rigs", "held-out rig")

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Transfer:
    """Errors of one entry; L lungs.

    Attributes:
        name: of the submission.
        track: ``"performance"`` or ``"robustness"``.
        lungs: ids.
        errors: by group, mean error over its plants and the PIPs, cmH2O, shape ``(L,)``; NaN where
            a lung has no such plant or the controller failed.
        plants: by group, number of plants of each lung, shape ``(L,)``.
    """

    name: str
    track: str
    lungs: tuple[str, ...]
    errors: dict[str, Floats]
    plants: dict[str, NDArray[np.int64]]

    def mean(self, group: str) -> float:
        """Mean over the lungs that have such plants, cmH2O; NaN if the controller failed there."""
        own = self.errors[group][self.plants[group] > 0]
        return float(own.mean()) if own.size else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Values of the table, with null where there is none."""

        def number(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        return {
            "name": self.name,
            "track": self.track,
            "groups": {
                group: {
                    "error_cmH2O": number(self.mean(group)),
                    "plants": int(self.plants[group].sum()),
                    "lungs": {
                        lung: number(error)
                        for lung, error in zip(self.lungs, self.errors[group], strict=True)
                    },
                }
                for group in GROUPS
            },
        }


def transfer(
    submission: Submission, rigs: Rigs, *, track: str | None = None, runner: Runner | None = None
) -> Transfer:
    """Run an entry on all plants of all scored rigs, without noise.

    Args:
        submission: from :func:`ventbench.entries.folder.open_submission`.
        rigs: from :func:`ventbench.plants.rigs.load_rigs`.
        track: ``"performance"`` or ``"robustness"``; the manifest's first if not given.
        runner: runs the controllers; in this process if not given.

    Raises:
        SubmissionError: if the submission cannot be run, or does not enter the track.
        InputError: if each lung has one rig only.
    """
    if rigs.sessions is None:
        raise InputError("these simulators have one rig a lung: there is nothing to transfer to")
    runner = runner or InProcessRunner()
    names = tuple(lung.id for lung in rigs.lungs)
    track, tasks = enter(submission, track, names, runner)
    wanted = [_places(rigs, lung) for lung in range(len(names))]
    # Lungs with fewer plants run their first one again, so that all fit into one array.
    most = max(map(len, wanted))
    padded = [places + [places[0]] * (most - len(places)) for places in wanted]
    rig = np.array([[place[1] for place in places] for places in padded])
    member = np.array([[place[2] for place in places] for places in padded])
    with precision.float64():
        cells, _, _ = draws.with_nominal(None, rig[:, 0].tolist(), protocol.PIPS)
        cells = jax.tree.map(lambda x: np.repeat(x, most, axis=1), cells)
        plants = as_float64(draws.plants_of(rigs.plants, rig, member), len(names))
        run = step_through(plants, cells, runner, submission, tasks)
    errors = run_error(run.pressure, np.asarray(cells.pip)[..., None, None])
    for cell in run.failures:
        errors[cell] = np.nan
    groups: dict[str, Floats] = {}
    counts: dict[str, NDArray[np.int64]] = {}
    for group in GROUPS:
        at = [[k for k, place in enumerate(places) if place[0] == group] for places in wanted]
        counts[group] = np.array([len(own) for own in at])
        means = [errors[i, own].mean() if own else np.nan for i, own in enumerate(at)]
        groups[group] = np.array(means)
    return Transfer(submission.manifest.name, track, names, groups, counts)


def _places(rigs: Rigs, lung: int) -> list[tuple[str, int, int]]:
    """Group, session and member of every plant of a lung, the reference first."""
    assert rigs.sessions is not None
    reference, *others = rigs.sessions[lung]
    apart = rigs.held_out[lung] if rigs.held_out else None
    places = [(GROUPS[0], reference, 0)]
    places += [(GROUPS[1], reference, member) for member in range(1, rigs.members)]
    places += [(GROUPS[2], rig, 0) for rig in others if rig != apart]
    return places + [(GROUPS[3], rig, 0) for rig in others if rig == apart]
