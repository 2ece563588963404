"""What each mechanism would add to a prediction, at several strengths.

Slots as candidates: what any shape at each place of the physics could explain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.linearisation import Linearisation, gain, linearise
from ventbench.diagnosis.patient_effort import EFFORT, evidence
from ventbench.physics.catalogue import basis_terms, library, mechanism, parameter, paths
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.system_id.data import Floats
from ventbench.system_id.derivatives import Simulator
from ventbench.system_id.together import each

#: A multiple of a template beyond these is not believed.
_LEAST, _MOST = 0.2, 3.0


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


def screen_mechanisms(
    fitted: FittedModel, whitened: FittedModel, known: tuple[str, ...] | None = None
) -> list[Candidate]:
    """All mechanisms that a hypothesis lacks, the most promising first.

    A strong effect makes the residual look like coloured noise, and whitening that takes out most
    of what tells mechanisms apart: they are ranked with and without.

    Args:
        fitted: the hypothesis, fitted.
        whitened: the same at white noise.
        known: mechanisms to look at; the whole library if not given.
    """
    places = [linearise(one.problem, one.minimum.x) for one in (fitted, whitened)]
    simulator = fitted.problem.simulator
    missing = [name for name in known or library() if name not in fitted.names]
    found = each(
        lambda name: _effort(places) if name == EFFORT else _best(simulator, places, name), missing
    )
    by_nats = sorted(found, key=lambda one: -one.nats)
    by_white = sorted(found, key=lambda one: -one.white)
    mixed = [one for pair in zip(by_nats, by_white, strict=True) for one in pair]
    return list({one.name: one for one in mixed}.values())


def _best(simulator: Simulator, places: list[Linearisation], name: str) -> Candidate:
    order = simulator.names
    first, *others = library()[name].description.parameters
    best, start = np.zeros(len(places)), {}
    paths = [f"{name}.{first.name}", *(f"{name}.{p.name}" for p in others)]
    choices = [first.screening_strengths(), *(other.grid or (None,) for other in others)]
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
    held = {p: v for p, v in start.items() if parameter(p).discrete and v != parameter(p).neutral}
    return Candidate(name, Hypothesis((name,), (), tuple(held.items())), start, *map(float, best))


def _effort(places: list[Linearisation]) -> Candidate:
    found = [evidence(place) for place in places]
    nats = [max(float(one.nats.sum()), 0.0) for one in found]
    start = {f"{EFFORT}.duration": found[int(np.argmax(nats))].duration}
    return Candidate(EFFORT, Hypothesis((EFFORT,)), start, *nats)


#: Directions whose derivatives are taken at once.
_TOGETHER = 16


def all_parameter_paths() -> tuple[str, ...]:
    """Parameters of the library and of all slots."""
    return paths((*library(), *basis_terms()))


def component_of(element: str) -> str:
    """Public name of the nonparametric component that a basis term belongs to."""
    components = NONPARAMETRIC_COMPONENTS.values()
    return next(component.name for component in components if element in component.terms)


def score_nonparametric_terms(fitted: FittedModel) -> list[Candidate]:
    """Every element that a hypothesis lacks, by what it gains to first order, the best first.

    Args:
        fitted: fitted with a simulator of all slots' parameters.
    """
    missing = [name for name in basis_terms() if name not in fitted.hypothesis.names]
    columns = [f"{n}.{p.name}" for n in missing for p in mechanism(n).description.parameters]
    slopes = _slopes(fitted, columns)
    problem, x = fitted.problem, fitted.minimum.x
    white = replace(problem, noise=replace(problem.noise, ar=(0.0, 0.0)))
    places = [linearise(problem, x), linearise(white, x)]
    projected = [_projected(place, slopes) for place in places]
    found = []
    for name in missing:
        own = [k for k, path in enumerate(columns) if path.startswith(f"{name}.")]
        spread = np.array([parameter(columns[k]).prior()[1] for k in own])
        gains = [
            _gain(place, rows[:, own], spread)
            for place, rows in zip(places, projected, strict=True)
        ]
        found.append(Candidate(name, Hypothesis((name,)), {}, *gains))
    return sorted(found, key=lambda one: -max(one.nats, one.white))


def _slopes(fitted: FittedModel, columns: list[str]) -> Floats:
    """Derivatives of the prediction by coefficients, ``(n, q, c, T)``."""
    simulator = fitted.problem.simulator
    index = [simulator.names.index(path) for path in columns]
    parts = []
    for first in range(0, len(index), _TOGETHER):
        some = index[first : first + _TOGETHER]
        # Always as many, so that one compiled function serves.
        filled = tuple(some + some[:1] * (_TOGETHER - len(some)))
        parts.append(simulator.derivatives(fitted.values, filled)[1][:, : len(some)])
    return np.concatenate(parts, axis=1)


def _projected(place: Linearisation, slopes: Floats) -> Floats:
    return place.without_shared(place.without_own(place.whitened(slopes)))


def _gain(place: Linearisation, rows: Floats, spread: Floats) -> float:
    """Nats that the best coefficients gain, with their prior."""
    flat = rows.swapaxes(0, 1).reshape(rows.shape[1], -1)
    force = flat @ place.residual.ravel()
    curvature = flat @ flat.T + np.diag(spread**-2.0)
    return 0.5 * float(force @ np.linalg.solve(curvature, force))
