"""What the author of a pull request is told: every problem, and the nominal score.

Not official, whatever it says: it runs beside the pull request, which might change this file.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from ci import workflow
from ci.take import TakeError, changed_submissions, take
from ventbench.entries import contract
from ventbench.entries.folder import open_submission
from ventbench.entries.runner import Runner
from ventbench.entries.scoring import run_protocol
from ventbench.plants.rigs import Rigs

TITLE = "Advisory score (not official)"
#: Most submissions checked in one pull request.
MAX_SUBMISSIONS = 3
#: Time for all of their sessions, s, which leaves some of the job's for setting up; and sessions of
#: one: three of the check and a score on each of two tracks.
JOB_S, SESSIONS = 900.0, 5


def advise(
    source: str,
    base: str,
    commit: str,
    name: str,
    rigs: Rigs,
    runner: Runner,
) -> tuple[bool, list[str]]:
    """Say what is wrong with a submission, and its score if nothing is.

    Args:
        source: URL or path of the repository.
        base: commit that the pull request is meant for.
        commit: its last one.
        name: of the submission.
        rigs: that are scored.
        runner: of the controller.

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
            result = run_protocol(submission, rigs, track=track, runner=runner)
            by_lung = zip(result.lungs, result.by_lung, strict=True)
            each = ", ".join(f"{lung} {value:.3f}" for lung, value in by_lung)
            lines.append(f"{name}: {track}: {result.score:.3f} cmH2O nominal ({each})")
            failed = [failure.message for failure in result.failures[:3]]
            lines += [message.replace(str(taken.folder), name) for message in failed]
    return True, lines


def main() -> int:
    """Look at the pull request that the environment names; see ``score-pr.yml``."""
    from ventbench.plants.rigs import load_rigs
    from ventbench.sandbox.configuration import Allowance
    from ventbench.sandbox.runner import SandboxRunner

    pull = workflow.required("SOURCE"), workflow.required("BASE"), workflow.required("COMMIT")
    names = changed_submissions(*pull)
    if not names:
        workflow.summary(TITLE, ["this pull request changes no submission"])
        return 0
    # Each of the submissions gets its share of the job's time, however slow another one is.
    share = JOB_S / (MAX_SUBMISSIONS * SESSIONS)
    allowance = Allowance(total_s=share)
    rigs, runner = load_rigs(), SandboxRunner(require_official=True, allowance=allowance)
    ready = len(names) <= MAX_SUBMISSIONS
    if not ready:
        text = f"{len(names)} submissions are changed; one pull request, one submission"
        workflow.summary(TITLE, [text])
    for name in names[:MAX_SUBMISSIONS]:
        good, lines = advise(*pull, name, rigs, runner)
        ready = ready and good
        workflow.summary(TITLE, lines)
    return 0 if ready else 1


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
