"""From a bench to a conclusion: names, a slot, or neither."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ventbench.mismatch.naming import moving, places
from ventbench.mismatch.naming.bench import Bench, Hypothesis, Solved
from ventbench.mismatch.naming.effort import EFFORT
from ventbench.mismatch.naming.moving import Moving
from ventbench.mismatch.naming.rivals import Alternatives, alternatives
from ventbench.mismatch.naming.search import (
    GATE,
    Progress,
    believed,
    forward,
    noise_of,
    settle,
    step,
)
from ventbench.mismatch.naming.sources import MEASUREMENT
from ventbench.physics.fits.noise import Noise

#: Share of what a slot of the same kind explains from which a name stands, its form apart; and
#: share below which a name beside a slot is only its trimming.
_FAMILY, _TRIMMING = 0.5, 0.15

#: A source at the sensor is noise unless it is of one frequency and this large, cmH2O.
_HUM = 0.3


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
    """

    null: Solved
    named: Solved
    full: Solved
    place: Place | None
    noise: Noise
    nats: dict[str, float]
    alternatives: dict[str, Alternatives]

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
    named, steps = forward(bench, null, tell)
    tell("looking for what has no name")
    place, named, full = _place(bench, wider, named)
    tell("comparing alternatives")
    if place is None:
        named, other = alternatives(bench, named, steps)
        full = named
    else:
        named, other = alternatives(bench, named, steps, swap=False)
    noise = place.source.noise if place and place.source else full.noise
    return Conclusion(null, named, full, place, noise, _losses(bench, named), other)


def _losses(bench: Bench, named: Solved) -> dict[str, float]:
    found = {}
    for name in named.hypothesis.names:
        left = bench.solve(named.hypothesis.without(name), named.noise, named)
        found[name] = float((bench.judged(named) - bench.judged(left)).sum())
    return found


def _place(
    bench: Bench, wider: Callable[[], Bench], named: Solved
) -> tuple[Place | None, Solved, Solved]:
    source = _source(bench, named)
    wide = wider()
    here = wide.solve(named.hypothesis, named.noise, named, iterations=3)
    found = step(wide, here, places.scan(here))
    gained = 0.0
    if found is not None and believed(found.gained):
        best = found.rivals[0]
        gained = float((wide.judged(best.solved) - wide.judged(here)).sum())
    if source is not None and source.nats > max(gained, 0.0):
        return source, _beside_source(bench, named, source), named
    if found is None or not believed(found.gained):
        return None, named, named
    element, full = found.rivals[0].name, found.rivals[0].solved
    return _beside(bench, wide, named, element, full, gained)


def _source(bench: Bench, named: Solved) -> Place | None:
    """A source that moves in time and explains more than the names and than coloured noise."""
    base = named
    if EFFORT in named.hypothesis.names:
        base = bench.solve(named.hypothesis.without(EFFORT), named.noise, named)
    found = moving.moving(bench, base)
    reference = moving.without(bench, named)[1]
    sensor = found.pop(MEASUREMENT)
    best = max(found.values(), key=lambda one: one.training)
    gained = best.judged - reference
    ahead = float((best.judged - sensor.judged).sum())
    if believed(gained) and ahead > GATE:
        return Place(best.source, None, best, float(gained.sum()))
    gained = sensor.judged - reference
    if believed(gained) and sensor.periodic and sensor.size >= _HUM:
        return Place(MEASUREMENT, None, sensor, float(gained.sum()))
    return None


def _beside_source(bench: Bench, named: Solved, place: Place) -> Solved:
    """Keep the names that are needed beside a source."""
    assert place.source is not None
    current = named
    if EFFORT in current.hypothesis.names:
        current = bench.solve(current.hypothesis.without(EFFORT), current.noise, current)
    here = place.source
    for name in current.hypothesis.names:
        left = bench.solve(current.hypothesis.without(name), current.noise, current)
        other = moving.moving(bench, left, (place.name,))[place.name]
        if not believed(here.judged - other.judged):
            current, here = left, other
    return current


def _beside(
    bench: Bench, wide: Bench, named: Solved, element: str, full: Solved, nats: float
) -> tuple[Place | None, Solved, Solved]:
    """Keep the names that are needed beside a slot, and those whose form it only trims."""
    kept = named.hypothesis
    for name in named.hypothesis.names:
        left = wide.solve(full.hypothesis.without(name), full.noise, full)
        if name in places.holds(element):
            least = settle(bench, kept.without(name), named)
            whole = _quiet(least) - _quiet(full)
            if _quiet(least) - _quiet(named) >= _FAMILY * whole:
                continue
        share = (_quiet(left) - _quiet(full)) / max(_total(bench, named, full), 1e-9)
        if not believed(wide.judged(full) - wide.judged(left)) or share < _TRIMMING:
            full, kept = settle(wide, left.hypothesis, left), kept.without(name)
    if kept != named.hypothesis:
        named = settle(bench, kept, named)
    if not kept.names:
        # Chosen anew, without names that took part of the effect.
        null = wide.solve(Hypothesis(), named.noise, named)
        again = step(wide, null, places.scan(null))
        if again is not None and believed(again.gained):
            element, full = again.rivals[0].name, again.rivals[0].solved
            nats = float(again.gained.sum())
    return Place(places.public(element), element, None, nats), named, full


def _total(bench: Bench, named: Solved, full: Solved) -> float:
    return _quiet(settle(bench, Hypothesis(), named)) - _quiet(full)


def _quiet(solved: Solved) -> float:
    """Logarithm of what is new in each sample of the residual, cmH2O."""
    noise = noise_of(solved)
    return float(np.log(noise.sigma[0] * np.sqrt(1.0 - noise.ar[0] ** 2)))
