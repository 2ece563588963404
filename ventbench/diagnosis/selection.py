"""Forward selection of terms, by information criterion and held-out log-likelihood.

The search starts from the base model (lung, valves, PEEP). In each round, the mechanisms that the
hypothesis does not have are ranked to first order (:mod:`ventbench.diagnosis.screening`), and the
most promising ones are fitted. Fits are compared by BIC at one common noise: the noise that the
best candidate leaves, since noise that was estimated with an effect still in the residual explains
the effect away. The best candidate is fitted together with its noise and kept if held-out breaths
ask for it: its log-likelihood ratio there must pass a test that chance passes in at most 1 % of
recordings (:func:`passes_heldout_test`), or, where the training breaths ask for it clearly, a
cross-validated one; and it must not be a negligible strength that trims other terms. Shape
parameters of the new term are freed if both criteria ask for it, and earlier terms that the new one
makes redundant are dropped. Patient effort has parameters of its own in each breath and can imitate
any sum of effects, so effects that are the same in all breaths come first, and effort has to
explain more than slowly varying sensor noise would. The search ends when no candidate passes and
no pair of terms can be exchanged for one mechanism.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.latent_inputs import exceeds_sensor_noise
from ventbench.diagnosis.plausibility import is_plausible
from ventbench.diagnosis.screening import Candidate, screen_mechanisms
from ventbench.diagnosis.settings import DEFAULT, HeldOutTestSettings
from ventbench.diagnosis.shape_parameters import (
    fit_with_shape,
    free_shape_parameters,
    other_dead_times,
    shapes_at_default,
)
from ventbench.executor import parallel_map
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, robust_noise

#: Is told what is being done.
Progress = Callable[[str], None]

#: Physical values that a fit starts from, by path.
Start = dict[str, Any]

#: Gives a simpler model that ends the search in place of the current one, or None.
Replacement = Callable[[FittedModel], FittedModel | None]


@dataclass(frozen=True, eq=False)
class RankedModel:
    """A hypothesis in a comparison, by its last term.

    Attributes:
        name: name of the term.
        fitted: the hypothesis with the term.
        criterion: BIC at the comparison's noise.
    """

    name: str
    fitted: FittedModel
    criterion: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """Terms that could be added to a hypothesis, compared at one noise.

    Attributes:
        base: the hypothesis without any candidate.
        ranked: the candidates, the best first.
        held_out_gain: held-out log-likelihood that the best gains, nats, ``(n,)``.
    """

    base: FittedModel
    ranked: tuple[RankedModel, ...]
    held_out_gain: Floats


def forward_selection(
    evaluator: Evaluator,
    start: FittedModel,
    tell: Progress,
    replacement: Replacement = lambda _: None,
) -> tuple[FittedModel, list[Comparison]]:
    """Add terms while held-out breaths ask for them, and drop terms that become redundant.

    Args:
        evaluator: evaluator of the recording.
        start: the model that terms are added to.
        tell: called with a description of each step before it runs.
        replacement: returns, if there is one, a simpler model once there are several terms, and at
            the end.

    Returns:
        The selected model and all comparisons; no comparisons if the model is a replacement.
    """
    current, comparisons = start, []
    settings = evaluator.settings
    for _ in range(settings.forward.max_rounds):
        if len(current.names) == settings.forward.max_terms:
            break
        tell(f"comparing mechanisms ({len(current.names)} selected)")
        white = fit_with_white_noise(evaluator, current)
        candidates = screen_mechanisms(current, white, settings, evaluator.allowed_mechanisms)
        comparison = compare_candidates(evaluator, current, candidates, white)
        if comparison is not None:
            comparisons.append(comparison)
        best = None if comparison is None else _accepted(evaluator, comparison)
        if best is None:
            best = replace_pair(evaluator, current)
            if best is None:
                break
            current = best
            continue
        current = drop_redundant_terms(evaluator, free_shape_parameters(evaluator, best))
        if len(current.names) < settings.forward.replacement_terms:
            continue
        instead = replacement(current)
        if instead is not None:
            return instead, []
    instead = replacement(current)
    return (current, comparisons) if instead is None else (instead, [])


def estimate_noise(fitted: FittedModel) -> Noise:
    """Noise that a model leaves in the breaths that it was fitted to."""
    return robust_noise(fitted.residual, fitted.problem.data.weight)


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


def passes_heldout_test(
    gains: Floats,
    settings: HeldOutTestSettings = DEFAULT.held_out_test,
    threshold: float | None = None,
) -> bool:
    """Whether held-out breaths ask for a term.

    The sum of the gains is a split likelihood ratio: whatever the term and however it was chosen,
    chance exceeds the threshold in at most 1 % of recordings. The sum must not depend on a few
    breaths either, and a few breaths that no model fits, as those of another rig, must not outvote
    the rest. With gains far beyond the typical ones cut off, half of the threshold must be left,
    and more than the sum's own scatter.

    Args:
        gains: log-likelihood that the term gains in each held-out breath, nats, ``(n,)``.
        settings: settings of the test.
        threshold: nats that the sum must exceed; as in ``settings`` if None.
    """
    threshold = settings.threshold if threshold is None else threshold
    if float(gains.sum()) <= threshold:
        return False
    typical = float(np.quantile(np.abs(gains), settings.typical_quantile))
    far = settings.outlier_factor * typical
    clipped = np.clip(gains, -far, far)
    total, scatter = float(clipped.sum()), float(np.sqrt(np.sum(clipped**2)))
    return total > settings.kept_share * threshold and total > settings.consistency * scatter


def is_needed(evaluator: Evaluator, with_term: FittedModel, without_term: FittedModel) -> bool:
    """Whether both training and held-out breaths ask for a term.

    Where the training breaths ask for it clearly and the held-out breaths are too few to tell, the
    test is repeated by cross-validation.

    Args:
        evaluator: evaluator of the recording.
        with_term: a hypothesis.
        without_term: the hypothesis without the term, at the same noise.
    """
    settings = evaluator.settings.held_out_test
    gained = evaluator.criterion(without_term) - evaluator.criterion(with_term)
    if gained < 0:
        return False
    held_out = evaluator.held_out_log_likelihood(with_term)
    if passes_heldout_test(held_out - evaluator.held_out_log_likelihood(without_term), settings):
        return True
    return gained > settings.clear_criterion and passes_heldout_test(
        cross_validated_gain(evaluator, with_term, without_term),
        settings,
        settings.cross_validation_factor * settings.threshold,
    )


def is_negligible(
    evaluator: Evaluator, with_term: FittedModel, without_term: FittedModel, name: str
) -> bool:
    """Whether a term is implausible, or far weaker than a mild one and explains little.

    A tiny effect of almost any kind can reduce an error of the integrator, or of another term's
    form, and with enough breaths it passes the held-out test: a valve that is late by 1 ms beside
    four strong effects.

    Args:
        evaluator: evaluator of the recording.
        with_term: a hypothesis.
        without_term: the hypothesis without the term, at the same noise.
        name: name of the term.
    """
    if not is_plausible(with_term, name, evaluator.settings.plausibility):
        return True
    settings = evaluator.settings.held_out_test
    about = mechanism(name).description.strength
    strength = float(np.max(np.abs(with_term.column(f"{name}.{about.name}") - about.neutral)))
    weak = settings.negligible_strength * abs(about.mild - about.neutral)
    if varies_by_breath(name) or strength > weak:
        return False
    criterion = evaluator.criterion(with_term)
    base = evaluator.criterion(evaluator.fit(Hypothesis(), with_term.noise, with_term))
    return evaluator.criterion(without_term) - criterion < settings.negligible_share * (
        base - criterion
    )


def compare_candidates(
    evaluator: Evaluator,
    current: FittedModel,
    candidates: list[Candidate],
    warm_start: FittedModel | None = None,
    *,
    restarts: bool = True,
) -> Comparison | None:
    """Fit the candidates and rank them by BIC at one noise; None if none is promising.

    Args:
        evaluator: evaluator of the recording.
        current: the model that candidates are added to.
        candidates: the most promising first.
        warm_start: the model that fits start from; ``current`` if None.
        restarts: whether fits may have to go far where much is missing; not where the start has the
            R and C of a better model.
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
    if not much:
        chosen = chosen[: settings.fitted_candidates]
    elif restarts:
        chosen = candidates
    # Noise that was estimated with an effect in the residual would hide the effect from its fit.
    white, first = replace(current.noise, ar=(0.0, 0.0)), warm_start or current
    models = _quick_fits(evaluator, current, chosen, white, first, far=much and restarts)
    criteria = _Criteria(evaluator)
    own = parallel_map(lambda model: criteria(model, estimate_noise(model)), models)
    noise = criteria.better_noise(models[int(np.argmin(own))], current.noise)
    order = criteria.order(models, noise)
    for _ in range(settings.noise_rounds):
        # At the noise of the best, all that may still win are fitted on.
        order[0] = evaluator.fit(order[0].hypothesis, noise, order[0])
        noise = criteria.better_noise(order[0], noise)
        order = criteria.order(order, noise)
        limit = _contention(evaluator, criteria, current, order[0], noise)
        order = criteria.order(_fit_contenders(evaluator, order, noise, criteria, limit), noise)
        if criteria.better_noise(order[0], noise) is noise:
            break
    limit = _contention(evaluator, criteria, current, order[0], noise)
    if len(order) > 1 and criteria(order[1], noise) < limit:
        freer = _free_contenders(evaluator, order, noise, criteria, limit)
        order = criteria.order(freer, noise)
        noise = criteria.better_noise(order[0], noise)
        order = criteria.order(order, noise)
    if noise is not current.noise:
        current = evaluator.fit(current.hypothesis, noise, current)
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
    *,
    far: bool,
) -> list[FittedModel]:
    """First fits of candidates, each from its best start.

    Where a fit may have to go far (``far``), the templates of the screening extrapolate badly, and
    the refit's R and C make up for the effect: a mild effect is tried too, with these and with the
    label's. A few steps from every start show which two are worth going on from.

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
    shifts: list[Start] = [{}, *other_dead_times(warm_start)]
    label: Start = {"R": data.R, "C": data.C}

    def quick_fit(candidate: Candidate) -> FittedModel:
        hypothesis = current.hypothesis.plus(candidate.hypothesis)
        starts: list[Start] = [candidate.start, *candidate.other_starts]
        if not varies_by_breath(candidate.name):
            starts = [start | shift for start in starts for shift in shifts]
            starts += [{}, label] if far else []
        if len(starts) <= settings.fit.continued_starts:
            fits = [quick(small, hypothesis, noise, first, start) for start in starts]
        else:
            steps = settings.fit.start_iterations
            raced = [
                small.fit(hypothesis, noise, first, start, iterations=steps, delay_rounds=0)
                for start in starts
            ]
            raced.sort(key=lambda model: model.minimum.cost)
            ahead = raced[: settings.fit.continued_starts]
            fits = [quick(small, hypothesis, noise, model) for model in ahead]
        return min(fits, key=lambda model: model.minimum.cost)

    models = parallel_map(quick_fit, candidates)
    if small is evaluator:
        return models
    criteria = _Criteria(small)
    own = parallel_map(lambda model: criteria(model, estimate_noise(model)), models)
    noise_left = estimate_noise(models[int(np.argmin(own))])
    models = criteria.order(models, noise_left)
    limit = _contention(evaluator, criteria, evaluator.restricted(current), models[0], noise_left)
    count = settings.forward.fitted_candidates
    kept = [m for k, m in enumerate(models) if k < count or criteria(m, noise_left) < limit]
    return parallel_map(partial(_fit_to_all, evaluator, warm_start=warm_start), kept)


def _fit_to_all(evaluator: Evaluator, model: FittedModel, warm_start: FittedModel) -> FittedModel:
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
) -> float:
    """Criterion below which a candidate may still win."""
    settings, least = evaluator.settings.forward, criteria(best, noise)
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


def _accepted(evaluator: Evaluator, comparison: Comparison) -> FittedModel | None:
    """The model to continue with, or None if no candidate passes."""
    first = comparison.ranked[0]
    shared = [model for model in comparison.ranked if not varies_by_breath(model.name)]
    if varies_by_breath(first.name):
        nothing = evaluator.criterion(comparison.base)
        share = evaluator.settings.forward.shared_effect_share
        enough = nothing - share * (nothing - first.criterion)
        strong = next((model for model in shared if model.criterion < enough), None)
        preferred = _if_needed(evaluator, comparison, strong)
        if preferred is not None:
            return preferred
    passes = passes_heldout_test(comparison.held_out_gain, evaluator.settings.held_out_test)
    if not passes and not is_needed(evaluator, first.fitted, comparison.base):
        return _fallback(evaluator, comparison)
    best = _refit(evaluator, first)
    without = _without(evaluator, comparison, best)
    if is_negligible(evaluator, best, without, first.name):
        return _fallback(evaluator, comparison)
    if not varies_by_breath(first.name) or exceeds_sensor_noise(evaluator, best):
        return best
    return _if_needed(evaluator, comparison, next(iter(shared), None))


def _if_needed(
    evaluator: Evaluator, comparison: Comparison, candidate: RankedModel | None
) -> FittedModel | None:
    """A candidate, fitted with its noise, if it is needed there."""
    if candidate is None:
        return None
    fitted = _refit(evaluator, candidate)
    without = _without(evaluator, comparison, fitted)
    if not is_needed(evaluator, fitted, without):
        return None
    return None if is_negligible(evaluator, fitted, without, candidate.name) else fitted


def _without(evaluator: Evaluator, comparison: Comparison, fitted: FittedModel) -> FittedModel:
    """A comparison's base at the noise of another model."""
    return evaluator.fit(comparison.base.hypothesis, fitted.noise, comparison.base)


