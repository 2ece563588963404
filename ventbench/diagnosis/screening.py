"""First-order ranking of what could be added to a hypothesis, without a fit.

A mechanism is simulated at several strengths, and each change of the prediction is a template (see
:mod:`ventbench.diagnosis.linearisation`). A nonparametric basis term is linear in its coefficients,
so that its best gain follows from the derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.linearisation import Linearisation, linearise
from ventbench.diagnosis.patient_effort import breath_term
from ventbench.diagnosis.settings import ScreeningSettings, SelectionConfig
from ventbench.executor import parallel_map
from ventbench.physics.catalogue import basis_terms, library, mechanism, parameter, paths
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.system_id.data import Floats
from ventbench.system_id.predictor import Predictor


@dataclass(frozen=True)
class Candidate:
    """A term that may be missing.

    Attributes:
        name: name of the term.
        hypothesis: what it adds.
        start: values to start a fit from, by path.
        nats: log-likelihood that it is expected to gain.
        white_nats: log-likelihood that it would gain if the noise were white.
    """

    name: str
    hypothesis: Hypothesis
    start: dict[str, float]
    nats: float
    white_nats: float

    @property
    def promise(self) -> float:
        """The larger expected gain of the two, nats."""
        return max(self.nats, self.white_nats)


def screen_mechanisms(
    fitted: FittedModel,
    whitened: FittedModel,
    settings: SelectionConfig,
    names: tuple[str, ...] | None = None,
) -> list[Candidate]:
    """Rank the mechanisms that a hypothesis does not have, the most promising first.

    A strong effect makes the residual look like coloured noise, and whitening by that noise removes
    most of what tells mechanisms apart. They are therefore ranked with it and with white noise, and
    the two rankings are interleaved.

    Args:
        fitted: the hypothesis.
        whitened: the hypothesis, fitted at white noise.
        settings: every threshold.
        names: mechanisms to rank; the whole library if None.
    """
    linear = [
        linearise(model.problem, model.minimum.x, settings.screening)
        for model in (fitted, whitened)
    ]
    predictor = fitted.problem.predictor
    missing = [name for name in names or library() if name not in fitted.names]

    def candidate(name: str) -> Candidate:
        screened = breath_term((name,), settings).screen(linear)
        if screened is None:
            return _screen(predictor, linear, name, settings.screening)
        return Candidate(name, Hypothesis((name,)), screened.start, *screened.nats)

    candidates = parallel_map(candidate, missing)
    by_nats = sorted(candidates, key=lambda candidate: -candidate.nats)
    by_white = sorted(candidates, key=lambda candidate: -candidate.white_nats)
    mixed = [candidate for pair in zip(by_nats, by_white, strict=True) for candidate in pair]
    return list({candidate.name: candidate for candidate in mixed}.values())


def _screen(
    predictor: Predictor, linear: list[Linearisation], name: str, settings: ScreeningSettings
) -> Candidate:
    """Simulate a mechanism at all points of its grid, and keep the best."""
    order = predictor.names
    first, *others = library()[name].description.parameters
    best, start = np.zeros(len(linear)), {}
    own = [f"{name}.{first.name}", *(f"{name}.{p.name}" for p in others)]
    grids = [first.screening_strengths(), *(other.grid or (None,) for other in others)]
    work, points = [], []
    for setting, (k, linearisation) in product(product(*grids), enumerate(linear)):
        trial = linearisation.values.copy()
        given = {path: v for path, v in zip(own, setting, strict=True) if v is not None}
        for path, value in given.items():
            trial[:, order.index(path)] = value
        work.append((k, linearisation, given))
        points.append(trial)
    predictions = predictor.predict_all(np.stack(points))
    for (k, linearisation, given), prediction in zip(work, predictions, strict=True):
        if not np.all(np.isfinite(prediction)):
            continue
        nats, multiple = linearisation.gain(linearisation.template(prediction))
        if multiple <= 0 or nats <= best[k]:
            continue
        if nats > best.max():
            step = float(np.clip(multiple, settings.min_step, settings.max_step))
            scale = 1.0 if first.kinked else step
            strength = float(np.clip(given[own[0]] * scale, first.low, first.high))
            start = given | {own[0]: strength}
        best[k] = nats
    fixed = {p: v for p, v in start.items() if parameter(p).discrete and v != parameter(p).neutral}
    return Candidate(name, Hypothesis((name,), (), tuple(fixed.items())), start, *map(float, best))


def nonparametric_terms(settings: SelectionConfig) -> tuple[str, ...]:
    """Basis terms that are candidates."""
    chosen = settings.screening.nonparametric_terms
    return tuple(basis_terms()) if chosen is None else chosen


def all_parameter_paths(settings: SelectionConfig) -> tuple[str, ...]:
    """Paths of the parameters of the library and of the basis terms that are candidates."""
    return paths((*library(), *nonparametric_terms(settings)))


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
    slopes = _slopes(fitted, columns, settings.screening.derivatives_at_once)
    problem, x = fitted.problem, fitted.minimum.x
    white = replace(problem, noise=replace(problem.noise, ar=(0.0, 0.0)))
    linear = [linearise(at, x, settings.screening) for at in (problem, white)]
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
        candidates.append(Candidate(name, Hypothesis((name,)), {}, *gains))
    return sorted(candidates, key=lambda candidate: -candidate.promise)


def _slopes(fitted: FittedModel, columns: list[str], together: int) -> Floats:
    """Derivatives of the prediction by coefficients, ``(n, q, c, T)``."""
    predictor = fitted.problem.predictor
    index = [predictor.names.index(path) for path in columns]
    parts = []
    for first in range(0, len(index), together):
        some = index[first : first + together]
        # Filled up to one size, so that one compiled function serves.
        filled = tuple(some + some[:1] * (together - len(some)))
        parts.append(predictor.derivatives(fitted.values, filled)[1][:, : len(some)])
    return np.concatenate(parts, axis=1)


def _linear_gain(linearisation: Linearisation, rows: Floats, prior_sd: Floats) -> float:
    """Log-likelihood and prior that the best coefficients gain, nats."""
    flat = rows.swapaxes(0, 1).reshape(rows.shape[1], -1)
    force = flat @ linearisation.residual.ravel()
    curvature = flat @ flat.T + np.diag(prior_sd**-2.0)
    return 0.5 * float(force @ np.linalg.solve(curvature, force))
