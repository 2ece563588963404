"""The contract of a submission, for ``ventbench check`` and for an author's own tests.

In a test of your own::

    from ventbench.entries.contract import assert_ready

    def test_my_controller():
        assert_ready("submissions/mine")
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.entries.contract_runs import (
    STEPS,
    Answers,
    ContractRun,
    breaths,
    driven,
    joined,
    plain,
    processor_time,
    repeated,
    run_all,
    unusual,
)
from ventbench.entries.errors import (
    GROUPS,
    CheckReport,
    Failure,
    Finding,
    Group,
    SubmissionError,
)
from ventbench.entries.folder import CONTROLLER, Submission, open_submission, resolve
from ventbench.entries.review import inspect_folder
from ventbench.entries.runner import ControllerSession, Runner
from ventbench.task import draws, protocol
from ventbench.task.lungs import LUNGS

#: Calls of ``act`` in a whole score, on how many processor cores, and the longest that they may
#: take, s: half of what the sandbox allows, as the scorer's machine may be slower and busy.
ACTS = len(LUNGS) * len(protocol.PIPS) * (1 + draws.COUNT) * protocol.BREATHS
ACTS *= protocol.INSPIRATION_STEPS
CORES = 2
LONGEST_S = 450.0

_PLACE = re.compile(r"([\w./-]+\.py) line (\d+) ")
_ADVICE = {
    "construct": "Controller() is called without arguments",
    "reset": "reset(task) gets track, lung (None on the robustness track), dt, inspiration_steps",
    "act": "act(observation) must answer whatever the sensors and the clock say",
    "type": "return one int or float, for example with float(u_in)",
    "value": "look for a division by zero, an overflow or a logarithm",
    "timeout": "answer within milliseconds; train before submitting",
    "memory": "keep to 512 MiB beyond Python and its packages",
}
_OTHER_ADVICE = "see the limits of the sandbox in docs/submitting.md"
_TO_RUN: tuple[Group, ...] = ("run", "repeat", "time")


#: Rounds of a check: plain runs, the timed one, and three in one process with two resets between.
_ROUNDS = STEPS + STEPS + 3 * STEPS + 2


def check(
    name: str,
    runner: Runner | None = None,
    clock: Callable[[ControllerSession], float] = processor_time,
    progress: Callable[[int, int], object] | None = None,
) -> CheckReport:
    """Find everything that is wrong with a submission.

    Files, manifest and sources are read; then the controller runs for a few breaths, unless what
    was read makes that pointless.

    Args:
        name: path of a folder, or the name of a bundled submission.
        runner: runs the controller; the sandbox if not given.
        clock: times the calls of ``act``, s; by default their processor time.
        progress: called with rounds of the runs that are done, and all of them.

    Raises:
        SubmissionError: if there is no such folder.
        SandboxError: if nothing can be run apart on this machine.
    """
    folder = resolve(name)
    if runner is None:  # first: a machine that cannot run it reads none of it
        from ventbench.sandbox.configuration import Allowance
        from ventbench.sandbox.runner import SandboxRunner

        runner = SandboxRunner(allowance=Allowance(total_s=120.0))
    findings = list(inspect_folder(folder))
    opened = _opened(name)
    if opened is None or any(f.problem for f in findings if f.group == "source"):
        return _report(name, findings, left_out=_TO_RUN)
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, _ROUNDS)

    return _ran(opened, runner, findings, clock, count)


def assert_ready(name: str, runner: Runner | None = None) -> None:
    """Fail, saying everything that is wrong, unless a submission can be submitted.

    Args:
        name: path of its folder.
        runner: runs the controller; the sandbox if not given.

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


def _ran(
    submission: Submission,
    runner: Runner,
    findings: list[Finding],
    clock: Callable[[ControllerSession], float],
    count: Callable[[], None],
) -> CheckReport:
    name, tracks = submission.label, submission.manifest.tracks
    plain_runs = plain(tracks)
    again, thrice = repeated(plain_runs[0].task)
    runs = [*plain_runs, again, *unusual(plain_runs[0].task)]
    sandbox = None if runner.sandbox is None else dict(runner.sandbox)
    try:
        # The folder as it is, through the runner that scores it: what can be told from a score by
        # its frames or files is the last run alone, whose answers show nothing but its resets.
        answers = run_all(submission, runs, runner, clock, count)
        # By itself, so that the time does not depend on how many run beside it.
        timed_run = plain_runs[0]._replace(script=breaths())
        timed_answers = run_all(submission, [timed_run], runner, clock, count)
        with driven(submission) as driver:
            answers = joined(answers, run_all(driver, [thrice], runner, clock, count))
            runs = [*runs, thrice]
    except SubmissionError as error:
        problems = [_import_finding(problem, name) for problem in error.problems]
        return _report(name, [*findings, *problems], left_out=_TO_RUN[1:], sandbox=sandbox)
    findings += _failure_findings(runs, answers) or _failure_findings([timed_run], timed_answers)
    findings += _clipping_notes(answers.commands[: len(plain_runs)])
    repeats = (0, len(plain_runs), len(runs) - 1)
    if timed_answers.failures or set(repeats) & set(answers.failures):
        return _report(name, findings, left_out=_TO_RUN[1:], sandbox=sandbox)
    findings += repetition_findings(*(answers.commands[k] for k in repeats))
    findings += time_findings(timed_answers.act_seconds)
    act_us = (
        1e6 * float(timed_answers.act_seconds.mean()),
        1e6 * float(timed_answers.act_seconds.max()),
    )
    return _report(name, findings, sandbox=sandbox, act_us=act_us)


