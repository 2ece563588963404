"""From a bench to a conclusion: names, a slot, or neither."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

from ventbench.diagnosis import moving, places
from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.beside import (
    PROMISING,
    Place,
    Shape,
    beside,
    beside_source,
    effortless,
)
from ventbench.diagnosis.forms import without_trimmings
from ventbench.diagnosis.gate import GATE, believed
from ventbench.diagnosis.hypothesis import Hypothesis, has_own
from ventbench.diagnosis.moving import Moving
from ventbench.diagnosis.rivals import Alternatives, alternatives
from ventbench.diagnosis.search import Progress, forward
from ventbench.diagnosis.simpler import OneShape
from ventbench.diagnosis.solved import Solved
from ventbench.diagnosis.sources import GAIN, MEASUREMENT, SOURCES
from ventbench.diagnosis.steps import MUCH, Step, settle, step
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise
from ventbench.system_id.together import each

#: A source at the sensor is noise unless it is of one frequency and this large, cmH2O.
_HUM = 0.3

#: Nats on held-out breaths from which a source is believed: places, scales and sizes are searched.
_SOURCE = 8.0

#: Share of what sources explain from which it is the gain that differs between breaths.
_SCATTERED = 1.0


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a recording needs.

    Attributes:
        null: the base model, refitted.
        named: with the names alone.
        full: with the slot's element too; ``named`` if there is none.
        place: the slot, or None.
        noise: that is left.
        nats: held-out log-likelihood that is lost without each name.
        alternatives: to each name.
        spread: standard deviation of the logarithm of the breaths' valve gains, 0 if all are one.
        hidden: whether much is missing, and neither a name nor a place is believed.
    """

    null: Solved
    named: Solved
    full: Solved
    place: Place | None
    noise: Noise
    nats: dict[str, float]
    alternatives: dict[str, Alternatives]
    spread: float = 0.0
    hidden: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Mechanisms of the library."""
        return self.named.hypothesis.names


def conclude(bench: Bench, wider: Callable[[], Bench], tell: Progress) -> Conclusion:
    """Name what is missing.

    Args:
        bench: with the library's parameters.
        wider: makes the same bench with those of all slots too.
        tell: is told what is done.
    """
    null = settle(bench, Hypothesis())
    wider = cache(wider)
    named, steps = forward(bench, null, tell, OneShape(bench, wider, null))
    tell("looking for what has no name")
    wide = wider()
    trimmed = without_trimmings(bench, wide, named, tell)
    left = _left(bench, wide, trimmed)
    if trimmed is not named and not left.shaped:
        # What explains the names away must be there in their place.
        left = _left(bench, wide, named)
    else:
        named = trimmed
    if not bench.spread and left.scatter:
        # Everything is asked anew, with a valve whose gain may differ between breaths.
        size = left.scatter
        return conclude(replace(bench, spread=size), lambda: replace(wide, spread=size), tell)
    source, shape = left.source, left.shape
    place, full = None, named
    if source is not None and not left.shaped:
        place, named = source, beside_source(bench, named, source)
        full = named
    elif shape is not None:
        named, shape = beside(bench, wide, named, shape)
        place, full = (
            Place(places.public(shape.element), shape.element, None, shape.nats),
            shape.full,
        )
    tell("comparing alternatives")
    named, other = alternatives(bench, named, steps, swap=place is None)
    full = named if place is None else full
    noise = place.source.noise if place and place.source else full.noise
    hidden = place is None and not named.names and is_hidden(bench, steps)
    return Conclusion(
        null, named, full, place, noise, _losses(bench, named), other, bench.spread, hidden
    )


def is_hidden(bench: Bench, steps: Sequence[Step]) -> bool:
    """Whether something explains much in training, and a little of held-out breaths, unbelieved.

    So do effects that hide each other, each of which alone helps some breaths and harms others.
    What is each breath's own does not count: it explains coloured noise as well.
    """
    if not steps:
        return False
    last = steps[-1]
    least = bench.criterion(last.before) - MUCH
    return any(
        one.criterion < least
        and float((bench.judged(one.solved) - bench.judged(last.before)).sum()) > GATE
        for one in last.rivals
        if not has_own(one.name)
    )


@dataclass(frozen=True, eq=False)
class _Left:
    """What names leave unexplained.

    Attributes:
        shape: best element of a slot, or None.
        source: best source that moves in time, or None.
        scatter: standard deviation of the logarithm of the breaths' gains, 0 if all are one.
    """

    shape: Shape | None
    source: Place | None
    scatter: float

    @property
    def shaped(self) -> bool:
        """Whether a shape explains the most."""
        nats = 0.0 if self.source is None else self.source.nats
        return self.shape is not None and self.shape.nats >= nats


def _left(bench: Bench, wide: Bench, named: Solved) -> _Left:
    shape = _shape(wide, named)
    found = moving.moving(bench, effortless(bench, named), (GAIN, *SOURCES))
    reference = moving.without(bench, named)[1]
    gain = found.pop(GAIN)
    scatter = gain.size if _scattered(gain, found, reference, shape) else 0.0
    return _Left(shape, _source(found, reference), scatter)


def _shape(wide: Bench, named: Solved) -> Shape | None:
    """The element that explains most of what the names leave, if held-out breaths ask for it."""
    here = wide.solve(named.hypothesis, named.noise, named, iterations=3)
    found = step(wide, here, places.scan(here)[:PROMISING])
    if found is None or not believed(found.gained):
        return None
    best = found.rivals[0]
    if wide.criterion(best.solved) > wide.criterion(found.before):
        return None
    nats = float((wide.judged(best.solved) - wide.judged(here)).sum())
    return Shape(best.name, best.solved, nats)


def _scattered(
    gain: Moving, sources: dict[str, Moving], reference: Floats, shape: Shape | None
) -> bool:
    """Whether the breaths' valve gains differ.

    That must explain more than any shape, and most of what sources do that move within breaths.
    """
    gained = gain.judged - reference
    nats = float(gained.sum())
    others = [float((one.judged - reference).sum()) for one in sources.values()]
    if not believed(gained) or (shape is not None and shape.nats > nats):
        return False
    return nats > _SCATTERED * max(others)


def _losses(bench: Bench, named: Solved) -> dict[str, float]:
    here = bench.judged(named)

    def lost(name: str) -> float:
        left = bench.solve(named.hypothesis.without(name), named.noise, named)
        return float((here - bench.judged(left)).sum())

    return dict(zip(named.names, each(lost, named.names), strict=True))


def _source(found: dict[str, Moving], reference: Floats) -> Place | None:
    """A source that moves in time and explains more than the names and than coloured noise."""
    others = dict(found)
    sensor = others.pop(MEASUREMENT)
    best = max(others.values(), key=lambda one: one.training)
    gained = best.judged - reference
    ahead = float((best.judged - sensor.judged).sum())
    if believed(gained, _SOURCE) and ahead > GATE:
        return Place(best.source, None, best, float(gained.sum()))
    gained = sensor.judged - reference
    if believed(gained) and sensor.periodic and sensor.size >= _HUM:
        return Place(MEASUREMENT, None, sensor, float(gained.sum()))
    return None
