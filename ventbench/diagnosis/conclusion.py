"""The model that a recording needs: mechanisms, an unnamed effect beside them, or neither.

:func:`conclude` selects mechanisms (:mod:`ventbench.diagnosis.selection.forward`), explains what
they leave (:mod:`ventbench.diagnosis.remaining_error`), drops the mechanisms that this makes idle
(:mod:`ventbench.diagnosis.selection.refinement`), and compares the remaining ones with alternatives
(:mod:`ventbench.diagnosis.selection.alternatives`). If the valve's gain scatters between breaths,
all is repeated with a gain of each breath's own, from the mechanisms that were selected with one
gain and, if these are few, from the base model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.remaining_error import (
    UnnamedEffect,
    best_term,
    explain_remaining_error,
    gain_scatter,
)
from ventbench.diagnosis.selection.acceptance import (
    is_consistent,
    is_negligible,
    passes_heldout_test,
)
from ventbench.diagnosis.selection.alternatives import (
    Alternatives,
    Replacements,
    exchange,
    find_alternatives,
)
from ventbench.diagnosis.selection.candidate_comparison import Comparison, fit_with_noise
from ventbench.diagnosis.selection.forward import (
    Progress,
    drop_redundant_terms,
    forward_selection,
    is_far_from_label,
    selection_at_label,
)
from ventbench.diagnosis.selection.refinement import (
    SingleTermAlternative,
    backward_elimination,
    drop_compensating_terms,
    eliminate_beside_input,
    special_case_of,
)
from ventbench.diagnosis.selection.screening import component_of
from ventbench.diagnosis.selection.shape_parameters import free_shape_parameters
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise


@dataclass(frozen=True, eq=False)
class Conclusion:
    """The models that a recording needs."""

    base: FittedModel  #: the base model with its noise.
    named: FittedModel  #: the selected mechanisms.
    full: FittedModel  #: the mechanisms and the nonparametric term; ``named`` if there is none.
    unnamed: UnnamedEffect | None  #: the unnamed effect, or None.
    noise: Noise  #: model of the noise that is left.
    #: held-out log-likelihood that each mechanism gains, nats, by name.
    held_out_gains: dict[str, float]
    alternatives: dict[str, Alternatives]  #: alternatives to each mechanism, by name.
    #: standard deviation of the logarithm of the breaths' valve gains; 0 if all breaths have the
    #: same gain.
    gain_sd: float = 0.0
    #: whether much is missing, and neither mechanism nor unnamed effect is accepted.
    unresolved: bool = False
    #: what is left as slow noise of the sensor, with the weight of each place where a course in
    #: time may act; None if nothing slow is left, or an unnamed effect is it.
    slow_noise: UnnamedEffect | None = None
    #: root-mean-square error, cmH2O, by which held-out breaths are fitted worse without each
    #: mechanism, by name.
    worths: dict[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The selected mechanisms."""
        return self.named.names


