"""The official score: a maintainer names a submission and a commit, and gets records.

Scorer and simulators are those of the branch that this file lies on; of the commit, only the plain
files of ``submissions/NAME/`` are taken, and their code runs in the sandbox alone. Every track is
scored twice, and both runs must give the same commands to the bit.

On the hidden draws of a season the record is sealed at once, and nothing else of the runs is said:
no message of a submission, no number of cells, no error of one; all of them can carry draws.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ventbench.submissions.rig_scoring import rigs_of, run_on_rigs

from ci import seed as seeds
from ci import workflow
from ci.take import TakeError, Taken, take
from ventbench import draws, protocol, rig_draws
from ventbench.board import create, record, sealed
from ventbench.board.replay import ReplayPlants
from ventbench.errors import InputError
from ventbench.headroom.reference import Reference
from ventbench.seasons import Season
from ventbench.submissions import contract
from ventbench.submissions.folder import Submission, open_submission
from ventbench.submissions.manifest import TRACKS
from ventbench.submissions.result import Score
from ventbench.submissions.runner import Runner
from ventbench.submissions.scoring import run_protocol

TITLE = "Official score"


@dataclass(frozen=True)
class Hidden:
    """What a score on hidden draws needs.

    Attributes:
        season: whose draws they are.
        seed: of the season.
        reference: best attainable and best PID of the draws; None in protocol version 1.
    """

    season: Season
    seed: bytes
    reference: Reference | None = None


def hidden_draws(season: str, seed_file: Path, leaderboard: Path) -> Hidden:
    """Read what the season's hidden draws need; the file of the seed is deleted.

    Args:
        season: id.
        seed_file: of :mod:`ci.seed`.
        leaderboard: folder with the files of the season.

    Raises:
        InputError: if it is not the seed of the season, or there are no reference errors of it.
    """
    known, seed = seeds.take_over(season, seed_file, leaderboard)
    if known.protocol == 1:
        return Hidden(known, seed)
    return Hidden(known, seed, sealed.open_reference(leaderboard, known, seed))


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
    hidden: Hidden | None = None,
) -> list[str]:
    """Check and score a submission twice, and write a record for each track.

    Args:
        taken: from its commit.
        source: URL of the repository, for the record.
        wanted: track, or ``"all"``.
        simulators: the frozen ones.
        runner: the sandbox.
        out: folder for the records and their commands.
        hidden: what hidden draws need; published draws if not given.

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
    if hidden is not None and hidden.season.protocol not in protocol.VERSIONS:
        raise InputError(
            f"season {hidden.season.id} is of protocol version {hidden.season.protocol}; this "
            f"ventbench scores versions {', '.join(map(str, protocol.VERSIONS))}"
        )
    where = {"repository": source, "commit": taken.commit, "tree": taken.tree}
    for track in tracks(wanted, submission.manifest.tracks):
        result, again = (_scored(submission, track, simulators, runner, hidden) for _ in range(2))
        if result.requested.tobytes() != again.requested.tobytes():
            apart = (result.requested != again.requested).any(axis=(-2, -1)).sum()
            where_apart = "some" if hidden is not None else apart
            raise TakeError(
                f"{taken.name}: {track}: a second run gave other commands in {where_apart} cells; "
                "an official score must be reproducible to the bit"
            )
        if hidden is not None:
            lines += _seal(result, simulators, where, hidden, out)
            continue
        path = create.create(result, simulators, source=where).save(out)
        lines.append(f"{taken.name}: {track}: {result.score:.3f} cmH2O nominal; {path.name}")
        if result.not_official_because:
            lines.append(f"{taken.name}: not official: {'; '.join(result.not_official_because)}")
        failed = [failure.message for failure in result.failures[:3]]
        lines += [message.replace(str(taken.folder), taken.name) for message in failed]
    return lines


def _scored(
    submission: Submission,
    track: str,
    simulators: ReplayPlants,
    runner: Runner,
    hidden: Hidden | None,
) -> Score:
    if hidden is None or hidden.season.protocol == 1:
        return run_protocol(
            submission,
            simulators.plants,
            track=track,
            draws=draws.COUNT,
            runner=runner,
            simulators=simulators.about(),
        )
    rigs = rigs_of(simulators)
    drawn = rig_draws.build(
        rigs.sessions or (),
        rigs.members,
        seed=hidden.seed,
        season=hidden.season.id,
        n=hidden.season.draws,
    )
    return run_on_rigs(
        submission, rigs, track=track, drawn=drawn, reference=hidden.reference, runner=runner
    )


def _seal(
    result: Score,
    simulators: ReplayPlants,
    where: Mapping[str, str],
    hidden: Hidden,
    out: Path,
) -> list[str]:
    """Write a sealed record; say no more than it does."""
    name = f"{result.submission.manifest.name}: {result.track}"
    try:
        draft = create.create(result, simulators, source=where)
        made = sealed.seal(draft.content, draft.commands, hidden.season, hidden.seed)
    except InputError:  # its text may hold numbers of a cell
        raise TakeError(f"{name}: no record can be made of this score") from None
    path = made.save(out)
    public = record.load(path)
    assert isinstance(public, record.Sealed)
    scores = ", ".join(f"{key} {value}" for key, value in public.content.scores.items())
    state = "official" if public.official else "not official"
    return [f"{name}: {scores}, {state}; {path.name}"]


def main() -> int:
    """Score what the environment names; see ``score-official.yml``."""
    from ventbench.plants import frozen
    from ventbench.sandbox.runner import SandboxRunner

    source, out = workflow.required("SOURCE"), Path(workflow.required("OUT"))
    wanted = workflow.required("TRACK")
    base, commit, name = (workflow.required(key) for key in ("BASE", "COMMIT", "NAME"))
    season, hidden = os.environ.get("SEASON", ""), None
    if season:
        file = Path(workflow.required("SEED_FILE"))
        hidden = hidden_draws(season, file, Path.cwd() / "leaderboard")
    runner = SandboxRunner(require_official=True)
    with tempfile.TemporaryDirectory() as folder:
        taken = take(source, base, commit, name, Path(folder))
        version = 1 if hidden is None else hidden.season.protocol
        simulators = frozen.load(version)
        lines = score_taken(taken, source, wanted, simulators, runner, out, hidden)
    workflow.summary(TITLE, lines)
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
