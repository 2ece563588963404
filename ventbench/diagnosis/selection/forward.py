"""Forward selection of terms, by information criterion and held-out log-likelihood.

The search starts from the base model (lung, valves, PEEP). In each round, the mechanisms that the
hypothesis does not have are ranked to first order
(:mod:`ventbench.diagnosis.selection.screening`), and the most promising ones are fitted. Fits are
compared by BIC at one common noise: the noise that the best candidate leaves, since noise that was
estimated with an effect still in the residual explains the effect away. The best candidate is
fitted together with its noise and kept if held-out breaths ask for it: its log-likelihood ratio
there must pass a test that chance passes in at most 1 % of recordings
(:func:`~ventbench.diagnosis.selection.acceptance.passes_heldout_test`), or, where the training
breaths ask for it clearly, a cross-validated one; and it must not be a negligible strength that
trims other terms. If it is, and nothing else explains as much, a term that explains much is part of
the models that are compared from then on, and is not named in the end. Shape parameters of the new
term are freed if both criteria ask for it, and earlier terms that the new one makes redundant are
dropped. Patient effort has parameters of its own in each breath and can imitate any sum of effects,
so effects that are the same in all breaths come first, and effort has to explain more than slowly
varying sensor noise would. The search ends when no candidate passes and no pair of terms can be
exchanged for others (:mod:`ventbench.diagnosis.selection.pair_exchange`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, varies_by_breath
from ventbench.diagnosis.latent_inputs import exceeds_sensor_noise
from ventbench.diagnosis.selection.acceptance import (
    is_needed,
    is_negligible,
    passes_heldout_test,
)
from ventbench.diagnosis.selection.candidate_comparison import (
    Comparison,
    RankedModel,
    compare_candidates,
    estimate_noise,
    fit_with_noise,
    fit_with_white_noise,
)
from ventbench.diagnosis.selection.pair_exchange import replace_pair
from ventbench.diagnosis.selection.screening import screen_mechanisms
from ventbench.diagnosis.selection.shape_parameters import (
    free_shape_parameters,
    shapes_at_default,
)
from ventbench.physics.catalogue import mechanism

#: Values of the lung that a search may hold at the label.
_LUNG = ("R", "C")

#: Is told what is being done.
Progress = Callable[[str], None]

#: Gives a simpler model that ends the search in place of the current one, or None.
Replacement = Callable[[FittedModel], FittedModel | None]


def forward_selection(
    evaluator: Evaluator,
    start: FittedModel,
    tell: Progress,
    replacement: Replacement = lambda _: None,
    interrupt: Callable[[FittedModel], bool] = lambda _: False,
    max_terms: int | None = None,
) -> tuple[FittedModel, list[Comparison]]:
    """Add terms while held-out breaths ask for them, and drop terms that become redundant.

    Args:
        evaluator: evaluator of the recording.
        start: the model that terms are added to.
        tell: called with a description of each step before it runs.
        replacement: returns, if there is one, a simpler model once there are several terms, and at
            the end.
        interrupt: is asked before terms are exchanged, and ends the search if it returns True.
        max_terms: number of terms at which the search ends; that of the settings if None.

    Returns:
        The selected model and all comparisons; no comparisons if the model is a replacement.
    """
    current, comparisons = start, []
    settings, trims = evaluator.settings, set[str]()
    most = settings.forward.max_terms if max_terms is None else max_terms
    for _ in range(settings.forward.max_rounds):
        if len(current.names) >= most:
            break
        tell(f"comparing mechanisms ({len(current.names)} selected)")
        white = fit_with_white_noise(evaluator, current)
        candidates = screen_mechanisms(current, white, evaluator.allowed_mechanisms)
        comparison = compare_candidates(evaluator, current, candidates, white)
        if comparison is not None:
            comparisons.append(comparison)
        best = None if comparison is None else _accepted(evaluator, comparison)
        if best is None and comparison is not None:
            best = _trim(evaluator, comparison, trims)
            trims |= set(best.names[-1:]) if best is not None else set()
        if best is None:
            if len(current.names) > 1 and interrupt(current):
                break
            other = _free_earlier_shapes(evaluator, current) or replace_pair(evaluator, current)
            if other is None:
                break
            current = drop_redundant_terms(
                evaluator, other, [name for name in other.names if name not in trims]
            )
            continue
        shaped = free_shape_parameters(evaluator, best)
        if shaped.hypothesis != best.hypothesis:
            # What another shape explains is not in the noise either.
            best = fit_with_noise(evaluator, shaped.hypothesis, shaped)
        judged = [name for name in best.names[:-1] if name not in trims]
        current = drop_redundant_terms(evaluator, best, judged)
        if len(current.names) < settings.forward.replacement_terms:
            continue
        instead = replacement(current)
        if instead is not None:
            return instead, []
    current = _drop_idle_trims(evaluator, current, trims)
    instead = replacement(current)
    return (current, comparisons) if instead is None else (instead, [])


def _free_earlier_shapes(evaluator: Evaluator, current: FittedModel) -> FittedModel | None:
    """The model with shapes of its earlier terms free; None if the recording asks for none.

    While much else was missing, another shape of an earlier term may have explained nothing.
    """
    shaped = current
    for name in current.names[:-1]:
        if shapes_at_default(shaped, name):
            shaped = free_shape_parameters(evaluator, shaped, name)
    if shaped.hypothesis == current.hypothesis:
        return None
    return fit_with_noise(evaluator, shaped.hypothesis, shaped)


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
        if mechanism(first.name).description.ubiquitous:
            return None  # what acts alike explains the same little
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

    Some hundredths of 1 mL/cmH2O before a high resistance decide what is read 2 ms after an edge,
    and hide what else is missing. Such a term is part of the models that are compared, and is not
    named in the end.
    """
    first, settings = comparison.ranked[0], evaluator.settings.forward
    gained = evaluator.criterion(comparison.base, first.fitted.noise) - first.criterion
    if varies_by_breath(first.name) or first.name in known or gained < settings.large_gain:
        return None
    return _if_needed(evaluator, comparison, first, least=False)


