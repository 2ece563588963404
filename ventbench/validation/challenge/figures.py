"""Figures to reach: shares with intervals, medians, and whether each goal is met."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ventbench.validation.challenge.judge import Judged
from ventbench.validation.challenge.plan import CLASSES


@dataclass(frozen=True)
class Figure:
    """A measured value and its goal.

    Attributes:
        what: in words.
        value: measured, None if there was nothing to measure.
        goal: in words, ``""`` if there is none.
        count: of what it was measured on.
        ci95: Wilson's interval of a share, else None.
        met: the goal, None if there is none or no value.
    """

    what: str
    value: float | None
    goal: str
    count: int
    ci95: tuple[float, float] | None
    met: bool | None


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share by Wilson's score."""
    z = 1.959964
    centre = hits + z * z / 2
    reach = z * np.sqrt(hits * (count - hits) / count + z * z / 4)
    low, high = (centre - reach) / (count + z * z), (centre + reach) / (count + z * z)
    return max(float(low), 0.0), min(float(high), 1.0)


def share(
    what: str, hits: Iterable[bool], *, least: float | None = None, most: float | None = None
) -> Figure:
    """A share of cases, with its goal."""
    given = list(hits)
    n, k = len(given), sum(given)
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


def number(what: str, values: Sequence[float], of: Callable, most: float | None) -> Figure:
    """A statistic with its upper limit."""
    goal = "" if most is None else f"<= {most:g}"
    if len(values) == 0:
        return Figure(what, None, goal, 0, None, None)
    value = float(of(np.asarray(values)))
    return Figure(what, value, goal, len(values), None, None if most is None else value <= most)


def figures(cases: Sequence[Judged]) -> list[Figure]:
    """All that can be said without an oracle."""
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
        share("strong: right name and nothing else", (c.right for c in strong), least=0.95),
        share("mild: right name and nothing else", (c.right for c in mild), least=0.85),
        share("mild: a wrong name", (bool(c.wrong) for c in mild), most=0.03),
        share("single: true name given or among two alternatives",
              (c.listed == c.library for c in seen), least=0.98),
        share("below the detection limit: silence or the right answer",
              (c.silent or (c.named == c.library and bool(c.named)) or c.right for c in under),
              least=0.99),
        share("nothing missing: false names", (bool(c.named) for c in null), most=0.01),
        share("nothing missing: said so", (c.silent for c in null)),
        share("outside the library: said so", (c.said_outside for c in outside), least=0.90),
        share("outside the library: right place",
              (c.said_outside and c.right_slot for c in outside), least=0.75),
        share("library effect called unknown",
              (c.verdict == "unnamed" for c in seen + form), most=0.05),
        share("other form: right name and no other",
              (c.named == c.library for c in form), least=0.90),
        share("pair: both and only both", (c.named == c.library for c in pair), least=0.85),
        share("four: terms found",
              (name in c.named for c in four for name in sorted(c.seen)), least=0.90),
        number("four: spurious names a case", [len(c.wrong) for c in four], np.mean, 0.25),
        share("masked: right name and nothing else", (c.right for c in masked)),
        share("masked: a wrong name", (bool(c.wrong) for c in masked)),
        *_parameters(cases),
        *_distances(cases),
        share("held-out RMSE not above before",
              (c.after <= c.before * 1.001 for c in cases), least=1.0),
        *_costs(cases),
    ]  # fmt: skip


def _distances(cases: Sequence[Judged]) -> list[Figure]:
    acting = [c for c in cases if c.effects]
    return [
        number(f"held-out RMSE with an effect, {stage}, median", values, np.median, None)
        for stage, values in (
            ("before", [c.before for c in acting]),
            ("refitted", [c.refit for c in acting]),
            ("after", [c.after for c in acting]),
        )
    ]


def _parameters(cases: Sequence[Judged]) -> list[Figure]:
    made = [item for c in cases for item in c.estimates]
    errors = [item.error for item in made]
    return [
        number("parameters: median relative error", errors, np.median, 0.10),
        share(
            "parameters: 95 % intervals that hold the truth",
            (item.covered for item in made),
            least=0.92,
            most=0.98,
        ),
    ]


def _costs(cases: Sequence[Judged]) -> list[Figure]:
    started = [c for c in cases if not c.first]
    few = [c.seconds for c in started if c.kind != "four"]
    many = [c.seconds for c in started if c.kind == "four"]
    return [
        number("seconds a case, longest", few, np.max, 60.0),
        number("seconds a case, median", few, np.median, None),
        number("seconds a case with four effects, longest", many, np.max, 180.0),
        number("memory, MiB, most", [c.peak for c in cases], np.max, 1024.0),
    ]


def _in_class(case: Judged) -> bool:
    return any(case.wrong & group and case.library & group for group in CLASSES)


def second(before: dict[str, Judged], after: dict[str, Judged]) -> Figure:
    """Share of the confusable cases that the breaths asked for have resolved.

    Confusable: alternatives were listed, or a name of the same class was given for the true one.
    """
    cases = [
        after[name].resolved
        for name, first in before.items()
        if name in after and (first.open or _in_class(first))
    ]
    return share("confusable cases resolved by five more breaths", cases, least=0.80)
