"""What the author of a pull request is told: every problem, and the score on the practice draws.

Not official, whatever it says: it runs beside the pull request, which might change this file.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from ci import workflow
from ci.take import PARENT, TakeError, changed_submissions, take
from ventbench.base.text import number
from ventbench.entries import contract
from ventbench.entries.cells import Runner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.entries.manifest import MANIFEST
from ventbench.entries.result import Score
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs
from ventbench.task.draws import COUNT

TITLE = "Advisory score (not official)"
#: Most submissions checked in one pull request.
MAX_SUBMISSIONS = 3
#: Time for all of their sessions, s, which leaves some of the job's for setting up; and sessions of
#: one: three of the check and a score on each of two tracks.
JOB_S, SESSIONS = 3000.0, 5


def advise(
    source: str,
    base: str,
    commit: str,
    name: str,
    rigs: Rigs,
    runner: Runner,
    draws: int,
) -> tuple[bool, list[str]]:
    """Say what is wrong with a submission, and its score if nothing is.

    Args:
        source: URL or path of the repository.
        base: commit that the pull request is meant for.
        commit: its last one.
        name: of the submission.
        rigs: that are scored.
        runner: of the controller.
        draws: how many of the development draws to score on.

    Returns:
        Whether it is ready, and lines for its author.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            taken = take(source, base, commit, name, Path(folder))
        except TakeError as error:
            return False, [f"{name}: {problem}" for problem in error.problems]
        report = contract.check(str(taken.folder), runner)
        lines = [line.replace(str(taken.folder), name) for line in report.lines()]
        if not report.ok:
            return False, lines
        submission = open_submission(str(taken.folder))
        if submission.manifest.name != name:
            return False, [*lines, f"{name}: submission.toml calls it {submission.manifest.name}"]
        for track in submission.manifest.tracks:
            result = run_protocol(
                submission, protocol_of(rigs, draws=draws), track=track, runner=runner
            )
            lines.append(f"{name}: {track}: {figures(result)}")
            failed = [failure.message for failure in result.failures[:3]]
            lines += [message.replace(str(taken.folder), name) for message in failed]
    return True, lines


def figures(result: Score) -> str:
    """The score that ranks, on practice draws; then the errors of the draws and the nominal one."""
    own = result.to_json()
    each = zip(result.lungs, result.by_lung, strict=True)
    by_lung = ", ".join(f"{lung} {number(value, 3)}" for lung, value in each)
    ranked = (own["normalised"] or {}).get("draws")
    parts = []
    if ranked:
        low, high = (number(end, 1) for end in ranked["ci95"])
        parts = [f"normalised {number(ranked['score'], 1)} [{low}, {high}]"]
    if own["draws"]:
        parts += [f"{number(own['draws']['score'], 3)} cmH2O over {len(result.drawn)} draws"]
    return "; ".join([*parts, f"{number(result.score, 3)} cmH2O nominal ({by_lung})"])


def main() -> int:
    """Look at the pull request that the environment names; see ``score-pr.yml``."""
    from ventbench.plants.rigs import load_rigs
    from ventbench.sandbox.pipes import Allowance
    from ventbench.sandbox.runner import SandboxRunner

    pull = workflow.required("SOURCE"), workflow.required("BASE"), workflow.required("COMMIT")
    names = changed_submissions(*pull)
    if not names:
        workflow.summary(TITLE, ["this pull request changes no submission"])
        return 0
    # Each of the submissions gets its share of the job's time, however slow another one is.
    share = JOB_S / (len(names[:MAX_SUBMISSIONS]) * SESSIONS)
    allowance = Allowance(total_s=share)
    rigs, runner = load_rigs(), SandboxRunner(require_official=True, allowance=allowance)
    ready = len(names) <= MAX_SUBMISSIONS
    if not ready:
        text = f"{len(names)} submissions are changed; one pull request, one submission"
        workflow.summary(TITLE, [text])
    for name in names[:MAX_SUBMISSIONS]:
        good, lines = advise(*pull, name, rigs, runner, COUNT)
        ready = ready and good
        workflow.summary(TITLE, lines)
        place = f"{PARENT}/{name}/{MANIFEST}"
        workflow.annotate(TITLE, lines, place, wrong=not good)
    return 0 if ready else 1


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
