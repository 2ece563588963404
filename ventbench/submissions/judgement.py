"""From what a controller answered to findings; see :mod:`ventbench.submissions.contract`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ventbench import draws, protocol
from ventbench.lungs import LUNGS
from ventbench.submissions.contract_runs import STEPS, Run
from ventbench.submissions.dry_run import Answers
from ventbench.submissions.errors import Failure
from ventbench.submissions.findings import Finding, Group
from ventbench.submissions.folder import CONTROLLER

Floats = NDArray[np.float64]

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
_OTHERWISE = "see the limits of the sandbox in docs/submitting.md"


def imported(problem: str, label: str) -> Finding:
    """Finding of a submission that cannot be imported.

    Args:
        problem: as ``load.controller_class`` words it.
        label: of the submission, at its beginning.
    """
    advice = "it must be possible to import it with what the sandbox has"
    return _placed("run", problem.removeprefix(f"{label}: "), advice)


def failures(runs: Sequence[Run], answers: Answers) -> list[Finding]:
    """Return one finding for each different failure."""
    seen: dict[tuple[str, str], list[int]] = {}
    for k in sorted(answers.failures):
        failure = answers.failures[k]
        seen.setdefault((failure.what, failure.detail), []).append(k)
    return [_failure(runs[same[0]], answers, same) for same in seen.values()]


def _failure(run: Run, answers: Answers, same: list[int]) -> Finding:
    failure = answers.failures[same[0]]
    detail = f": {failure.detail}" if failure.detail else ""
    when = _when(run, failure, len(answers.commands[same[0]]))
    more = f" (and in {len(same) - 1} other runs)" if len(same) > 1 else ""
    what = f"{failure.what}{when}{detail}{more}"
    return _placed("run", what, _ADVICE.get(failure.kind, _OTHERWISE))


def _when(run: Run, failure: Failure, answered: int) -> str:
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


def clipping(commands: Sequence[Floats]) -> Iterator[Finding]:
    """A note on commands beyond the valve.

    Args:
        commands: of plain runs, %.
    """
    values = np.concatenate(commands)
    outside = np.sum((values < 0.0) | (values > protocol.U_MAX))
    if outside:
        what = (
            f"asked for {values.min():.4g} to {values.max():.4g} %, "
            f"outside of 0 to 100 % at {outside} of {values.size} steps"
        )
        advice = "that is clipped, and the board says how often; harmless if it is meant"
        yield Finding("run", CONTROLLER, what, advice, problem=False)


def repetition(first: Floats, again: Floats, thrice: Floats) -> Iterator[Finding]:
    """Findings on answers that should be the same.

    Args:
        first: commands of a run, %.
        again: of the same run in another process.
        thrice: of the same run three times in one process: fresh, reset, made anew; with one
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


def _differ(one: Floats, other: Floats) -> str:
    """Where two runs differ first; empty if nowhere."""
    different = np.flatnonzero(one != other)
    if not different.size:
        return ""
    k = different[0]
    breath, step = divmod(int(k), protocol.INSPIRATION_STEPS)
    return f"{other[k]:.9g} % instead of {one[k]:.9g} % at step {step + 1} of breath {breath + 1}"


def time(act_seconds: Floats) -> Iterator[Finding]:
    """Findings on how long ``act`` takes.

    Args:
        act_seconds: of each call.
    """
    mean = float(act_seconds.mean())
    total = mean * ACTS / CORES
    score = f"the {ACTS} calls of a score {total:.0f} s on {CORES} cores"
    what = f"act takes {1e3 * mean:.3g} ms on average, {score}"
    if total > LONGEST_S:
        advice = f"make it {total / LONGEST_S:.1f} times faster: {LONGEST_S:g} s are the limit"
        yield Finding("time", CONTROLLER, what, advice)
    elif mean > 0.2 * protocol.DT:
        advice = f"at a bench it has {1e3 * protocol.DT:g} ms with everything else"
        yield Finding("time", CONTROLLER, what, advice, problem=False)
