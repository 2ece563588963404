"""Comparison of mechanisms that could be added to a hypothesis, by BIC at one noise.

Candidates are fitted from several starts, quickly and to one batch of breaths first. Those that may
still win are fitted to the end, with their shapes free, at the noise that the best of them leaves:
noise that was estimated with an effect still in the residual explains the effect away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.selection.screening import Candidate
from ventbench.diagnosis.selection.shape_parameters import (
    fit_with_shape,
    other_dead_times,
    shapes_at_default,
)
from ventbench.diagnosis.settings import ForwardSelectionSettings
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, robust_noise

#: Physical values that a fit starts from, by path.
Start = dict[str, Any]


@dataclass(frozen=True, eq=False)
class RankedModel:
    """A hypothesis in a comparison, by its last term."""

    name: str  #: name of the term.
    fitted: FittedModel  #: the hypothesis with the term.
    criterion: float  #: BIC at the comparison's noise.


@dataclass(frozen=True, eq=False)
class Comparison:
    """Terms that could be added to a hypothesis, compared at one noise."""

    base: FittedModel  #: the hypothesis without any candidate.
    ranked: tuple[RankedModel, ...]  #: the candidates, the best first.
    held_out_gain: Floats  #: held-out log-likelihood that the best gains, nats, ``(n,)``.


def compare_candidates(
    evaluator: Evaluator,
    current: FittedModel,
    candidates: list[Candidate],
    warm_start: FittedModel | None = None,
    *,
    restarts: bool = True,
    rival: FittedModel | None = None,
) -> Comparison | None:
    """Fit the candidates and rank them by BIC at one noise; None if none is promising.

    Args:
        evaluator: evaluator of the recording.
        current: the model that candidates are added to.
        candidates: the most promising first.
        warm_start: the model that fits start from; ``current`` if None.
        restarts: whether fits may have to go far where much is missing; not where the start has the
            R and C of a better model.
        rival: a model that candidates must come near; others are not fitted to the end.
    """
    settings = evaluator.settings.forward
    chosen = [
        candidate for candidate in candidates if candidate.promise > settings.min_expected_gain
    ]
    if not chosen:
        return None
    # Templates are linear: where much is missing they rank badly, and all are fitted. Even one that
    # promises nothing may be right: where a refit has hidden a lag of the sensor in a resistance
    # near zero, no jump of the pressure is left that the lag could round.
    much = max(candidate.nats for candidate in chosen) >= settings.large_gain
    # What changes from breath to breath hardly hides in a refit, nor behind effects in the breath.
    first_ones = chosen[: settings.fitted_candidates]
    if not much:
        chosen = first_ones
    elif restarts:
        chosen = [c for c in candidates if c in first_ones or not _changes(c)]
    # Noise that was estimated with an effect in the residual would hide the effect from its fit.
    white, first = replace(current.noise, ar=(0.0, 0.0)), warm_start or current
    models = _quick_fits(evaluator, current, chosen, white, first, rival, far=much and restarts)
    criteria = _Criteria(evaluator)
    own = parallel_map(lambda model: criteria(model, estimate_noise(model)), models)
    noise = criteria.better_noise(models[int(np.argmin(own))], current.noise)
    order = criteria.order(models, noise)
    for _ in range(settings.noise_rounds):
        # At the noise of the best, all that may still win are fitted on.
        order[0] = evaluator.fit(order[0].hypothesis, noise, order[0])
        noise = criteria.better_noise(order[0], noise)
        order = criteria.order(order, noise)
        limit = _contention(evaluator, criteria, current, order[0], noise, rival)
        order = criteria.order(_fit_contenders(evaluator, order, noise, criteria, limit), noise)
        if criteria.better_noise(order[0], noise) is noise:
            break
    limit = _contention(evaluator, criteria, current, order[0], noise, rival)
    if len(order) > 1 and criteria(order[1], noise) < limit:
        freer = _free_contenders(evaluator, order, noise, criteria, limit)
        order = criteria.order(freer, noise)
        noise = criteria.better_noise(order[0], noise)
        order = criteria.order(order, noise)
    base = current
    if noise is not current.noise:
        current = evaluator.fit(current.hypothesis, noise, current)
    worse = criteria(current, noise) + settings.contender_criterion
    shared = [model for model in order if not varies_by_breath(model.names[-1])]
    if shared and first is not base and criteria(shared[0], noise) > worse:
        # The fit at white noise is beyond a dead time from which no candidate finds back.
        return compare_candidates(evaluator, base, candidates, base, restarts=restarts, rival=rival)
    ranked = tuple(
        RankedModel(model.hypothesis.names[-1], model, criteria(model, noise)) for model in order
    )
    gains = evaluator.held_out_log_likelihood(order[0])
    return Comparison(current, ranked, gains - evaluator.held_out_log_likelihood(current))


def _quick_fits(
    evaluator: Evaluator,
    current: FittedModel,
    candidates: list[Candidate],
    noise: Noise,
    warm_start: FittedModel,
    rival: FittedModel | None,
    *,
    far: bool,
) -> list[FittedModel]:
    """First fits of candidates, each from its best start.

    Where a fit may have to go far (``far``), the templates of the screening extrapolate badly, and
    the refit's R and C make up for the effect: a mild effect is tried too, with these and with the
    label's. A few steps from every start show which two are worth going on from, and which
    candidates are: the others stay as they are, far behind.

    Of a long recording, one batch of its breaths ranks them, and those that may win are fitted to
    all of its training breaths.
    """
    small, settings = evaluator.for_ranking, evaluator.settings
    first, data = evaluator.restricted(warm_start), small.training.data
    quick = partial(
        Evaluator.fit,
        iterations=settings.fit.quick_iterations,
        tolerance=settings.fit.quick_tolerance,
    )
    shifts: list[Start] = other_dead_times(warm_start)
    label: Start = {"R": data.R, "C": data.C}
    # A lag of 0.1 s lets R fall to nothing before the lag itself is found, unless R is held at
    # first.
    held = small.at_label

    without = cost_at(first, noise)
    to_beat = np.inf if rival is None else cost_at(evaluator.restricted(rival), noise)
    # A candidate that is far behind the model to beat from its first start is from others too.
    out_of_reach = hopeless_above(without, to_beat, settings.forward)

    def begun(candidate: Candidate) -> list[FittedModel]:
        hypothesis = current.hypothesis.plus(candidate.hypothesis)
        starts: list[Start] = [candidate.start, *candidate.other_starts]
        if not varies_by_breath(candidate.name):
            starts += [candidate.start | shift for shift in shifts]
            if far:  # a change is where screening has found it
                starts += [candidate.start | label] if _changes(candidate) else [{}, label]
        elif far:
            # What all efforts have in common, a refitted R and C make up for.
            starts.append(candidate.start | label)
        if len(starts) <= settings.fit.continued_starts:
            fits = [
                quick(
                    small, hypothesis, noise, first, start,
                    restart=len(start) > len(candidate.start) and varies_by_breath(candidate.name),
                )
                for start in starts
            ]  # fmt: skip
            return [min(fits, key=cost_of)]
        steps = settings.fit.start_iterations
        race = partial(small.fit, hypothesis, noise, iterations=steps, delay_rounds=0)
        raced = [race(first, starts[0])]
        if cost_of(raced[0]) > out_of_reach:
            return raced
        raced += [race(first, start) for start in starts[1:]]
        if far and held is not None:
            near = small.fit(
                hypothesis.plus(held), noise, first, label, iterations=2 * steps, delay_rounds=0
            )
            raced.append(race(near, label))
        return sorted(raced, key=cost_of)[: settings.fit.continued_starts]

    raced = parallel_map(begun, candidates)
    # What differs from breath to breath is no measure of others: it may explain the most, and fail.
    rivals = [models[0] for models in raced if not varies_by_breath(models[0].names[-1])]
    best = min([to_beat, *map(cost_of, rivals)])
    limit = hopeless_above(without, best, settings.forward)

    def ended(models: list[FittedModel]) -> FittedModel:
        if len(models) > 1 and cost_of(models[0]) < limit:
            models = [quick(small, model.hypothesis, noise, model) for model in models]
        return min(models, key=cost_of)

    models = parallel_map(ended, raced)
    if small is evaluator:
        return models
    criteria = _Criteria(small)
    own = parallel_map(lambda model: criteria(model, estimate_noise(model)), models)
    noise_left = estimate_noise(models[int(np.argmin(own))])
    models = criteria.order(models, noise_left)
    limit = _contention(
        small, criteria, evaluator.restricted(current), models[0], noise_left,
        None if rival is None else evaluator.restricted(rival),
    )  # fmt: skip
    count = settings.forward.fitted_to_all
    kept = [m for k, m in enumerate(models) if k < count or criteria(m, noise_left) < limit]
    return parallel_map(partial(fit_to_all, evaluator, warm_start=warm_start), kept)


def _changes(candidate: Candidate) -> bool:
    """Whether a candidate changes in the course of the recording."""
    return mechanism(candidate.name).uses_position


def cost_of(model: FittedModel) -> float:
    """Cost at which the fit of a model has ended, nats."""
    return model.minimum.cost


def cost_at(model: FittedModel, noise: Noise) -> float:
    """Cost of a model under another noise, without priors, nats."""
    white = noise.whiten(model.residual, model.problem.data.weight)
    return float(noise.loss(white).sum())


def hopeless_above(without: float, best: float, settings: ForwardSelectionSettings) -> float:
    """Cost from which on, after a few steps, no further step can make a candidate win, nats.

    Args:
        without: cost of the model without any candidate.
        best: cost of the best candidate, or of the model that it must beat.
        settings: settings of the comparison.
    """
    return best + max(settings.large_gain, settings.hopeless_share * (without - best))


def fit_to_all(evaluator: Evaluator, model: FittedModel, warm_start: FittedModel) -> FittedModel:
    """A model of the breaths that rank candidates, fitted to all training breaths, quickly.

    Args:
        evaluator: evaluator of the recording.
        model: fitted with ``evaluator.for_ranking``.
        warm_start: a model of all training breaths, which has the breaths' own parameters.
    """
    small, settings = evaluator.for_ranking, evaluator.settings.fit
    if small is evaluator:
        return model
    values = small.transferred_values(model, evaluator.training)
    start = {
        path: values[:, k]
        for k, path in enumerate(model.problem.predictor.names)
        if not small.differs_by_breath(path)
    }
    return evaluator.fit(
        model.hypothesis, model.noise, warm_start, start,
        iterations=settings.quick_iterations, tolerance=settings.quick_tolerance,
    )  # fmt: skip


def _contention(
    evaluator: Evaluator,
    criteria: _Criteria,
    current: FittedModel,
    best: FittedModel,
    noise: Noise,
    rival: FittedModel | None,
) -> float:
    """Criterion below which a candidate may still win."""
    settings, least = evaluator.settings.forward, criteria(best, noise)
    if rival is not None:
        least = min(least, criteria(rival, noise))
    gained = criteria(current, noise) - least
    return least + max(settings.contender_criterion, settings.contender_share * gained)


def _fit_contenders(
    evaluator: Evaluator,
    models: list[FittedModel],
    noise: Noise,
    criteria: _Criteria,
    limit: float,
) -> list[FittedModel]:
    """Continue the fits of the models whose criterion is below a limit, at a noise."""

    def continued(model: FittedModel) -> FittedModel:
        if criteria(model, noise) < limit:
            return evaluator.fit(model.hypothesis, noise, model)
        return model

    return parallel_map(continued, models)


def _free_contenders(
    evaluator: Evaluator,
    models: list[FittedModel],
    noise: Noise,
    criteria: _Criteria,
    limit: float,
) -> list[FittedModel]:
    """Free the shapes of the newest terms of models that may win, where the criterion asks for it.

    Mechanisms that act alike are told apart by their shapes: a supply that recovers in 1.4 s and
    is fitted with the default of 1 s may lose to one whose pressure is finite.
    """

    def freest(model: FittedModel) -> FittedModel:
        if criteria(model, noise) >= limit or varies_by_breath(model.names[-1]):
            return model
        for path in shapes_at_default(model):
            freer = fit_with_shape(evaluator, model, path, noise)
            if criteria(freer, noise) < criteria(model, noise):
                model = freer
        return model

    return parallel_map(freest, models)


class _Criteria:
    """Criteria of models at several noises, each computed once."""

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator
        self._known: dict[tuple[int, Noise], tuple[FittedModel, float]] = {}

    def __call__(self, fitted: FittedModel, noise: Noise) -> float:
        key = (id(fitted), noise)
        if key not in self._known:  # which keeps the model, and thereby its identity
            self._known[key] = (fitted, self._evaluator.criterion(fitted, noise))
        return self._known[key][1]

    def better_noise(self, fitted: FittedModel, noise: Noise) -> Noise:
        """The noise that a model leaves, if it has a clearly lower criterion; else ``noise``."""
        own = estimate_noise(fitted)
        better = self(fitted, own) < self(fitted, noise) - self._evaluator.settings.fit.noise_gain
        return own if better else noise

    def order(self, models: list[FittedModel], noise: Noise) -> list[FittedModel]:
        """The models by their criterion at a noise, the best first."""
        return sorted(models, key=lambda model: self(model, noise))


def fit_with_noise(
    evaluator: Evaluator, hypothesis: Hypothesis, warm_start: FittedModel | None = None
) -> FittedModel:
    """Fit a hypothesis to the training breaths, and its noise, in turn."""
    settings = evaluator.settings.fit
    noise = warm_start.problem.noise if warm_start else Noise()
    fitted = evaluator.fit(hypothesis, noise, warm_start)
    for _ in range(settings.noise_rounds):
        noise = estimate_noise(fitted)
        again = evaluator.fit(hypothesis, noise, fitted, restart=True)
        gained = again.log_likelihood - fitted.log_likelihood_at(noise)
        fitted = again if gained > 0 else evaluator.fit(hypothesis, noise, fitted)
        if gained < settings.noise_gain:
            break
    return fitted


def fit_with_white_noise(evaluator: Evaluator, current: FittedModel) -> FittedModel:
    """Refit a model at white noise.

    Coloured noise excuses slow errors, so that R, C and PEEP may drift anywhere to reduce it.
    """
    white = replace(current.noise, ar=(0.0, 0.0))
    return evaluator.fit(current.hypothesis, white, current if current.names else None)


def estimate_noise(fitted: FittedModel) -> Noise:
    """Noise that a model leaves in the breaths that it was fitted to."""
    return robust_noise(fitted.residual, fitted.problem.data.weight)
