"""The contract of a submission, for ``ventbench check`` and for an author's own tests.

In a test of your own::

    from ventbench.entries.contract import assert_ready

    def test_my_controller():
        assert_ready("submissions/mine")

Runs that it shows a controller are plain, one of them once more in another process, and unusual
inputs. Each is in a process of its own, as the runs of a score are.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.executor import Progress
from ventbench.entries.cells import ROUNDS, Runner, counted
from ventbench.entries.folder import (
    CONTROLLER,
    SEEDS,
    Submission,
    open_submission,
    resolve,
    seeds,
    with_seed,
)
from ventbench.entries.manifest import GROUPS, Finding, Group
from ventbench.entries.review import inspect_folder
from ventbench.entries.runs import DRAWS
from ventbench.sandbox.child.cell import ROW, Failure, SubmissionError, printable
from ventbench.task import draws, protocol
from ventbench.task.interfaces import Task
from ventbench.task.lungs import LUNG_IDS, LUNGS
from ventbench.task.stressors import conditions

#: Breaths and steps of one plain run.
BREATHS = 2
STEPS = BREATHS * protocol.INSPIRATION_STEPS

# Columns of a row: of an :class:`~ventbench.task.interfaces.Observation`, targets side by side.
_TIME, _DT, _PRESSURE, _TARGETS, _COMMAND = 0, 1, 2, slice(3, -1), -1

_PIP = 25.0  # cmH2O
_FULL, _TIME_CONSTANT = 60.0, 0.2  # of the stand-in for a lung, cmH2O at 100 % and s


class ContractRun(NamedTuple):
    """One cell: what the controller is told and shown, and what is unusual about it, in words."""

    task: Task
    inputs: Floats  #: ``(STEPS, ROW)``, see :func:`_inputs`; what was applied before is filled in.
    unusual: str = ""


def plain(tracks: Sequence[str]) -> list[ContractRun]:
    """A run for each lung on the performance track, for the unnamed one on the robustness track."""
    runs = []
    for track in tracks:
        lungs = LUNG_IDS if track == "performance" else (None,)
        runs += [
            ContractRun(Task(track, lung, protocol.DT, protocol.INSPIRATION_STEPS), _inputs())
            for lung in lungs
        ]
    return runs


def unusual(run_task: Task) -> list[ContractRun]:
    """Runs with inputs at and beyond the edge of what a bench gives."""
    random = np.random.default_rng(0)
    steps = protocol.INSPIRATION_STEPS
    wild = random.uniform(-20.0, 80.0, steps)
    uneven = random.uniform(0.005, 0.1, steps)
    inputs = {
        "a control step of 10 ms": _inputs(dt=0.01),
        "a control step of 60 ms": _inputs(dt=0.06),
        "uneven control steps": _inputs(dt=uneven),
        "a pressure of -20 cmH2O": _inputs(pressure=-20.0),
        "a pressure of 120 cmH2O": _inputs(pressure=120.0),
        "a very noisy pressure": _inputs(pressure=wild),
        "a pressure and a target of 0 cmH2O": _inputs(pressure=0.0, target=0.0),
        "a target of 60 cmH2O": _inputs(target=60.0),
    }
    return [ContractRun(run_task, rows, f"with {what}") for what, rows in inputs.items()]


def _inputs(
    dt: float | Floats = protocol.DT, pressure: float | Floats = np.nan, target: float = _PIP
) -> Floats:
    """Observations of all steps of two breaths, ``(STEPS, ROW)``.

    Where the pressure is NaN, a stand-in for a lung answers: it follows the valve with one time
    constant.
    """
    widths = np.broadcast_to(dt, protocol.INSPIRATION_STEPS)
    starts = np.cumsum(widths) - widths
    rows = np.zeros((len(widths), ROW))
    rows[:, _TIME], rows[:, _DT], rows[:, _PRESSURE] = starts, widths, pressure
    ahead = starts[:, None] + np.arange(1 + protocol.TARGETS_AHEAD) * widths[:, None]
    falls = (protocol.FALL_START, protocol.FALL_END)
    rows[:, _TARGETS] = np.interp(ahead, falls, (target, protocol.PEEP))
    return np.tile(rows, (BREATHS, 1))


#: Rounds whose time does not count: first calls load and compile.
_WARM_UP = 3


@dataclass(frozen=True)
class Answers:
    """What came of the runs."""

    commands: Floats  #: answers of each run, %, ``(runs, STEPS)``; NaN once it has failed.
    failures: dict[int, Failure]  #: what failed, by number of the run.
    act_seconds: Floats  #: processor time of one ``act`` in each round, s, without the first ones.


def run_all(
    submission: Submission,
    runs: Sequence[ContractRun],
    runner: Runner,
    count: Callable[[], object] = lambda: None,
) -> Answers:
    """Run fresh runs of a submission's controller side by side; each round is counted.

    Raises:
        SubmissionError: if the code cannot be imported.
    """
    inputs = np.stack([run.inputs for run in runs])
    commands, seconds = np.full(inputs.shape[:2], np.nan), []
    session = runner.start(submission, [run.task for run in runs])
    try:
        for k in range(STEPS):
            if k % protocol.INSPIRATION_STEPS == 0:
                pressure, applied = np.full(len(runs), protocol.PEEP), np.full(len(runs), 5.0)
            rows = inputs[:, k]
            rows[:, _COMMAND] = applied
            rows[:, _PRESSURE] = np.where(
                np.isnan(rows[:, _PRESSURE]), pressure, rows[:, _PRESSURE]
            )
            live = max(1, len(runs) - len(session.failures))
            start = session.processor_time()
            answers = session.act(rows)
            seconds.append((session.processor_time() - start) / live)
            count()
            working = [run for run in range(len(runs)) if run not in session.failures]
            commands[working, k] = answers[working]
            applied = np.clip(answers, 0.0, protocol.U_MAX)
            equilibrium = protocol.PEEP + _FULL * applied / protocol.U_MAX
            pressure = pressure + (equilibrium - pressure) * protocol.DT / _TIME_CONSTANT
        return Answers(commands, dict(session.failures), np.array(seconds[_WARM_UP:]))
    finally:
        session.close()


#: Calls of ``act`` in a run of all draws, in one under every condition, and the longest that those
#: of a round may take, s: half of what an entry has, as the scorer's machine may be slower.
ACTS = len(LUNGS) * len(protocol.PIPS) * (1 + draws.COUNT) * ROUNDS
STRESSED_ACTS = len(conditions()) * len(LUNGS) * DRAWS * ROUNDS
LONGEST_S = 0.5 * protocol.ENTRY_S

_PLACE = re.compile(r"([\w./-]+\.py) line (\d+) ")
_ADVICE = {
    "construct": "Controller() is called without arguments",
    "reset": "reset(self, task) gets track, lung (None for robustness), dt, inspiration_steps",
    "act": "act(self, observation) must answer whatever the sensors and the clock say",
    "type": "return one int or float, for example with float(u_in)",
    "value": "look for a division by zero, an overflow or a logarithm",
    "timeout": "answer within milliseconds; train before submitting",
    "memory": "keep to 512 MiB beyond Python and its packages",
}
_IMPORT_ADVICE = "it must be possible to import it with what the sandbox has"
_CLASS_ADVICE = "write a class Controller with reset(self, task) and act(self, observation)"
_GENERAL_ADVICE = "see the limits of the sandbox in docs/submitting.md"
_TO_RUN: tuple[Group, ...] = ("run", "repeat", "time")


@dataclass(frozen=True)
class CheckReport:
    """All findings of a submission."""

    label: str  #: the submission, as the person named it.
    findings: tuple[Finding, ...]  #: all of them, in the order of :data:`GROUPS`.
    skipped: tuple[Group, ...] = ()  #: groups that could not be looked at because of the problems.
    #: layers that the dry run had; None if it ran in this process, or did not run.
    sandbox: dict[str, Any] | None = None
    #: mean and largest time of an ``act``, microseconds; None if it did not run.
    act_us: tuple[float, float] | None = None

    @property
    def problems(self) -> tuple[Finding, ...]:
        """Findings that stop the submission."""
        return tuple(finding for finding in self.findings if finding.problem)

    @property
    def notes(self) -> tuple[Finding, ...]:
        """The other findings."""
        return tuple(finding for finding in self.findings if not finding.problem)

    @property
    def ok(self) -> bool:
        """Whether it can be submitted."""
        return not self.problems

    def lines(self) -> Iterable[str]:
        """The report for a person: problems, then notes, then the verdict."""
        label = printable(self.label)
        for finding in (*self.problems, *self.notes):
            yield from finding.message(label).split("\n")
        if self.skipped:
            yield f"{label}: not looked at yet: {', '.join(self.skipped)}; mend the above first"
        if self.act_us is not None:
            mean, largest = self.act_us
            yield f"{label}: act takes {mean:.0f} us on average, {largest:.0f} us at most"
        count = len(self.problems)
        if count:
            yield f"{label}: {count} {'problem' if count == 1 else 'problems'}; not ready to submit"
        else:
            yield f"{label}: no problems; ready to submit"

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        timing = {"mean": self.act_us[0], "max": self.act_us[1]} if self.act_us else None
        return {
            "submission": self.label,
            "ok": self.ok,
            "problems": [finding.to_json() for finding in self.problems],
            "notes": [finding.to_json() for finding in self.notes],
            "left_out": list(self.skipped),
            "sandbox": self.sandbox,
            "act_us": timing,
        }


#: Rounds of a check: all runs side by side, and the timed one.
_ROUNDS = STEPS + STEPS


def check(
    name: str,
    runner: Runner | None = None,
    progress: Progress | None = None,
) -> CheckReport:
    """Find everything that is wrong with a submission.

    Files, manifest and sources are read; then the controller runs for a few breaths, unless what
    was read makes that pointless.

    Args:
        name: path of a folder, or the name of a bundled submission.
        runner: runs the controller; the sandbox if not given.
        progress: called with rounds of the runs that are done, and all of them.

    Raises:
        SubmissionError: if there is no such folder.
        SandboxError: if nothing can be run apart on this machine.
    """
    folder = resolve(name)
    if runner is None:  # first: a machine that cannot run it reads none of it
        from ventbench.sandbox.pipes import Allowance
        from ventbench.sandbox.runner import SandboxRunner

        runner = SandboxRunner(allowance=Allowance(total_s=120.0))
    findings, opened = inspect_folder(folder), None
    with contextlib.suppress(SubmissionError):  # the checks have said why
        opened = open_submission(name)
    if opened is None or any(f.problem for f in findings if f.group == "source"):
        return _report(name, findings, skipped=_TO_RUN)
    return _ran(opened, runner, findings, counted(progress, _ROUNDS))


def assert_ready(name: str, runner: Runner | None = None) -> None:
    """Fail, saying everything that is wrong, unless the submission in a folder can be submitted.

    Raises:
        AssertionError: if it has a problem. The sandbox runs it if no runner is given.
    """
    report = check(name, runner)
    if not report.ok:
        raise AssertionError("\n".join(report.lines()))


def _ran(
    submission: Submission,
    runner: Runner,
    findings: list[Finding],
    count: Callable[[], object],
) -> CheckReport:
    name, tracks = submission.label, submission.manifest.tracks
    plain_runs = plain(tracks)
    run_task = plain_runs[0].task
    runs = [*plain_runs, plain_runs[0], *unusual(run_task)]
    sandbox = None if runner.sandbox is None else dict(runner.sandbox)
    try:
        answers = run_all(submission, runs, runner, count)
        # By itself, so that the time does not depend on how many run beside it.
        timed_answers = run_all(submission, plain_runs[:1], runner, count)
    except SubmissionError as error:
        # Each begins with the label.
        for problem in str(error).split("\n"):
            advice = _IMPORT_ADVICE if "while it was imported" in problem else _CLASS_ADVICE
            findings.append(_placed("run", problem.removeprefix(f"{name}: "), advice))
        return _report(name, findings, skipped=_TO_RUN[1:], sandbox=sandbox)
    findings += _failure_findings(runs, answers) or _failure_findings(plain_runs, timed_answers)
    findings += _clipping_notes(answers.commands[: len(plain_runs)])
    repeats = (0, len(plain_runs))
    if timed_answers.failures or set(repeats) & set(answers.failures):
        return _report(name, findings, skipped=_TO_RUN[1:], sandbox=sandbox)
    findings += repetition_findings(*(answers.commands[k] for k in repeats))
    findings += _seed_findings(submission, plain_runs, runner)
    acts = ACTS * len(tracks) * (1 + len(seeds(submission.folder)))
    acts += STRESSED_ACTS * ("robustness" in tracks)
    findings += time_findings(timed_answers.act_seconds, acts)
    act_us = (
        1e6 * float(timed_answers.act_seconds.mean()),
        1e6 * float(timed_answers.act_seconds.max()),
    )
    return _report(name, findings, sandbox=sandbox, act_us=act_us)


def _seed_findings(
    submission: Submission,
    runs: Sequence[ContractRun],
    runner: Runner,
) -> Iterator[Finding]:
    """What fails with the weights of a seed, in the first of some runs."""
    for seed in seeds(submission.folder):
        with TemporaryDirectory() as folder:
            seeded = with_seed(submission, seed.name, Path(folder))
            try:
                findings = _failure_findings(runs, run_all(seeded, runs[:1], runner))
            except SubmissionError as error:
                findings = [Finding("run", CONTROLLER, str(error), _IMPORT_ADVICE)]
        for finding in findings:
            yield replace(finding, what=f"with the weights of {SEEDS}/{seed.name} {finding.what}")


def _report(name: str, findings: list[Finding], **fields: object) -> CheckReport:
    order = sorted(findings, key=lambda finding: GROUPS.index(finding.group))
    return CheckReport(name, tuple(order), **fields)  # type: ignore[arg-type]


def _failure_findings(runs: Sequence[ContractRun], answers: Answers) -> list[Finding]:
    """Return one finding for each different failure."""
    by_failure: dict[tuple[str, str], list[int]] = {}
    for k in sorted(answers.failures):
        failure = answers.failures[k]
        by_failure.setdefault((failure.what, failure.detail), []).append(k)
    return [_failure(runs[indices[0]], answers, indices) for indices in by_failure.values()]


def _failure(run: ContractRun, answers: Answers, indices: list[int]) -> Finding:
    failure = answers.failures[indices[0]]
    detail = f": {failure.detail}" if failure.detail else ""
    answered = int(np.isfinite(answers.commands[indices[0]]).sum())
    when = f" {run.unusual}" if run.unusual else ""
    if failure.step is not None:
        breath, step = divmod(answered, protocol.INSPIRATION_STEPS)
        when += f" at step {step + 1} of breath {breath + 1}"
    more = f" (and in {len(indices) - 1} other runs)" if len(indices) > 1 else ""
    message = f"{failure.what}{when} (lung {run.task.lung or 'hidden'}){detail}{more}"
    return _placed("run", message, _ADVICE.get(failure.kind, _GENERAL_ADVICE))


def _placed(group: Group, text: str, advice: str) -> Finding:
    place = _PLACE.match(text)
    if place is None:
        return Finding(group, CONTROLLER, text.removeprefix(f"{CONTROLLER} "), advice)
    return Finding(group, place[1], text[place.end() :], advice, int(place[2]))


def _clipping_notes(commands: Floats) -> Iterator[Finding]:
    """A note on commands beyond the valve, by the answers of the plain runs, %."""
    values = commands[np.isfinite(commands)]
    outside = np.sum((values < 0.0) | (values > protocol.U_MAX))
    if outside:
        message = (
            f"asked for {values.min():.4g} to {values.max():.4g} %, "
            f"outside of 0 to 100 % at {outside} of {values.size} steps"
        )
        advice = "that is clipped, and score.json says how often; harmless if it is meant"
        yield Finding("run", CONTROLLER, message, advice, problem=False)


def repetition_findings(first: Floats, repeated: Floats) -> Iterator[Finding]:
    """A finding if commands of a run, %, are others in another process."""
    for k in np.flatnonzero(first != repeated)[:1].tolist():
        breath, step = divmod(k, protocol.INSPIRATION_STEPS)
        message = (
            f"the same run in another process gave {repeated[k]:.9g} % instead of {first[k]:.9g} % "
            f"at step {step + 1} of breath {breath + 1}"
        )
        advice = "give every random generator a fixed seed; do not look at the clock"
        yield Finding("repeat", CONTROLLER, message, advice)


def time_findings(act_seconds: Floats, acts: int = ACTS) -> Iterator[Finding]:
    """Findings on how long ``act`` takes, by the processor time of each call, s."""
    mean = float(act_seconds.mean())
    total = mean * acts
    score = f"the {acts} calls of a round {total:.0f} s"
    message = f"act takes {1e3 * mean:.3g} ms of processor time on average, {score}"
    if total > LONGEST_S:
        advice = f"make it {total / LONGEST_S:.1f} times faster: {LONGEST_S:g} s are the limit"
        yield Finding("time", CONTROLLER, message, advice)
    elif mean > 0.1 * protocol.DT:
        advice = f"at a bench it has {1e3 * protocol.DT:g} ms with everything else"
        yield Finding("time", CONTROLLER, message, advice, problem=False)
