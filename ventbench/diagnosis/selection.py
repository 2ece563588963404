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

from collections.abc import Callable, Collection, Sequence
from functools import partial
from itertools import combinations, product

import numpy as np

from ventbench.diagnosis.candidate_comparison import (
    Comparison,
    RankedModel,
    compare_candidates,
    cost_at,
    cost_of,
    estimate_noise,
    fit_to_all,
    fit_with_noise,
    fit_with_white_noise,
    hopeless_above,
)
from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.latent_inputs import exceeds_sensor_noise
from ventbench.diagnosis.plausibility import is_plausible
from ventbench.diagnosis.screening import screen_mechanisms
from ventbench.diagnosis.settings import DEFAULT, HeldOutTestSettings
from ventbench.diagnosis.shape_parameters import (
    fit_with_shape,
    free_shape_parameters,
    shapes_at_default,
)
from ventbench.executor import parallel_map
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats

#: Is told what is being done.
Progress = Callable[[str], None]

#: Gives a simpler model that ends the search in place of the current one, or None.
Replacement = Callable[[FittedModel], FittedModel | None]


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
    settings, trims = evaluator.settings, set[str]()
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
        if best is None and comparison is not None:
            best = _trim(evaluator, comparison, trims)
            trims |= set(best.names[-1:]) if best is not None else set()
        if best is None:
            best = replace_pair(evaluator, current)
            if best is None:
                break
            current = best
            continue
        best = free_shape_parameters(evaluator, best)
        judged = [name for name in best.names[:-1] if name not in trims]
        current = drop_redundant_terms(evaluator, best, judged)
        if len(current.names) < settings.forward.replacement_terms:
            continue
        instead = replacement(current)
        if instead is not None:
            return instead, []
    if trims & set(current.names):
        trimmed = [name for name in current.names if name in trims]
        others = [name for name in current.names if name not in trims]
        current = drop_redundant_terms(evaluator, current, [*trimmed, *others])
    instead = replacement(current)
    return (current, comparisons) if instead is None else (instead, [])


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
    evaluator: Evaluator,
    comparison: Comparison,
    candidate: RankedModel | None,
    *,
    least: bool = True,
) -> FittedModel | None:
    """A candidate, fitted with its noise, if it is needed there and (``least``) not negligible."""
    if candidate is None:
        return None
    fitted = _refit(evaluator, candidate)
    without = _without(evaluator, comparison, fitted)
    if not is_needed(evaluator, fitted, without):
        return None
    if least and is_negligible(evaluator, fitted, without, candidate.name):
        return None
    return fitted


def _without(evaluator: Evaluator, comparison: Comparison, fitted: FittedModel) -> FittedModel:
    """A comparison's base at the noise of another model."""
    return evaluator.fit(comparison.base.hypothesis, fitted.noise, comparison.base)


def _refit(evaluator: Evaluator, candidate: RankedModel) -> FittedModel:
    """A candidate with its own noise: the comparison's still contains much of the effect."""
    return fit_with_noise(evaluator, candidate.fitted.hypothesis, candidate.fitted)


def _trim(
    evaluator: Evaluator, comparison: Comparison, known: Collection[str]
) -> FittedModel | None:
    """The best candidate, if it is needed and explains much, however small it is.

    A few tenths of a millilitre of gas before a high resistance decide what is read 2 ms after an
    edge, and hide what else is missing. Such a term is part of the search, and is judged at its
    end.
    """
    first, settings = comparison.ranked[0], evaluator.settings.forward
    gained = evaluator.criterion(comparison.base, first.fitted.noise) - first.criterion
    if varies_by_breath(first.name) or first.name in known or gained < settings.large_gain:
        return None
    return _if_needed(evaluator, comparison, first, least=False)


def _fallback(evaluator: Evaluator, comparison: Comparison) -> FittedModel | None:
    """Another candidate that is needed, where the best one fails.

    One that explains much: the best one is then often patient effort that imitates a sum of several
    effects. Or one that explains as much as the best: a valve that is late by too little to be
    named hardly differs from a circuit behind a low resistance.
    """
    settings = evaluator.settings.forward
    least = evaluator.criterion(comparison.base) - settings.large_gain
    close = comparison.ranked[0].criterion + evaluator.settings.refinement.close_criterion
    own = [
        (evaluator.criterion(model.fitted, estimate_noise(model.fitted)), model)
        for model in comparison.ranked[1:]
    ]
    promising = sorted(
        (pair for pair in own if pair[0] < least or pair[1].criterion < close),
        key=lambda pair: pair[0],
    )
    for _, candidate in promising[: settings.fallback_candidates]:
        fitted = _if_needed(evaluator, comparison, candidate)
        if fitted is not None:
            return fitted
    return None


def drop_redundant_terms(
    evaluator: Evaluator, current: FittedModel, names: Sequence[str] | None = None
) -> FittedModel:
    """Drop terms that are not needed, or negligible.

    Args:
        evaluator: evaluator of the recording.
        current: the model.
        names: the terms to judge; all but the newest if None.
    """
    for name in current.names[:-1] if names is None else names:
        without = evaluator.fit(current.hypothesis.without(name), current.noise, current)
        needed = is_needed(evaluator, current, without)
        if not needed or is_negligible(evaluator, current, without, name):
            current = without
    return current


