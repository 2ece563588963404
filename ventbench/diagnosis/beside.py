"""Which names are needed beside something that has none."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from ventbench.diagnosis import moving, places
from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.effort import EFFORT
from ventbench.diagnosis.gate import believed, needed
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.moving import Moving
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.sources import ALVEOLUS
from ventbench.diagnosis.steps import settle, step
from ventbench.system_id.together import each

#: Share of what a slot of the same kind explains from which a name stands, its form apart; and
#: share below which a name beside a slot is only its trimming.
_FAMILY, _TRIMMING = 0.5, 0.1

#: Elements of slots that are refitted: the first-order ranking has the right one near its top.
PROMISING = 5


@dataclass(frozen=True, eq=False)
class Place:
    """Where something without a name sits.

    Attributes:
        name: public name of the slot.
        element: of the physics that has its shape, or None for a source that moves in time.
        source: that source, or None.
        nats: held-out log-likelihood that it gains.
    """

    name: str
    element: str | None
    source: Moving | None
    nats: float


@dataclass(frozen=True, eq=False)
class Shape:
    """An element of a slot beside names.

    Attributes:
        element: its name.
        full: fitted with the names.
        nats: held-out log-likelihood that it gains.
    """

    element: str
    full: Solved
    nats: float


def effortless(bench: Bench, named: Solved) -> Solved:
    """The same names without efforts of the patient, which sources take the place of."""
    if EFFORT not in named.hypothesis.names:
        return named
    return bench.solve(named.hypothesis.without(EFFORT), named.noise, named)


def beside_source(bench: Bench, named: Solved, place: Place) -> Solved:
    """Keep the names that are needed beside a source, and those that explain more than it does.

    A source is each breath's own and takes over what is the same in all breaths as well.
    """
    assert place.source is not None
    current, here = effortless(bench, named), place.source
    gains = each(partial(_gain, bench, current), current.names)
    firm = {name for name, gain in zip(current.names, gains, strict=True) if gain > place.nats}
    if _is_effort(bench, named, current, here):
        current = named
    while True:
        asked = [name for name in current.names if name != EFFORT and name not in firm]
        idle = [x for x in each(partial(_idle, bench, current, here), asked) if x is not None]
        if not idle:
            return current
        # The least needed one first: others may be needed once it has gone.
        _, current, here = min(idle, key=lambda found: found[0])


def _gain(bench: Bench, named: Solved, name: str) -> float:
    """Held-out log-likelihood that a name gains beside the others."""
    left = bench.solve(named.hypothesis.without(name), named.noise, named)
    return float((bench.judged(named) - bench.judged(left)).sum())


def _idle(
    bench: Bench, current: Solved, here: Moving, name: str
) -> tuple[float, Solved, Moving] | None:
    """Nats that are lost without a name beside a source, and what is left, if it is not needed."""
    left = bench.solve(current.hypothesis.without(name), current.noise, current)
    other = moving.moving(bench, effortless(bench, left), (here.source,))[here.source]
    lost = here.judged - other.judged
    return None if believed(lost) else (float(lost.sum()), left, other)


def _is_effort(bench: Bench, named: Solved, without: Solved, source: Moving) -> bool:
    """Whether a source is an effort of another form: efforts explain most of what it does."""
    if EFFORT not in named.hypothesis.names or source.periodic or source.source != ALVEOLUS:
        return False
    none = moving.without(bench, without)[1].sum()
    by_name = moving.without(bench, named)[1].sum() - none
    return bool(by_name >= _FAMILY * (source.judged.sum() - none))


def beside(bench: Bench, wide: Bench, named: Solved, shape: Shape) -> tuple[Solved, Shape]:
    """Keep the names that are needed beside a shape, and those whose form it only trims."""
    element, full, nats = shape.element, shape.full, shape.nats
    kept = named.hypothesis
    for name in named.hypothesis.names:
        left = wide.solve(full.hypothesis.without(name), full.noise, full)
        whole = full.log_likelihood - _null(wide, full)
        if name in places.holds(element):
            least = bench.solve(kept.without(name), named.noise, named)
            by_name = named.likelihood_at(full.noise) - least.likelihood_at(full.noise)
            by_both = full.log_likelihood - least.likelihood_at(full.noise)
            if by_name >= _FAMILY * by_both:
                continue
        share = (full.log_likelihood - left.log_likelihood) / max(whole, 1e-9)
        if not needed(wide, full, left) or share < _TRIMMING:
            full, kept = settle(wide, left.hypothesis, left), kept.without(name)
    if kept != named.hypothesis:
        named = settle(bench, kept, named)
    if not kept.names:
        # Chosen anew, without names that took part of the effect.
        null = wide.solve(Hypothesis(), named.noise, named)
        again = step(wide, null, places.scan(null)[:PROMISING])
        if again is not None and believed(again.gained):
            element, full = again.rivals[0].name, again.rivals[0].solved
            nats = float(again.gained.sum())
    return named, Shape(element, full, nats)


def _null(wide: Bench, full: Solved) -> float:
    """Log-likelihood of the base model at the noise of a hypothesis."""
    return wide.solve(Hypothesis(), full.noise, full).log_likelihood