def _report(name: str, findings: list[Finding], **others: object) -> CheckReport:
    order = sorted(findings, key=lambda finding: GROUPS.index(finding.group))
    return CheckReport(name, tuple(order), **others)  # type: ignore[arg-type]


def _import_finding(problem: str, label: str) -> Finding:
    """Finding of a submission that cannot be imported, whose label the problem begins with."""
    advice = "it must be possible to import it with what the sandbox has"
    return _placed("run", problem.removeprefix(f"{label}: "), advice)


def _failure_findings(runs: Sequence[ContractRun], answers: Answers) -> list[Finding]:
    """Return one finding for each different failure."""
    seen: dict[tuple[str, str], list[int]] = {}
    for k in sorted(answers.failures):
        failure = answers.failures[k]
        seen.setdefault((failure.what, failure.detail), []).append(k)
    return [_failure(runs[same[0]], answers, same) for same in seen.values()]


def _failure(run: ContractRun, answers: Answers, same: list[int]) -> Finding:
    failure = answers.failures[same[0]]
    detail = f": {failure.detail}" if failure.detail else ""
    when = _when(run, failure, len(answers.commands[same[0]]))
    more = f" (and in {len(same) - 1} other runs)" if len(same) > 1 else ""
    what = f"{failure.what}{when}{detail}{more}"
    return _placed("run", what, _ADVICE.get(failure.kind, _OTHER_ADVICE))


def _when(run: ContractRun, failure: Failure, answered: int) -> str:
    words = f" {run.unusual}" if run.unusual else ""
    if failure.step is not None:
        breath, step = divmod(answered % (STEPS + 1), protocol.INSPIRATION_STEPS)
        words += f" at step {step + 1} of breath {breath + 1}"
    return f"{words} (lung {run.task.lung or 'hidden'})"


def _placed(group: Group, text: str, advice: str) -> Finding:
    place = _PLACE.match(text)
    if place is None:
        return Finding(group, CONTROLLER, text.removeprefix(f"{CONTROLLER} "), advice)
    return Finding(group, place[1], text[place.end() :], advice, int(place[2]))


def _clipping_notes(commands: Sequence[Floats]) -> Iterator[Finding]:
    """A note on commands beyond the valve, by the answers of the plain runs, %."""
    values = np.concatenate(commands)
    outside = np.sum((values < 0.0) | (values > protocol.U_MAX))
    if outside:
        what = (
            f"asked for {values.min():.4g} to {values.max():.4g} %, "
            f"outside of 0 to 100 % at {outside} of {values.size} steps"
        )
        advice = "that is clipped, and the board says how often; harmless if it is meant"
        yield Finding("run", CONTROLLER, what, advice, problem=False)


def repetition_findings(first: Floats, again: Floats, thrice: Floats) -> Iterator[Finding]:
    """Findings on answers that should be the same.

    Args:
        first: commands of a run, %.
        again: commands of the same run in another process, %.
        thrice: commands of the run three times in one process: fresh, reset, made anew; with one
            command between each, which does not count.
    """
    fresh, reset, renewed = (thrice[k * (STEPS + 1) :][:STEPS] for k in range(3))
    other = next((values for values in (again, fresh) if _differ(first, values)), None)
    if other is not None:
        advice = "give every random generator a fixed seed; do not look at the clock"
        yield _repeat(f"the same run in another process gave {_differ(first, other)}", advice)
    elif _differ(first, renewed):
        advice = "keep state in self, not in modules or the class: each run gets a fresh process"
        what = f"a second Controller() remembers the first: it gave {_differ(first, renewed)}"
        yield _repeat(what, advice)
    elif _differ(first, reset):
        advice = "set everything in reset that a run changes"
        yield _repeat(
            f"reset does not clear what it keeps: it gave {_differ(first, reset)}", advice
        )


def _repeat(what: str, advice: str) -> Finding:
    return Finding("repeat", CONTROLLER, what, advice)


def _differ(first: Floats, other: Floats) -> str:
    """Where two runs differ first; empty if nowhere."""
    different = np.flatnonzero(first != other)
    if not different.size:
        return ""
    k = different[0]
    breath, step = divmod(int(k), protocol.INSPIRATION_STEPS)
    return f"{other[k]:.9g} % instead of {first[k]:.9g} % at step {step + 1} of breath {breath + 1}"


def time_findings(act_seconds: Floats) -> Iterator[Finding]:
    """Findings on how long ``act`` takes, by the processor time of each call, s."""
    mean = float(act_seconds.mean())
    total = mean * ACTS / CORES
    score = f"the {ACTS} calls of a score {total:.0f} s on {CORES} cores"
    what = f"act takes {1e3 * mean:.3g} ms of processor time on average, {score}"
    if total > LONGEST_S:
        advice = f"make it {total / LONGEST_S:.1f} times faster: {LONGEST_S:g} s are the limit"
        yield Finding("time", CONTROLLER, what, advice)
    elif mean > 0.2 * protocol.DT:
        advice = f"at a bench it has {1e3 * protocol.DT:g} ms with everything else"
        yield Finding("time", CONTROLLER, what, advice, problem=False)
