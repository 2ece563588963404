"""The official score: a maintainer names a submission and a commit, and gets records.

Scorer and simulators are those of the branch that this file lies on; of the commit, only the plain
files of ``submissions/NAME/`` are taken, and their code runs in the sandbox alone. Every track is
scored twice, and both runs must give the same commands to the bit.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ci import workflow
from ci.take import TakeError, Taken, take
from ventbench.base.errors import InputError
from ventbench.board import create
from ventbench.board.replay import ReplayPlants
from ventbench.entries import contract
from ventbench.entries.folder import open_submission
from ventbench.entries.manifest import TRACKS
from ventbench.entries.reference import Reference
from ventbench.entries.runner import Runner
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import rigs_of
from ventbench.task import draws as draw_tables

TITLE = "Official score"


def tracks(wanted: str, entered: Sequence[str]) -> list[str]:
    """Tracks to score.

    Args:
        wanted: ``"all"`` or one of them.
        entered: by the manifest.

    Raises:
        InputError: if the submission does not enter it.
    """
    if wanted == "all":
        return list(entered)
    if wanted not in TRACKS or wanted not in entered:
        raise InputError(f"track {wanted!r}: the submission enters {', '.join(entered)}")
    return [wanted]


def score_taken(
    taken: Taken,
    source: str,
    wanted: str,
    simulators: ReplayPlants,
    runner: Runner,
    out: Path,
    reference: Reference | None = None,
) -> list[str]:
    """Check and score a submission twice, and write a record for each track.

    Args:
        taken: from its commit.
        source: URL of the repository, for the record.
        wanted: track, or ``"all"``.
        simulators: the frozen ones.
        runner: the sandbox.
        out: folder for the records and their commands.
        reference: best attainable and best PID of the draws; the published ones if not given.

    Returns:
        Lines for the maintainer.

    Raises:
        InputError: if it is not ready, a second run gives other commands, or a score does not
            replay.
    """
    report = contract.check(str(taken.folder), runner)
    lines = [line.replace(str(taken.folder), taken.name) for line in report.lines()]
    if not report.ok:
        raise TakeError(*lines)
    submission = open_submission(str(taken.folder))
    if submission.manifest.name != taken.name:
        raise TakeError(f"submission.toml calls it {submission.manifest.name}, not {taken.name}")
    rigs = rigs_of(simulators)
    where = {"repository": source, "commit": taken.commit, "tree": taken.tree}
    for track in tracks(wanted, submission.manifest.tracks):
        result, again = (
            run_protocol(
                submission, rigs, track=track, draws=draw_tables.COUNT, reference=reference,
                runner=runner,
            )
            for _ in range(2)
        )  # fmt: skip
        if result.requested.tobytes() != again.requested.tobytes():
            apart = (result.requested != again.requested).any(axis=(-2, -1)).sum()
            raise TakeError(
                f"{taken.name}: {track}: a second run gave other commands in {apart} cells; "
                "an official score must be reproducible to the bit"
            )
        path = create.create(result, simulators, source=where).save(out)
        lines.append(f"{taken.name}: {track}: {result.score:.3f} cmH2O nominal; {path.name}")
        if result.not_official_because:
            lines.append(f"{taken.name}: not official: {'; '.join(result.not_official_because)}")
        failed = [failure.message for failure in result.failures[:3]]
        lines += [message.replace(str(taken.folder), taken.name) for message in failed]
    return lines


def main() -> int:
    """Score what the environment names; see ``score-official.yml``."""
    from ventbench.plants import frozen
    from ventbench.sandbox.runner import SandboxRunner

    source, out = workflow.required("SOURCE"), Path(workflow.required("OUT"))
    wanted = workflow.required("TRACK")
    base, commit, name = (workflow.required(key) for key in ("BASE", "COMMIT", "NAME"))
    runner = SandboxRunner(require_official=True)
    with tempfile.TemporaryDirectory() as folder:
        taken = take(source, base, commit, name, Path(folder))
        lines = score_taken(taken, source, wanted, frozen.load(), runner, out)
    workflow.summary(TITLE, lines)
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