def _drop_idle_trims(
    evaluator: Evaluator, current: FittedModel, trims: Collection[str]
) -> FittedModel:
    """Drop small terms that later ones have made idle, and judge the others without them."""
    before = current
    for name in (name for name in before.names if name in trims):
        without = evaluator.fit(current.hypothesis.without(name), current.noise, current)
        if not is_needed(evaluator, current, without):
            current = without
    if current is before:
        return current
    return drop_redundant_terms(evaluator, current, [n for n in current.names if n not in trims])


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


def is_far_from_label(evaluator: Evaluator, selected: FittedModel) -> bool:
    """Whether R or C of a recording of one lung is a large factor away from its label."""
    if evaluator.at_label is None:
        return False
    data, factor = evaluator.training.data, evaluator.settings.forward.label_factor
    ratios = np.concatenate([selected.column("R") / data.R, selected.column("C") / data.C])
    return bool(np.any(np.abs(np.log(ratios)) > np.log(factor)))


def selection_at_label(
    evaluator: Evaluator, selected: FittedModel, tell: Progress, replacement: Replacement
) -> tuple[FittedModel, list[Comparison]] | None:
    """Select terms with R and C at the label, free R and C, and go on; None if that is no better.

    Strong lags let a refit take R to nothing, and three or four terms then imitate what the lags do
    in a lung without resistance. No step from there leads back. At the label the lags are found at
    once; the caller chooses between the two results.

    Where R or C is far from its label because it depends on volume, or the label is wrong, the
    search at the label adds term after term. It ends once it has a few more than the selected ones,
    and is left if they do no better.

    Args:
        evaluator: evaluator of a recording of one lung.
        selected: the terms that were selected with R and C free.
        tell: called with a description of each step before it runs.
        replacement: see :func:`forward_selection`.
    """
    label, settings = evaluator.at_label, evaluator.settings.forward
    assert label is not None, "a recording of several labels is not searched at one"
    tell("searching with the labelled lung")
    most = min(settings.max_terms, len(selected.names) + settings.more_at_label)
    held, _ = forward_selection(evaluator, fit_with_noise(evaluator, label), tell, max_terms=most)
    fixed = tuple((path, value) for path, value in held.hypothesis.fixed if path not in _LUNG)
    free = fit_with_noise(evaluator, replace(held.hypothesis, fixed=fixed), held)
    free = drop_redundant_terms(evaluator, free, free.names)
    if len(held.names) >= most:
        against = evaluator.fit(selected.hypothesis, free.noise, selected)
        if evaluator.criterion(free) > evaluator.criterion(against):
            return None
    return forward_selection(evaluator, free, tell, replacement)
