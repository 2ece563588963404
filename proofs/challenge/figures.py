"""Figures of a challenge: shares with intervals, medians, goals, and tables of the answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from proofs.challenge.judge import EstimateAgainstTruth, JudgedCase
from proofs.challenge.questions import CLASSES


@dataclass(frozen=True)
class Figure:
    """A measured value and its goal.

    Attributes:
        what: the measured quantity, in words.
        value: None if there was nothing to measure.
        goal: goal in words, ``""`` if there is none.
        count: number of cases, parameters or breaths behind the value.
        ci95: Wilson's interval of a share, else None.
        met: whether the goal is met; None without a goal or a value.
    """

    what: str
    value: float | None
    goal: str
    count: int
    ci95: tuple[float, float] | None
    met: bool | None


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % score interval (Wilson) of a share."""
    z = 1.959964
    centre = hits + z * z / 2
    reach = z * np.sqrt(hits * (count - hits) / count + z * z / 4)
    low, high = (centre - reach) / (count + z * z), (centre + reach) / (count + z * z)
    return max(float(low), 0.0), min(float(high), 1.0)


def share(
    what: str, hits: Iterable[bool], *, least: float | None = None, most: float | None = None
) -> Figure:
    """Share of the hits, with its goal."""
    each = list(hits)
    n, k = len(each), sum(each)
    goal = _goal(least, most)
    if n == 0:
        return Figure(what, None, goal, 0, None, None)
    value = k / n
    met = (least is None or value >= least) and (most is None or value <= most)
    return Figure(what, value, goal, n, wilson(k, n), met if goal else None)


def _goal(least: float | None, most: float | None) -> str:
    if least is None:
        return "" if most is None else f"<= {most:.0%}"
    return f">= {least:.0%}" if most is None else f"{least:.0%} to {most:.0%}"


def statistic(what: str, values: Sequence[float], of: Callable, most: float | None) -> Figure:
    """Statistic ``of`` the values, with its upper limit."""
    goal = "" if most is None else f"<= {most:g}"
    if len(values) == 0:
        return Figure(what, None, goal, 0, None, None)
    value = float(of(np.asarray(values)))
    return Figure(what, value, goal, len(values), None, None if most is None else value <= most)


def figures(cases: Sequence[JudgedCase]) -> list[Figure]:
    """All figures that need no oracle."""
    single = [c for c in cases if c.kind == "single"]
    seen = [c for c in single if c.visible]
    strong = [c for c in seen if c.strengths == ("strong",)]
    mild = [c for c in seen if c.strengths == ("mild",)]
    under = [c for c in cases if c.kind in ("single", "form", "outside") and not c.visible]
    null = [c for c in cases if c.kind == "null"]
    outside = [c for c in cases if c.kind == "outside" and c.visible]
    form = [c for c in cases if c.kind == "form" and c.visible]
    pair = [c for c in cases if c.kind == "pair" and c.visible]
    four = [c for c in cases if c.kind == "four"]
    masked = [c for c in cases if c.kind == "masked" and c.visible]
    return [
        share("strong: right name and nothing else", (c.right for c in strong), least=0.98),
        share("mild: right name and nothing else", (c.right for c in mild), least=0.94),
        share("mild: a wrong name", (bool(c.wrong) for c in mild), most=0.02),
        share("single: true name given or among two alternatives",
              (c.listed == c.library for c in seen), least=0.98),
        share("single: right, with a nonparametric term for its form",
              (c.right and c.form is not None for c in seen)),
        share("below the detection limit: silence or the right answer",
              (c.silent or (c.named == c.library and bool(c.named)) or c.right for c in under),
              least=0.99),
        share("nothing missing: false names", (bool(c.named) for c in null), most=0.0),
        share("nothing missing: said so", (c.silent for c in null)),
        share("outside the library: said so", (c.said_outside for c in outside), least=0.90),
        share("outside the library: right place",
              (c.said_outside and c.right_slot for c in outside), least=0.90),
        share("library effect called unknown",
              (c.verdict == "unnamed" for c in seen + form), most=0.05),
        share("other form: right name and no other",
              (c.named == c.library for c in form), least=0.90),
        share("pair: both and only both", (c.named == c.library for c in pair), least=0.90),
        share("four: terms found",
              (name in c.named for c in four for name in sorted(c.seen)), least=0.90),
        statistic("four: spurious names a case", [len(c.wrong) for c in four], np.mean, 0.25),
        share("masked: right name and nothing else", (c.right for c in masked)),
        share("masked: a wrong name", (bool(c.wrong) for c in masked)),
        *_parameters(cases),
        *_distances(cases),
        share("held-out RMSE not above before",
              (c.after <= c.before * 1.001 for c in cases), least=1.0),
        share("held-out RMSE not above refitted",
              (c.after <= c.refit * 1.001 for c in cases), least=1.0),
        *_costs(cases),
    ]  # fmt: skip


