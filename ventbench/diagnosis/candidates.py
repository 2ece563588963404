"""What each mechanism would add to a prediction, at several strengths."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from ventbench.diagnosis.effort import EFFORT, evidence
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.linear import Local, gain, local
from ventbench.diagnosis.solved import Solved
from ventbench.physics.catalogue import library, parameter
from ventbench.physics.parameters import Parameter
from ventbench.system_id.derivatives import Simulator
from ventbench.system_id.together import each

#: A multiple of a template beyond these is not believed.
_LEAST, _MOST = 0.2, 3.0

#: Values that are tried of parameters other than the strength, by path.
_ALSO = {
    "viscoelasticity.time": (0.2, 0.5, 1.5),
    "command_rounding.bias": (0.0, 0.5),
    "valve_curve.power": (1.0, 3.0),
    "leak.exponent": (0.5, 1.0),
}

#: Parameters without a derivative: a candidate holds them at the value that was tried.
HELD = ("command_rounding.bias",)


@dataclass(frozen=True)
class Candidate:
    """A mechanism that may be missing.

    Attributes:
        name: of the mechanism.
        hypothesis: what it adds.
        start: values to start a fit from, by path.
        nats: that it is expected to gain, to first order.
        white: likewise, were the noise white.
    """

    name: str
    hypothesis: Hypothesis
    start: dict[str, float]
    nats: float
    white: float


def screen(
    solved: Solved, whitened: Solved, known: tuple[str, ...] | None = None
) -> list[Candidate]:
    """All mechanisms that a hypothesis lacks, the most promising first.

    A strong effect makes the residual look like coloured noise, and whitening that takes out most
    of what tells mechanisms apart: they are ranked with and without.

    Args:
        solved: the hypothesis, fitted.
        whitened: the same at white noise.
        known: mechanisms to look at; the whole library if not given.
    """
    places = [local(one.problem, one.minimum.x) for one in (solved, whitened)]
    simulator = solved.problem.simulator
    missing = [name for name in known or library() if name not in solved.names]
    found = each(
        lambda name: _effort(places) if name == EFFORT else _best(simulator, places, name), missing
    )
    by_nats = sorted(found, key=lambda one: -one.nats)
    by_white = sorted(found, key=lambda one: -one.white)
    mixed = [one for pair in zip(by_nats, by_white, strict=True) for one in pair]
    return list({one.name: one for one in mixed}.values())


def _best(simulator: Simulator, places: list[Local], name: str) -> Candidate:
    order = simulator.names
    first, *others = library()[name].description.parameters
    best, start = np.zeros(len(places)), {}
    paths = [f"{name}.{first.name}", *(f"{name}.{p.name}" for p in others)]
    choices = [strengths(first), *(_ALSO.get(path, ()) or (None,) for path in paths[1:])]
    work, points = [], []
    for setting, (k, place) in product(product(*choices), enumerate(places)):
        trial = place.values.copy()
        given = {p: v for p, v in zip(paths, setting, strict=True) if v is not None}
        for path, value in given.items():
            trial[:, order.index(path)] = value
        work.append((k, place, given))
        points.append(trial)
    for (k, place, given), seen in zip(work, simulator.predict_all(np.stack(points)), strict=True):
        if not np.all(np.isfinite(seen)):
            continue
        nats, share = gain(place, place.template(seen))
        if share <= 0 or nats <= best[k]:
            continue
        if nats > best.max():
            scale = 1.0 if first.kinked else float(np.clip(share, _LEAST, _MOST))
            strength = float(np.clip(given[paths[0]] * scale, first.low, first.high))
            start = given | {paths[0]: strength}
        best[k] = nats
    held = {p: v for p, v in start.items() if p in HELD and v != parameter(p).neutral}
    return Candidate(name, Hypothesis((name,), (), tuple(held.items())), start, *map(float, best))


def _effort(places: list[Local]) -> Candidate:
    found = [evidence(place) for place in places]
    nats = [max(float(one.nats.sum()), 0.0) for one in found]
    start = {f"{EFFORT}.duration": found[int(np.argmax(nats))].duration}
    return Candidate(EFFORT, Hypothesis((EFFORT,)), start, *nats)


def strengths(item: Parameter) -> tuple[float, ...]:
    """Strengths at which a mechanism's effect is looked at."""
    if item.scan:
        return tuple(x for x in item.scan if x != item.neutral)
    both = (0.3 * item.mild, item.mild, item.strong)
    return (*both, *(-x for x in both if -x >= item.low))
