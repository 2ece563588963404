"""Figures of a challenge: shares and means with intervals, goals, tables, paired differences."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import binomtest

from proofs.challenge.judge import CONFIDENT, JudgedCase
from ventbench.base.arrays import Floats

#: Resamples of the cases for an interval, and bins of equally many cases of a calibration error.
_RESAMPLES, _BINS = 2000, 10

#: Largest relative error of a strength whose size is right.
_SIZE = 0.25


@dataclass(frozen=True)
class Figure:
    """A measured value and its goal."""

    what: str  #: the measured quantity, in words.
    value: float | None  #: None if there was nothing to measure.
    goal: str  #: goal in words, ``""`` if there is none.
    count: int  #: number of cases, parameters or breaths behind the value.
    #: Wilson's interval of a share; of a mean, by resampling cases; or None.
    ci95: tuple[float, float] | None
    met: bool | None  #: whether the goal is met; None without a goal or a value.
    is_share: bool = False  #: whether the value is a share of the count.


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % score interval (Wilson) of a share."""
    found = binomtest(hits, count).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def share(
    what: str, hits: Iterable[bool], *, least: float | None = None, most: float | None = None
) -> Figure:
    """Share of the hits, with its goal."""
    each = list(hits)
    n, k = len(each), sum(each)
    goal = _goal(least, most)
    if n == 0:
        return Figure(what, None, goal, 0, None, None, True)
    value = k / n
    met = (least is None or value >= least) and (most is None or value <= most)
    return Figure(what, value, goal, n, wilson(k, n), met if goal else None, True)


def _goal(least: float | None, most: float | None) -> str:
    if least is None:
        return "" if most is None else f"<= {most:.0%}"
    return f">= {least:.0%}" if most is None else f"{least:.0%} to {most:.0%}"


def largest(what: str, values: Sequence[float]) -> Figure:
    """The largest value, which has no interval."""
    return Figure(what, max(values, default=None), "", len(values), None, None)


def mean(
    what: str,
    values: Sequence[float],
    *,
    most: float | None = None,
    of: Callable[[Floats], Floats] | None = None,
) -> Figure:
    """Mean, or another statistic, with the interval that resampled cases give.

    Args:
        what: the quantity.
        values: one or more numbers of each case, ``(n,)`` or ``(n, k)``.
        most: goal.
        of: statistic of resampled values ``(m, n, ...)``, returns ``(m,)``.
    """
    goal = "" if most is None else f"<= {most:g}"
    given = np.asarray(values, float)
    if len(given) == 0:
        return Figure(what, None, goal, 0, None, None)
    statistic = of or (lambda x: x.mean(axis=1))
    value = float(statistic(given[None])[0])
    span = interval(given, statistic) if len(given) > 2 else None
    met = None if most is None else value <= most
    return Figure(what, value, goal, len(given), span, met)


def interval(values: Floats, statistic: Callable[[Floats], Floats]) -> tuple[float, float]:
    """95 % interval of a statistic by resampling cases, always with the same random numbers."""
    rng = np.random.default_rng(0)
    drawn = statistic(values[rng.integers(0, len(values), (_RESAMPLES, len(values)))])
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)


def calibration_error(values: Floats) -> Floats:
    """Expected calibration error of resamples: confidence and correctness, ``(m, n, 2)``.

    Cases are sorted by confidence into bins of equally many. It is above zero by chance, the more
    so the fewer cases there are.
    """
    order = np.argsort(values[..., 0], axis=1, kind="stable")
    ordered = np.take_along_axis(values, order[..., None], axis=1)
    count = values.shape[1]
    edges = np.linspace(0, count, min(_BINS, count) + 1).astype(int)
    parts = [ordered[:, a:b] for a, b in pairwise(edges)]
    gaps = [np.abs((part[..., 0] - part[..., 1]).sum(axis=1)) for part in parts]
    return np.sum(gaps, axis=0) / count