def _distances(cases: Sequence[JudgedCase]) -> list[Figure]:
    acting = [c for c in cases if c.effects]
    return [
        statistic(f"held-out RMSE with an effect, {stage}, median", values, np.median, None)
        for stage, values in (
            ("before", [c.before for c in acting]),
            ("refitted", [c.refit for c in acting]),
            ("after", [c.after for c in acting]),
        )
    ]


def _parameters(cases: Sequence[JudgedCase]) -> list[Figure]:
    estimates = [estimate for c in cases for estimate in c.estimates]
    errors = [estimate.error for estimate in estimates]
    return [
        statistic("parameters: median relative error", errors, np.median, 0.10),
        share(
            "parameters: 95 % intervals that hold the truth",
            (estimate.covered for estimate in estimates),
            least=0.92,
            most=0.98,
        ),
    ]


def _costs(cases: Sequence[JudgedCase]) -> list[Figure]:
    started = [c for c in cases if not c.first]
    few = [c.seconds for c in started if c.kind != "four"]
    many = [c.seconds for c in started if c.kind == "four"]
    return [
        statistic("seconds a case, longest", few, np.max, 60.0),
        statistic("seconds a case, median", few, np.median, None),
        statistic("seconds a case with four effects, longest", many, np.max, 180.0),
        statistic("memory, MiB, most", [c.peak for c in cases], np.max, 1024.0),
    ]


def _within_class(case: JudgedCase) -> bool:
    return any(case.wrong & group and case.library & group for group in CLASSES)


def second_round(before: dict[str, JudgedCase], after: dict[str, JudgedCase]) -> Figure:
    """Share of the confusable cases that the requested breaths resolve.

    A case is confusable if its first answer lists alternatives, or gives another name of the same
    class for the true one.
    """
    cases = [
        after[name].resolved
        for name, first in before.items()
        if name in after and (first.open or _within_class(first))
    ]
    return share("confusable cases resolved by five more breaths", cases, least=0.80)


_NOTHING, _SEVERAL = "nothing missing", "several names"


def confusion(cases: Sequence[JudgedCase]) -> dict[str, dict[str, int]]:
    """Counts by truth, then by answer, over the cases with one effect or none."""
    table: dict[str, Counter[str]] = {}
    for case in sorted(cases, key=lambda c: c.effects):
        if len(case.effects) <= 1:
            truth = case.effects[0] if case.effects else _NOTHING
            table.setdefault(truth, Counter())[_answer_in_words(case)] += 1
    return {truth: dict(counts.most_common()) for truth, counts in table.items()}


def _answer_in_words(case: JudgedCase) -> str:
    if case.verdict == "nothing_missing":
        return _NOTHING
    if case.verdict == "unnamed":
        return f"unnamed: {case.slot}"
    name = next(iter(case.named)) if len(case.named) == 1 else _SEVERAL
    name = name if case.form is None else f"{name} (form: {case.form})"
    return name if case.slot is None else f"{name} + {case.slot}"


def full_answer(case: JudgedCase) -> str:
    """Every name of an answer and its place without a name, in words."""
    said = [*sorted(case.named), *([case.slot] if case.slot else [])]
    if said:
        return " + ".join(said)
    return _NOTHING if case.verdict == "nothing_missing" else "unnamed, no place"


def by_parameter(cases: Sequence[JudgedCase]) -> dict[str, dict[str, Any]]:
    """Coverage and median error of the estimates of each parameter, by its path."""
    grouped: dict[str, list[EstimateAgainstTruth]] = {}
    for case in cases:
        for estimate in case.estimates:
            grouped.setdefault(estimate.path, []).append(estimate)
    return {
        path: {
            "count": len(estimates),
            "covered": sum(estimate.covered for estimate in estimates),
            "median_error": sorted(e.error for e in estimates)[len(estimates) // 2],
        }
        for path, estimates in sorted(grouped.items())
    }
