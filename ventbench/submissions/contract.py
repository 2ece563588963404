"""The contract of a submission: ``ventbench check``, and the same for an author's own tests.

In a test of your own::

    from ventbench.submissions.contract import assert_ready

    def test_my_controller():
        assert_ready("submissions/mine")
"""

from __future__ import annotations

from ventbench.submissions import dry_run, folder_check, manifest_check, source_check
from ventbench.submissions import judgement as judge
from ventbench.submissions.contract_driver import driven
from ventbench.submissions.contract_runs import breaths, plain, repeated, unusual
from ventbench.submissions.errors import SubmissionError
from ventbench.submissions.findings import GROUPS, Finding, Group, Report
from ventbench.submissions.folder import Submission, open_submission, resolve
from ventbench.submissions.runner import Runner

_TO_RUN: tuple[Group, ...] = ("run", "repeat", "time")


def check(name: str, runner: Runner | None = None) -> Report:
    """Find everything that is wrong with a submission.

    Files, manifest and sources are read; then the controller runs for a few breaths, unless what
    was read makes that pointless.

    Args:
        name: path of a folder, or the name of a bundled submission.
        runner: of the controller; the sandbox if not given.

    Raises:
        SubmissionError: if there is no such folder.
        SandboxError: if nothing can be run apart on this machine.
    """
    folder = resolve(name)
    found, _ = manifest_check.check(folder)
    found += folder_check.check(folder)
    sources = source_check.check(folder)
    opened = _opened(name)
    if opened is None or any(finding.problem for finding in sources):
        return _report(name, [*found, *sources], left_out=_TO_RUN)
    if runner is None:
        from ventbench.sandbox.allowance import Allowance
        from ventbench.sandbox.runner import SandboxRunner

        runner = SandboxRunner(allowance=Allowance(total_s=120.0))
    return _ran(opened, runner, [*found, *sources])


def assert_ready(name: str, runner: Runner | None = None) -> None:
    """Fail, saying everything that is wrong, unless a submission can be submitted.

    Args:
        name: path of its folder.
        runner: of the controller; the sandbox if not given.

    Raises:
        AssertionError: if it has a problem.
    """
    report = check(name, runner)
    if not report.ok:
        raise AssertionError("\n".join(report.lines()))


def _opened(name: str) -> Submission | None:
    try:
        return open_submission(name)
    except SubmissionError:
        return None  # the checks have said why


def _ran(submission: Submission, runner: Runner, found: list[Finding]) -> Report:
    name, tracks = submission.label, submission.manifest.tracks
    normal = plain(tracks)
    others = repeated(normal[0].task)
    runs = [*normal, *others, *unusual(normal[0].task)]
    sandbox = None if runner.sandbox is None else dict(runner.sandbox)
    try:
        with driven(submission) as driver:
            answers = dry_run.show(driver, runs, runner)
            # By itself, so that the time does not depend on how many run beside it.
            alone = normal[0]._replace(script=breaths())
            timed = dry_run.show(driver, [alone], runner)
    except SubmissionError as error:
        problems = [judge.imported(problem, name) for problem in error.problems]
        return _report(name, [*found, *problems], left_out=_TO_RUN[1:], sandbox=sandbox)
    found += judge.failures(runs, answers) or judge.failures([alone], timed)
    found += judge.clipping(answers.commands[: len(normal)])
    repeats = (0, len(normal), len(normal) + 1)
    if timed.failures or set(repeats) & set(answers.failures):
        return _report(name, found, left_out=_TO_RUN[1:], sandbox=sandbox)
    found += judge.repetition(*(answers.commands[k] for k in repeats))
    found += judge.time(timed.act_seconds)
    act_us = 1e6 * float(timed.act_seconds.mean()), 1e6 * float(timed.act_seconds.max())
    return _report(name, found, sandbox=sandbox, act_us=act_us)


def _report(name: str, found: list[Finding], **others: object) -> Report:
    order = sorted(found, key=lambda finding: GROUPS.index(finding.group))
    return Report(name, tuple(order), **others)  # type: ignore[arg-type]