def scores(cases: Sequence[JudgedCase]) -> list[Figure]:
    """What every diagnoser is measured by, over all cases."""
    present = [c for c in cases if c.something]
    alarms = [alarm for alarm in map(false_alarm, cases) if alarm is not None]
    seen = [c for c in present if c.visible]
    parts = [c.overlap for c in cases if c.overlap is not None]
    believed = [(c.confidence, float(c.isolation > 0.0)) for c in cases]
    return [
        share("lost cases", (bool(c.problem) for c in cases), most=0.0),
        mean("log score, nats", [c.log_score for c in cases]),
        mean("Brier score", [c.brier for c in cases]),
        mean("isolation accuracy", [c.isolation for c in cases]),
        mean("calibration error (ECE)", believed, most=0.05, of=calibration_error),  # type: ignore[arg-type]
        share("detected, where something is missing", (c.missing > 0.5 for c in present)),
        share("false alarms, where nothing is missing", alarms, most=0.0),
        share("right part of the rig", (c.right_place for c in seen), least=0.90),
        share("right name and size", (c.right and _size_is_right(c) for c in seen), least=0.80),
        mean("harm of wrong names", [c.harm for c in cases]),
        share(
            "a confident wrong name",
            (any(p > CONFIDENT for p in c.wrong.values()) for c in cases),
            most=0.03,
        ),
        mean("localisation F1, where an effect acts in part", parts),  # type: ignore[arg-type]
        mean("withheld inspirations, error, cmH2O", [c.inspiration for c in cases]),
        mean("withheld expirations, error, cmH2O", [c.expiration for c in cases]),
        *_parameters(cases),
        mean("processor seconds, mean", [c.seconds for c in cases]),
        largest("processor seconds, longest", [c.seconds for c in cases]),
        largest("memory, MiB, most", [c.peak for c in cases]),
    ]


def _size_is_right(case: JudgedCase) -> bool:
    """Whether every strength that can be compared is within a quarter of the truth."""
    return all(estimate.error <= _SIZE for estimate in case.estimates)


#: Least share of right answers, by the kind of the question.
_LEAST = {
    "strong alone": 0.98,
    "mild alone": 0.94,
    "below the detection limit": 0.99,
    "outside": 0.90,
    "form": 0.90,
    "pair": 0.90,
}


def by_kind(cases: Sequence[JudgedCase]) -> list[Figure]:
    """Right answers and wrong names, by the kind of the question."""
    kinds: dict[str, list[JudgedCase]] = {}
    for case in cases:
        kind = f"{case.strengths[0]} alone" if case.kind == "single" else case.kind
        kind = kind if case.visible else "below the detection limit"
        kinds.setdefault(kind, []).append(case)
    figures = []
    for kind, own in kinds.items():
        right = (case.right for case in own)
        figures.append(share(f"{kind}: right and nothing else", right, least=_LEAST.get(kind)))
        figures.append(share(f"{kind}: a wrong name", (bool(case.false) for case in own)))
    return figures


def _parameters(cases: Sequence[JudgedCase]) -> list[Figure]:
    every = [estimate for c in cases for estimate in c.estimates]
    named = [estimate for estimate in every if "." in estimate.path]
    lungs = [estimate for estimate in every if "." not in estimate.path]
    return [
        mean(
            "parameters: median relative error",
            [e.error for e in named],
            most=0.10,
            of=lambda errors: np.median(errors, axis=1),
        ),
        share(
            "parameters: 95 % intervals that hold the truth",
            (e.covered for e in named),
            least=0.92,
            most=0.98,
        ),
        share(
            "R and C, nothing missing: intervals that hold the truth", (e.covered for e in lungs)
        ),
    ]


def false_alarm(case: JudgedCase) -> bool | None:
    """Whether something is said to be missing, or nothing at all; None if something is."""
    return None if case.effects else case.missing > 0.5 or bool(case.problem)


#: What diagnosers are compared by, case by case; less is better, and None does not count.
PAIRED: Mapping[str, Callable[[JudgedCase], float | None]] = {
    "log score": lambda case: case.log_score,
    "isolation error": lambda case: 1.0 - case.isolation,
    "false alarms": false_alarm,
    "inspiration, cmH2O": lambda case: case.inspiration,
    "seconds": lambda case: case.seconds,
}


def paired(ours: Mapping[Any, JudgedCase], other: Mapping[Any, JudgedCase]) -> dict[str, Figure]:
    """Mean of the differences ``ours - other`` over common cases; negative: ours is better."""
    common = sorted(ours.keys() & other.keys())
    found = {}
    for what, of in PAIRED.items():
        pairs = ((of(ours[name]), of(other[name])) for name in common)
        found[what] = mean(what, [a - b for a, b in pairs if a is not None and b is not None])
    return found


#: Most hypotheses of equal probability that are told one by one.
_TOLD = 3


def full_answer(case: JudgedCase) -> str:
    """The likeliest hypotheses in words."""
    if case.problem:
        return "no answer"
    if len(case.leading) > _TOLD:
        return f"{len(case.leading)} answers alike"
    return " or ".join(" + ".join(sorted(terms)) or "nothing missing" for terms in case.leading)