def conclude(
    evaluator: Evaluator,
    wider: Callable[[], Evaluator],
    tell: Progress,
    earlier: FittedModel | None = None,
    *,
    at_label: bool = True,
) -> Conclusion:
    """Find what a recording needs beyond the base model.

    Args:
        evaluator: evaluator with the library's parameters.
        wider: makes the evaluator with the parameters of the nonparametric terms as well.
        tell: called with a description of each step before it runs.
        earlier: mechanisms that were selected otherwise, to start from too: with the same gain in
            all breaths, or from what a simulator of these breaths answers.
        at_label: whether to search at the labelled lung too, where R or C is far from it.
    """
    base = fit_with_noise(evaluator, Hypothesis())
    wider = cache(wider)
    single, scatter = SingleTermAlternative(evaluator, wider, base), _GainScatter(evaluator)
    if earlier is None or len(earlier.names) < evaluator.settings.forward.kept_terms:
        selected, comparisons = forward_selection(evaluator, base, tell, single, scatter)
    else:
        selected, comparisons = base, []
    if scatter.sd:
        # Exchanges are many fits, and would be repeated with the gains.
        return _with_gains(evaluator, wider, scatter.sd, tell, selected)
    if earlier is not None and not set(earlier.names) <= set(selected.names):
        # Gains of the breaths' own can stand for a bent valve in the first rounds of a selection.
        start = fit_with_noise(evaluator, earlier.hypothesis, earlier)
        start = drop_redundant_terms(evaluator, start, start.names)
        other = forward_selection(evaluator, start, tell, single)
        selected, comparisons = _better_selection(evaluator, (selected, comparisons), other)
    if at_label and is_far_from_label(evaluator, selected):
        other = selection_at_label(evaluator, selected, tell, single)
        if other is not None:
            selected, comparisons = _better_selection(evaluator, (selected, comparisons), other)
    known: Replacements = {}
    for _ in range(evaluator.settings.refinement.exchanges):
        if len(selected.names) < 2:  # nothing came after the first
            break
        tell("exchanging mechanisms")
        other = exchange(evaluator, selected, comparisons, known)
        if other is None:
            break
        selected, comparisons = forward_selection(evaluator, other, tell, single)
    tell("looking for effects that no mechanism explains")
    wide = wider()
    reduced = drop_compensating_terms(evaluator, wide, selected, tell)
    remaining = explain_remaining_error(evaluator, wide, reduced)
    if reduced is not selected and not remaining.prefers_term:
        # The term that explains the dropped mechanisms away must be there in their place.
        remaining = explain_remaining_error(evaluator, wide, selected)
    else:
        selected = reduced
    if not evaluator.gain_sd and remaining.gain_sd:
        # Gains of the breaths' own move no lung: what was found at the label is selected already.
        return _with_gains(evaluator, wider, remaining.gain_sd, tell, selected, at_label=False)
    unnamed, full = None, selected
    if remaining.latent is not None and not remaining.prefers_term:
        unnamed = remaining.latent
        assert unnamed.latent_input is not None
        selected = eliminate_beside_input(evaluator, selected, unnamed.latent_input, unnamed.nats)
        full = selected
    elif remaining.term is not None:
        selected, fit = backward_elimination(evaluator, wide, selected, remaining.term)
        named = special_case_of(evaluator, selected, fit)
        beside = fit if named is None else None
        if named is not None:
            selected = free_shape_parameters(evaluator, named)
            full, beside = selected, best_term(wide, selected)
        if beside is not None:
            place = component_of(beside.term)
            unnamed = UnnamedEffect(place, beside.term, None, beside.nats, beside.places)
            full = beside.full
    elif remaining.slow_noise is not None and not selected.hypothesis.breath_terms:
        # Efforts have been compared with slow noise when they were selected.
        slow = remaining.slow_noise
        assert slow.latent_input is not None
        selected = eliminate_beside_input(evaluator, selected, slow.latent_input, slow.nats)
        full = selected
    tell("comparing alternatives")
    selected, alternatives = find_alternatives(
        evaluator, selected, comparisons, known=known,
        swap=unnamed is None and remaining.slow_noise is None,
    )  # fmt: skip
    has_term = unnamed is not None and unnamed.term is not None
    selected, gains, worths = _supported(evaluator, selected, (wide, full) if has_term else None)
    if unnamed is None or unnamed.term is None:
        full = selected
    else:
        dropped = [name for name in full.names if name not in (*selected.names, unnamed.term)]
        if dropped:
            full = fit_with_noise(wide, full.hypothesis.without(*dropped), full)
    latent = None if unnamed is None else unnamed.latent_input
    return Conclusion(
        base,
        selected,
        full,
        unnamed,
        full.noise if latent is None else latent.noise,
        gains,
        {name: alternatives[name] for name in selected.names if name in alternatives},
        evaluator.gain_sd,
        unnamed is None and not selected.names and is_unresolved(evaluator, comparisons),
        remaining.slow_noise if unnamed is None else None,
        worths,
    )


class _GainScatter:
    """Asks whether gains scatter between breaths, and keeps the answer."""

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator
        self.sd = 0.0  # standard deviation of the logarithm of the gains

    def __call__(self, selected: FittedModel) -> bool:
        """Whether the gains scatter, if all breaths have had the same one so far."""
        evaluator = self._evaluator
        if not evaluator.gain_sd:
            sd = gain_scatter(evaluator, selected)
            self.sd = sd if sd <= evaluator.settings.latent_inputs.early_scatter else 0.0
        return bool(self.sd)


def _with_gains(
    evaluator: Evaluator,
    wider: Callable[[], Evaluator],
    sd: float,
    tell: Progress,
    selected: FittedModel,
    *,
    at_label: bool = True,
) -> Conclusion:
    """The conclusion with a gain of each breath's own, from mechanisms selected without.

    Args:
        evaluator: see :func:`conclude`.
        wider: see :func:`conclude`.
        sd: standard deviation of the logarithm of the gains.
        tell: see :func:`conclude`.
        selected: the mechanisms.
        at_label: see :func:`conclude`.
    """
    scattered = replace(evaluator, gain_sd=sd)
    return conclude(
        scattered, lambda: replace(wider(), gain_sd=sd), tell, selected, at_label=at_label
    )


def _better_selection(
    evaluator: Evaluator,
    usual: tuple[FittedModel, list[Comparison]],
    other: tuple[FittedModel, list[Comparison]],
) -> tuple[FittedModel, list[Comparison]]:
    """The other selection if BIC, at the noise that it leaves, and held-out breaths prefer it."""
    model, noise = other[0], other[0].noise
    against = evaluator.fit(usual[0].hypothesis, noise, usual[0])
    gains = evaluator.held_out_log_likelihood(model) - evaluator.held_out_log_likelihood(against)
    better = evaluator.criterion(model) < evaluator.criterion(against)
    return (
        other if better and passes_heldout_test(gains, evaluator.settings.held_out_test) else usual
    )


