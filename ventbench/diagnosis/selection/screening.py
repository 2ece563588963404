"""First-order ranking of what could be added to a hypothesis, without a fit.

A mechanism is simulated at several strengths, and each change of the prediction is a template (see
:mod:`ventbench.diagnosis.hypothesis`). A nonparametric basis term is linear in its coefficients,
so that its best gain follows from the derivatives.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.hypothesis import (
    FittedModel,
    Hypothesis,
    Linearisation,
    linearise,
    varies_by_breath,
)
from ventbench.diagnosis.patient_effort import breath_term
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.physics.catalogue import (
    basis_terms,
    intermittent,
    library,
    mechanism,
    parameter,
    paths,
)
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.system_id.data import Floats
from ventbench.system_id.predictor import Predictor
from ventbench.system_id.problem import BETWEEN

#: Least and largest multiple of a template that starts a fit; first order does not hold far.
_STEPS = (0.2, 3.0)

#: Nats by which another shape than the default must promise more to be fitted from the start; a
#: parameter costs about half the logarithm of the samples.
_SHAPE_PROMISE = 4.0

#: Directions of one compiled derivative.
_AT_ONCE = 16


@dataclass(frozen=True)
class Candidate:
    """A term that may be missing."""

    name: str  #: name of the term.
    hypothesis: Hypothesis  #: what it adds.
    start: dict[str, float]  #: values to start a fit from, by path.
    nats: float  #: log-likelihood that it is expected to gain.
    white_nats: float  #: log-likelihood that it would gain if the noise were white.
    #: values at the other settings of its grid that promise something, by path: a gas that rings
    #: has a local minimum for each number of periods between two samples.
    other_starts: tuple[dict[str, float], ...] = ()

    @property
    def promise(self) -> float:
        """The larger expected gain of the two, nats."""
        return max(self.nats, self.white_nats)


def screen_mechanisms(
    fitted: FittedModel, whitened: FittedModel, names: tuple[str, ...] | None = None
) -> list[Candidate]:
    """Rank the mechanisms that a hypothesis does not have, the most promising first.

    A strong effect makes the residual look like coloured noise, and whitening by that noise removes
    most of what tells mechanisms apart. They are therefore ranked with it and with white noise, and
    the two rankings are interleaved.

    Args:
        fitted: the hypothesis.
        whitened: the hypothesis, fitted at white noise.
        names: mechanisms to rank; the whole library if None.
    """
    linear = [linearise(model.problem, model.minimum.x) for model in (fitted, whitened)]
    predictor = fitted.problem.predictor
    missing = [name for name in names or library() if name not in fitted.names]

    def candidate(name: str) -> Candidate:
        screened = breath_term((name,)).screen(linear)
        if screened is None:
            return _screen(predictor, linear, name)
        nats, white_nats = screened.nats
        return Candidate(name, Hypothesis((name,)), screened.start, nats, white_nats)

    candidates = parallel_map(candidate, missing)
    by_nats = sorted(candidates, key=lambda candidate: -candidate.nats)
    by_white = sorted(candidates, key=lambda candidate: -candidate.white_nats)
    mixed = [candidate for pair in zip(by_nats, by_white, strict=True) for candidate in pair]
    return list({candidate.name: candidate for candidate in mixed}.values())


def _screen(predictor: Predictor, linear: list[Linearisation], name: str) -> Candidate:
    """Simulate a mechanism at all points of its grid, and keep the best.

    A shape parameter is free where another value than its default promises more.
    """
    order = predictor.names
    first, *others = library()[name].description.parameters
    best, start, simulated = np.zeros(len(linear)), {}, {}
    own = [f"{name}.{first.name}", *(f"{name}.{p.name}" for p in others)]
    grids = [first.screening_strengths(), *(other.grid or (None,) for other in others)]
    shapes = {f"{name}.{p.name}": p.neutral for p in others if p.shape and not p.discrete}
    usual = np.zeros(len(linear))  # the best gains with every shape as it is by default
    starts: dict[tuple[float, ...], tuple[float, dict[str, float]]] = {}
    several = [f"{name}.{p.name}" for p in others if p.grid and not p.shape]
    work, points = [], []
    for setting, (k, linearisation) in product(product(*grids), enumerate(linear)):
        trial = linearisation.values.copy()
        given = {path: v for path, v in zip(own, setting, strict=True) if v is not None}
        for path, value in given.items():
            trial[:, order.index(path)] = value
        work.append((k, linearisation, given))
        points.append(trial)
    at = next((f"{name}.{p.name}" for p in others if p.change_point), None)
    if at is not None:
        for trial in points:
            trial[:, order.index(at)] = -1.0  # all breaths come after the change
    predictions = predictor.predict_all(np.stack(points))
    for (k, linearisation, given), prediction in zip(work, predictions, strict=True):
        if not np.all(np.isfinite(prediction)):
            continue
        if at is None:
            nats, multiple = linearisation.gain(linearisation.template(prediction))
        else:
            nats, multiple, given[at] = _change_gain(linearisation, prediction)
        if multiple <= 0:
            continue
        if all(given.get(path, neutral) == neutral for path, neutral in shapes.items()):
            usual[k] = max(usual[k], nats)
        step = float(np.clip(multiple, *_STEPS))
        scale = 1.0 if first.kinked else step
        strength = float(np.clip(given[own[0]] * scale, first.low, first.high))
        place = tuple(given[path] for path in several)
        if nats > starts.get(place, (0.0, {}))[0]:
            starts[place] = (nats, given | {own[0]: strength})
        if nats <= best[k]:
            continue
        if nats > best.max():
            start, simulated = given | {own[0]: strength}, given
        best[k] = nats
    fixed = {p: v for p, v in start.items() if parameter(p).discrete and v != parameter(p).neutral}
    asked = float(best.max() - usual.max()) > _SHAPE_PROMISE
    free = tuple(p for p in shapes if asked and start.get(p, shapes[p]) != shapes[p])
    added = Hypothesis((name,), free, tuple(fixed.items()))
    rest = tuple(trial for _, trial in starts.values() if trial != start) if several else ()
    if free and simulated != start:  # a threshold is where it is: no multiple of it says anything
        rest = (*rest, simulated)
    return Candidate(name, added, start, float(best[0]), float(best[1]), rest)


def _change_gain(linearisation: Linearisation, changed: Floats) -> tuple[float, float, float]:
    """What the best multiple of a change after any breath gains, less the price of the choice.

    Args:
        linearisation: the model to first order.
        changed: prediction with the change in all breaths, ``(n, c, T)``.

    Returns:
        Nats, the multiple, and the position between two breaths.
    """
    white = linearisation.whiten(changed - linearisation.prediction)[:, None]
    white = linearisation.without_own(white)[:, 0]
    position, n = linearisation.problem.data.position, len(white)
    order = np.argsort(position)[::-1]  # the last breath is always changed
    basis = linearisation.shared_basis.reshape(-1, *white.shape)
    absorbed = np.cumsum(np.einsum("snm,nm->ns", basis, white)[order], axis=0)
    power = np.cumsum(np.sum(white**2, axis=1)[order]) - np.sum(absorbed**2, axis=1)
    force = -np.cumsum(np.sum(linearisation.residual * white, axis=1)[order])
    places = np.arange(1, n - 2)  # at least two breaths on either side
    places = places[position[order][places] > position[order][places + 1]]
    if not len(places):
        return 0.0, 0.0, 0.5
    power, force = np.maximum(power[places], 1e-12), force[places]
    nats = 0.5 * force**2 / power
    best = int(np.argmax(nats))
    k = places[best]
    later, earlier = position[order][k], position[order][k + 1]
    between = float(earlier + BETWEEN * (later - earlier))
    price = float(np.log(len(places)))
    return max(float(nats[best]) - price, 0.0), float(force[best] / power[best]), between


def nonparametric_terms(settings: SelectionConfig) -> tuple[str, ...]:
    """Basis terms that are candidates."""
    chosen = settings.screening.nonparametric_terms
    return tuple(basis_terms()) if chosen is None else chosen


def library_paths(excluded: Collection[str] = ()) -> tuple[str, ...]:
    """Paths of the parameters of the library without mechanisms that cannot act.

    Those of terms that differ from breath to breath stay in any case, so that test lungs and
    patients share compiled functions.
    """
    return paths(_compiled(excluded))


def all_parameter_paths(
    settings: SelectionConfig, excluded: Collection[str] = ()
) -> tuple[str, ...]:
    """Paths of :func:`library_paths` and of the basis terms that are candidates."""
    return paths((*_compiled(excluded), *nonparametric_terms(settings)))


def _compiled(excluded: Collection[str]) -> tuple[str, ...]:
    kept = tuple(name for name in library() if name not in excluded or varies_by_breath(name))
    return (*kept, *intermittent())


def component_of(term: str) -> str:
    """Public name of the nonparametric component that a basis term belongs to."""
    components = NONPARAMETRIC_COMPONENTS.values()
    return next(component.name for component in components if term in component.terms)


def score_nonparametric_terms(fitted: FittedModel, settings: SelectionConfig) -> list[Candidate]:
    """Rank the basis terms that a hypothesis does not have, the most promising first.

    Args:
        fitted: the hypothesis, with a predictor that has the parameters of all candidates.
        settings: every threshold.
    """
    missing = [name for name in nonparametric_terms(settings) if name not in fitted.names]
    columns = [f"{n}.{p.name}" for n in missing for p in mechanism(n).description.parameters]
    slopes = _slopes(fitted, columns)
    problem, x = fitted.problem, fitted.minimum.x
    white = replace(problem, noise=replace(problem.noise, ar=(0.0, 0.0)))
    linear = [linearise(at, x) for at in (problem, white)]
    projected = [
        linearisation.without_shared(linearisation.without_own(linearisation.whiten(slopes)))
        for linearisation in linear
    ]
    candidates = []
    for name in missing:
        own = [k for k, path in enumerate(columns) if path.startswith(f"{name}.")]
        prior_sd = np.array([parameter(columns[k]).prior()[1] for k in own])
        gains = [
            _linear_gain(linearisation, rows[:, own], prior_sd)
            for linearisation, rows in zip(linear, projected, strict=True)
        ]
        candidates.append(Candidate(name, Hypothesis((name,)), {}, gains[0], gains[1]))
    return sorted(candidates, key=lambda candidate: -candidate.promise)


def _slopes(fitted: FittedModel, columns: list[str]) -> Floats:
    """Derivatives of the prediction by coefficients, ``(n, q, c, T)``."""
    predictor = fitted.problem.predictor
    index = [predictor.names.index(path) for path in columns]
    parts = []
    for first in range(0, len(index), _AT_ONCE):
        some = index[first : first + _AT_ONCE]
        # Filled up to one size, so that one compiled function serves.
        filled = tuple(some + some[:1] * (_AT_ONCE - len(some)))
        parts.append(predictor.derivatives(fitted.values, filled)[1][:, : len(some)])
    return np.concatenate(parts, axis=1)


def _linear_gain(linearisation: Linearisation, rows: Floats, prior_sd: Floats) -> float:
    """Log-likelihood and prior that the best coefficients gain, nats."""
    flat = rows.swapaxes(0, 1).reshape(rows.shape[1], -1)
    force = flat @ linearisation.residual.ravel()
    curvature = flat @ flat.T + np.diag(prior_sd**-2.0)
    return 0.5 * float(force @ np.linalg.solve(curvature, force))