def _refit(evaluator: Evaluator, candidate: RankedModel) -> FittedModel:
    """A candidate with its own noise: the comparison's still contains much of the effect."""
    return fit_with_noise(evaluator, candidate.fitted.hypothesis, candidate.fitted)


def _fallback(evaluator: Evaluator, comparison: Comparison) -> FittedModel | None:
    """Another candidate that explains much and is needed, where the best one fails.

    The best one is then often patient effort that imitates a sum of several effects.
    """
    settings = evaluator.settings.forward
    least = evaluator.criterion(comparison.base) - settings.large_gain
    own = [
        (evaluator.criterion(model.fitted, estimate_noise(model.fitted)), model)
        for model in comparison.ranked[1:]
    ]
    promising = sorted((pair for pair in own if pair[0] < least), key=lambda pair: pair[0])
    for _, candidate in promising[: settings.fallback_candidates]:
        fitted = _if_needed(evaluator, comparison, candidate)
        if fitted is not None:
            return fitted
    return None


def drop_redundant_terms(evaluator: Evaluator, current: FittedModel) -> FittedModel:
    """Drop earlier terms that are no longer needed, or have become negligible."""
    for name in current.hypothesis.names[:-1]:
        without = evaluator.fit(current.hypothesis.without(name), current.noise, current)
        needed = is_needed(evaluator, current, without)
        if not needed or is_negligible(evaluator, current, without, name):
            current = without
    return current