def without_name(
    conclusion: Conclusion, name: str, evaluator: Evaluator, wide: Evaluator
) -> Conclusion:
    """The conclusion without a mechanism whose strength may as well be none.

    Args:
        conclusion: the conclusion.
        name: name of the mechanism.
        evaluator: evaluator with the library's parameters.
        wide: evaluator of ``conclusion.full``.
    """
    named = conclusion.named
    evaluator, wide = (replace(each, gain_sd=conclusion.gain_sd) for each in (evaluator, wide))
    left = fit_with_noise(evaluator, named.hypothesis.without(name), named)
    full = left
    if conclusion.unnamed is not None and conclusion.unnamed.term is not None:
        full = fit_with_noise(wide, conclusion.full.hypothesis.without(name), conclusion.full)
    latent = None if conclusion.unnamed is None else conclusion.unnamed.latent_input
    return replace(
        conclusion,
        named=left,
        full=full,
        noise=full.noise if latent is None else latent.noise,
        held_out_gains={k: v for k, v in conclusion.held_out_gains.items() if k != name},
        alternatives={k: v for k, v in conclusion.alternatives.items() if k != name},
    )


def without_term(conclusion: Conclusion) -> Conclusion:
    """The conclusion with its mechanisms alone, without a nonparametric term beside them."""
    named = conclusion.named
    return replace(conclusion, full=named, unnamed=None, noise=named.noise)


def is_unresolved(evaluator: Evaluator, comparisons: Sequence[Comparison]) -> bool:
    """Whether a candidate explains much of the training breaths but was not accepted.

    Effects that hide each other do so: each alone helps some breaths and harms others. The
    candidate must also gain a little on held-out breaths. Patient effort does not count, since it
    explains coloured noise as well.

    Args:
        evaluator: evaluator of the recording.
        comparisons: comparisons of the forward selection; the last one counts.
    """
    if not comparisons:
        return False
    last = comparisons[-1]
    least = evaluator.criterion(last.base) - evaluator.settings.forward.large_gain
    threshold = evaluator.settings.held_out_test.threshold

    def gain(fitted: FittedModel) -> float:
        before = evaluator.held_out_log_likelihood(last.base)
        return float((evaluator.held_out_log_likelihood(fitted) - before).sum())

    return any(
        model.criterion < least and gain(model.fitted) > threshold
        for model in last.ranked
        if not varies_by_breath(model.name)
    )


def _supported(
    evaluator: Evaluator, selected: FittedModel, beside: tuple[Evaluator, FittedModel] | None
) -> tuple[FittedModel, dict[str, float], dict[str, float]]:
    """Drop mechanisms that held-out breaths do not agree on; and what the others gain.

    That is log-likelihood, nats, and root-mean-square error, cmH2O, of the held-out breaths.

    Of a recording with few breaths, each is held out once (cross-validation).

    Args:
        evaluator: evaluator with the library's parameters.
        selected: the mechanisms.
        beside: the same with a nonparametric term, and its evaluator, if there is one. A mechanism
            may help only beside the term.
    """
    settings = evaluator.settings.plausibility

    def error(evaluator: Evaluator, model: FittedModel) -> float:
        data = evaluator.held_out.data
        left = evaluator.predict(model, evaluator.held_out) - data.measured
        return float(np.sqrt(np.mean(np.square(left[data.weight > 0.0]))))

    def gains_in(evaluator: Evaluator, model: FittedModel, name: str) -> tuple[Floats, FittedModel]:
        left = evaluator.fit(model.hypothesis.without(name), model.noise, model)
        held_out = evaluator.held_out_log_likelihood(model)
        return held_out - evaluator.held_out_log_likelihood(left), left

    def compared(name: str) -> tuple[Floats, float, bool]:
        gains, left = gains_in(evaluator, selected, name)
        worth = error(evaluator, left) - error(evaluator, selected)
        if is_negligible(evaluator, selected, left, name):
            return gains, worth, False
        if is_consistent(gains, settings):
            return gains, worth, True
        if beside is not None and name in beside[1].names:
            other, left = gains_in(*beside, name)
            if is_consistent(other, settings):
                return other, error(beside[0], left) - error(*beside), True
        if gains.sum() <= 0.0:
            return gains, worth, False
        validated = cross_validated_gain(evaluator, selected, left)
        return gains, worth, is_consistent(validated, settings)

    while True:
        results = dict(zip(selected.names, parallel_map(compared, selected.names), strict=True))
        weak = [name for name, (_, _, supported) in results.items() if not supported]
        if not weak:
            nats = {name: float(gains.sum()) for name, (gains, _, _) in results.items()}
            return selected, nats, {name: worth for name, (_, worth, _) in results.items()}
        least = min(weak, key=lambda name: float(results[name][0].sum()))
        selected = fit_with_noise(evaluator, selected.hypothesis.without(least), selected)
