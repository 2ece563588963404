"""One answer against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ventbench.validation.challenge import truth
from ventbench.validation.challenge.plan import Drawn, Kind

#: Names besides the first that may be listed.
_LISTED = 2


@dataclass(frozen=True)
class Estimated:
    """A parameter: what was found and what is true.

    Attributes:
        path: of the parameter.
        value: found.
        low: end of its 95 % interval.
        high: other end.
        true: as seen with the nominal valve gain.
    """

    path: str
    value: float
    low: float
    high: float
    true: float

    @property
    def error(self) -> float:
        """Relative, without sign."""
        return abs(self.value - self.true) / abs(self.true)

    @property
    def covered(self) -> bool:
        """Whether the interval holds the truth."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Judged:
    """One case.

    Attributes:
        name: of the case.
        kind: of the question.
        lung: label.
        strengths: of the effects.
        effects: names, in the rig.
        library: of these, the library's (or what is as good).
        seen: effects above the detection limit.
        verdict: that was given.
        named: mechanisms that were named.
        listed: true mechanisms that were named or listed as one of two alternatives.
        open: the answer names alternatives.
        slot: that was given, or None.
        right_slot: it is one of the effect's.
        estimates: of the parameters of rightly named effects in the library's form.
        before: held-out open-loop RMSE, cmH2O.
        refit: likewise.
        after: likewise.
        seconds: that the answer took.
        peak: memory, MiB.
        first: it was the first of its process, with compilation.
    """

    name: str
    kind: Kind
    lung: str
    strengths: tuple[str, ...]
    effects: tuple[str, ...]
    library: frozenset[str]
    seen: frozenset[str]
    verdict: str
    named: frozenset[str]
    listed: frozenset[str]
    open: bool
    slot: str | None
    right_slot: bool
    estimates: tuple[Estimated, ...]
    before: float
    refit: float
    after: float
    seconds: float
    peak: float
    first: bool

    @property
    def visible(self) -> bool:
        """Every effect is above the detection limit."""
        return self.seen == frozenset(self.effects)

    @property
    def silent(self) -> bool:
        """Nothing was said to be missing."""
        return self.verdict == "nothing_missing"

    @property
    def right(self) -> bool:
        """All true names, no other name and no place without a name."""
        if self.kind == "outside":
            return self.said_outside and self.right_slot
        if not self.effects:
            return self.silent
        return self.verdict == "named" and self.named == self.library and self.slot is None

    @property
    def wrong(self) -> frozenset[str]:
        """Names that are not in the rig."""
        return self.named - self.library

    @property
    def said_outside(self) -> bool:
        """It was said that the library lacks the effect, or a name that is as good was given."""
        as_good = bool(self.library) and self.named == self.library
        return self.verdict == "unnamed" or as_good

    @property
    def resolved(self) -> bool:
        """Right, and without alternatives."""
        return self.right and not self.open


def judge(drawn: Drawn, worth: list[float], answer: dict[str, Any]) -> Judged:
    """Compare.

    Args:
        drawn: the case.
        worth: nats of its effects.
        answer: file of the answer.
    """
    case, found = drawn.case, answer["diagnosis"]
    library = truth.acceptable(case)
    given = found["mechanisms"]
    named = frozenset(item["name"] for item in given)
    alternatives = {name for item in given for name in item["alternatives"][:_LISTED]}
    slot = found["slot"]["name"] if found["slot"] else None
    as_good = drawn.kind == "outside" and bool(library) and named == library
    return Judged(
        name=case.name,
        kind=drawn.kind,
        lung=case.lung,
        strengths=tuple(item.strength for item in case.effects),
        effects=tuple(item.name for item in case.effects),
        library=library,
        seen=truth.seen(case, worth),
        verdict=found["verdict"],
        named=named,
        listed=library & (named | alternatives),
        open=any(item["alternatives"] for item in given),
        slot=slot,
        right_slot=slot in truth.slots(case) or as_good,
        estimates=_estimates(truth.values(case), given),
        before=found["open_loop"]["before"]["rmse"],
        refit=found["open_loop"]["refit"]["rmse"],
        after=found["open_loop"]["after"]["rmse"],
        seconds=answer["seconds"],
        peak=answer["peak_mib"],
        first=answer["first_in_process"],
    )


def _estimates(true: dict[str, float], given: list[dict[str, Any]]) -> tuple[Estimated, ...]:
    made = []
    for item in given:
        for key, value in item["parameters"].items():
            path = f"{item['name']}.{key}"
            low, high = value["ci95"]
            if path in true and None not in (low, high, value["value"]):
                made.append(Estimated(path, value["value"], low, high, true[path]))
    return tuple(made)