def replace_pair(evaluator: Evaluator, current: FittedModel) -> FittedModel | None:
    """One mechanism, or two others, in the place of two, if the criterion prefers it; else None.

    Where the right mechanism loses a round narrowly, the one that is taken and a second one may
    imitate it together, and neither can be exchanged alone: a circuit's compliance with a late
    expiratory valve for gas that has inertia, or a slow sensor with such gas for both. Mechanisms
    that are confusable with either are fitted in their place, alone and by twos, from the values of
    the full fit, and held-out breaths must not object. So is each of the two by itself, with its
    shape free or from its grid: a valve with a second lag instead of a circuit behind a valve with
    one, or an inertance with more tubing before it.
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
    settings, reached = evaluator.settings, cost_at(first, current.noise)
    limits = {}
    for pair in pairs:
        rest = current.hypothesis.without(*pair)
        without = small.fit(rest, current.noise, first, tolerance=settings.fit.quick_tolerance)
        limits[rest] = hopeless_above(cost_of(without), reached, settings.forward)

    def begun(job: tuple[Hypothesis, str, dict[str, float]]) -> FittedModel:
        """A few steps of a rival's fit."""
        rest, name, start = job
        return _begun(small, rest.plus(Hypothesis((name,))), first, start)

    def fitted(job: tuple[Hypothesis, str, dict[str, float]]) -> FittedModel:
        rest, name, start = job
        return small.fit(rest.plus(Hypothesis((name,))), current.noise, first, start)

    def freest(model: FittedModel) -> FittedModel:
        for path in (path for name in model.names for path in shapes_at_default(model, name)):
            freer = fit_with_shape(small, model, path, current.noise)
            if small.criterion(freer) < small.criterion(model):
                model = freer
        return model

    limit = small.criterion(first) + settings.forward.contender_criterion
    singles = list(zip(work, parallel_map(begun, work), strict=True))
    rivals = [model for (rest, *_), model in singles if cost_of(model) < limits[rest]]
    twos = [model for rest in limits for model in _twos(small, rest, singles, limits[rest])]
    ended = parallel_map(lambda m: small.fit(m.hypothesis, current.noise, m), [*rivals, *twos])
    close = [model for model in ended[: len(rivals)] if small.criterion(model) < limit]
    # Two may need a shape before they come close: a valve that opens slowly, behind a circuit.
    freer = parallel_map(freest, close + ended[len(rivals) :] + parallel_map(fitted, alone))
    close = [model for model in freer if small.criterion(model) < limit]
    models = parallel_map(partial(fit_to_all, evaluator, warm_start=current), close)
    criterion = evaluator.criterion(current)
    best = min(models, key=evaluator.criterion, default=None)
    if best is None or evaluator.criterion(best) >= criterion:
        return None
    if not all(is_plausible(best, name, settings.plausibility) for name in best.names):
        return None
    held_out = evaluator.held_out_log_likelihood(current)
    lost = held_out - evaluator.held_out_log_likelihood(best)
    if passes_heldout_test(lost, settings.held_out_test):
        return None
    return fit_with_noise(evaluator, best.hypothesis, best)


def _begun(
    small: Evaluator, hypothesis: Hypothesis, first: FittedModel, start: dict[str, float]
) -> FittedModel:
    """A few steps of a fit."""
    steps = small.settings.fit.start_iterations
    return small.fit(hypothesis, first.noise, first, start, iterations=steps, delay_rounds=0)


def _twos(
    small: Evaluator,
    rest: Hypothesis,
    singles: list[tuple[tuple[Hypothesis, str, dict[str, float]], FittedModel]],
    limit: float,
) -> list[FittedModel]:
    """The best twos of rivals in the place of a pair, after a few steps.

    Args:
        small: evaluator of the breaths that rank candidates.
        rest: hypothesis without the pair.
        singles: single rivals after a few steps, with their starts.
        limit: cost above which no further step can make a two win.
    """
    best: dict[str, tuple[dict[str, float], FittedModel]] = {}
    for (other, name, start), model in singles:
        if other == rest and (name not in best or cost_of(model) < cost_of(best[name][1])):
            best[name] = start, model
    order = sorted(best, key=lambda name: cost_of(best[name][1]))
    count = small.settings.forward.exchanged_firsts
    work = [
        (best[one][1], added, best[other][0] | start)
        for k, one in enumerate(order[:count])
        for other in order[k + 1 :]
        for added, start in _forms(other)
    ]

    def begun(job: tuple[FittedModel, Hypothesis, dict[str, float]]) -> FittedModel:
        first, added, start = job
        return _begun(small, rest.plus(first.hypothesis).plus(added), first, start)

    models = parallel_map(begun, work)
    near = sorted((model for model in models if cost_of(model) < limit), key=cost_of)
    return near[: small.settings.forward.exchanged_twos]


def _forms(name: str) -> list[tuple[Hypothesis, dict[str, float]]]:
    """A mechanism in its usual form and in the others of its grids: a valve that opens slowly."""
    usual = Hypothesis((name,))
    shapes = [p for p in mechanism(name).description.parameters if p.shape and not p.discrete]
    return [(usual, {})] + [
        (Hypothesis((name,), (path,)), {path: value})
        for about in shapes
        for path in [f"{name}.{about.name}"]
        for value in about.grid
        if value != about.neutral
    ]


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