def replace_pair(evaluator: Evaluator, current: FittedModel) -> FittedModel | None:
    """One mechanism in the place of two, if the criterion prefers it; else None.

    Where the right mechanism loses a round narrowly, the one that is taken and a second one may
    imitate it together, and neither can be exchanged alone: a circuit's compliance with a late
    expiratory valve for gas that has inertia. Mechanisms that are confusable with either are
    fitted in their place, from the values of the full fit, and held-out breaths must not object.
    So is each of the two by itself, with its shape free or from its grid: a valve with a second lag
    instead of a circuit behind a valve with one, or an inertance with more tubing before it.
    """
    names = [name for name in current.names if not varies_by_breath(name)]
    pairs = list(combinations(names, 2))
    work = [
        (current.hypothesis.without(*pair), name, start)
        for pair in pairs
        for name in _rivals(evaluator, current, pair)
        for start in _grid_starts(name)
    ]
    alone = [
        (current.hypothesis.without(*pair), name, start)
        for pair in pairs
        for name in pair
        for start in _grid_starts(name)
        if start or shapes_at_default(current, name)
    ]
    if not work and not alone:
        return None

    small, first = evaluator.for_ranking, evaluator.restricted(current)

    def fitted(job: tuple[Hypothesis, str, dict[str, float]]) -> FittedModel:
        rest, name, start = job
        return small.fit(rest.plus(Hypothesis((name,))), current.noise, first, start)

    def freest(model: FittedModel) -> FittedModel:
        for path in shapes_at_default(model):
            freer = fit_with_shape(small, model, path, current.noise)
            if small.criterion(freer) < small.criterion(model):
                model = freer
        return model

    limit = small.criterion(first) + evaluator.settings.forward.contender_criterion
    close = [model for model in parallel_map(fitted, work) if small.criterion(model) < limit]
    freer = parallel_map(freest, close + parallel_map(fitted, alone))
    close = [model for model in freer if small.criterion(model) < limit]
    models = parallel_map(partial(_fit_to_all, evaluator, warm_start=current), close)
    criterion = evaluator.criterion(current)
    best = min(models, key=evaluator.criterion, default=None)
    if best is None or evaluator.criterion(best) >= criterion:
        return None
    held_out = evaluator.held_out_log_likelihood(current)
    lost = held_out - evaluator.held_out_log_likelihood(best)
    if passes_heldout_test(lost, evaluator.settings.held_out_test):
        return None
    return fit_with_noise(evaluator, best.hypothesis, best)


def _rivals(evaluator: Evaluator, current: FittedModel, pair: tuple[str, ...]) -> list[str]:
    """Mechanisms that are confusable with one of a pair, and are not selected."""
    listed = {name for own in pair for name in mechanism(own).description.confusable}
    return [
        name
        for name in evaluator.allowed_mechanisms
        if name not in current.names
        and not varies_by_breath(name)
        and (name in listed or set(mechanism(name).description.confusable) & set(pair))
    ]


def _grid_starts(name: str) -> list[dict[str, float]]:
    """Starts of a fit: the settings of the parameters that change a mechanism's effect much."""
    grids = {
        f"{name}.{about.name}": about.grid
        for about in mechanism(name).description.parameters
        if about.grid and not about.shape
    }
    return [dict(zip(grids, setting, strict=True)) for setting in product(*grids.values())]
