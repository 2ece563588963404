"""The model that a recording needs: mechanisms, an unnamed effect beside them, or neither.

:func:`conclude` selects mechanisms (:mod:`ventbench.diagnosis.selection.forward`), looks for what
they leave unexplained with nonparametric terms and latent inputs, drops the mechanisms that this
makes idle (:mod:`ventbench.diagnosis.selection.refinement`), and compares the remaining ones with
alternatives (:mod:`ventbench.diagnosis.selection.alternatives`). If the valve's gain scatters
between breaths, all is repeated with a gain of each breath's own, from the mechanisms that were
selected with one gain and, if these are few, from the base model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.latent_inputs import (
    GAIN_SCATTER,
    MEASUREMENT,
    PLACES,
    SUPPLY,
    LatentInput,
    fit_latent_inputs,
    log_likelihood_without_input,
    place_weights,
)
from ventbench.diagnosis.plausibility import is_consistent
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
from ventbench.diagnosis.selection.held_out_test import is_negligible, passes_heldout_test
from ventbench.diagnosis.selection.refinement import (
    NonparametricFit,
    SingleTermAlternative,
    backward_elimination,
    compare_nonparametric_terms,
    drop_compensating_terms,
    eliminate_beside_input,
    special_case_of,
    without_breath_terms,
)
from ventbench.diagnosis.selection.screening import component_of
from ventbench.diagnosis.selection.shape_parameters import free_shape_parameters
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.executor import parallel_map
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise


@dataclass(frozen=True, eq=False)
class UnnamedEffect:
    """An effect for which the library has no mechanism.

    Attributes:
        name: public name of the nonparametric component, or of the latent input's place.
        term: the component's basis term, or None for a latent input.
        latent_input: the input, or None for a basis term.
        nats: held-out log-likelihood that it gains.
        places: weight of each place where a latent input may act, the largest first; empty for a
            basis term.
    """

    name: str
    term: str | None
    latent_input: LatentInput | None
    nats: float
    places: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Conclusion:
    """The models that a recording needs.

    Attributes:
        base: the base model with its noise.
        named: the selected mechanisms.
        full: the mechanisms and the nonparametric term; ``named`` if there is none.
        unnamed: the unnamed effect, or None.
        noise: model of the noise that is left.
        held_out_gains: held-out log-likelihood that each mechanism gains, nats, by name.
        alternatives: alternatives to each mechanism, by name.
        gain_sd: standard deviation of the logarithm of the breaths' valve gains; 0 if all breaths
            have the same gain.
        unresolved: whether much is missing, and neither mechanism nor unnamed effect is accepted.
        slow_noise: what is left as slow noise of the sensor, with the weight of each place where a
            course in time may act; None if nothing slow is left, or an unnamed effect is it.
    """

    base: FittedModel
    named: FittedModel
    full: FittedModel
    unnamed: UnnamedEffect | None
    noise: Noise
    held_out_gains: dict[str, float]
    alternatives: dict[str, Alternatives]
    gain_sd: float = 0.0
    unresolved: bool = False
    slow_noise: UnnamedEffect | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The selected mechanisms."""
        return self.named.names


def conclude(
    evaluator: Evaluator,
    wider: Callable[[], Evaluator],
    tell: Progress,
    earlier: FittedModel | None = None,
) -> Conclusion:
    """Find what a recording needs beyond the base model.

    Args:
        evaluator: evaluator with the library's parameters.
        wider: makes the evaluator with the parameters of the nonparametric terms as well.
        tell: called with a description of each step before it runs.
        earlier: mechanisms that were selected otherwise, to start from too: with the same gain in
            all breaths, or from what a simulator of these breaths answers.
    """
    base = fit_with_noise(evaluator, Hypothesis())
    wider = cache(wider)
    single = SingleTermAlternative(evaluator, wider, base)
    if earlier is None or len(earlier.names) < evaluator.settings.forward.kept_terms:
        selected, comparisons = forward_selection(evaluator, base, tell, single)
    else:
        selected, comparisons = base, []
    if earlier is not None and not set(earlier.names) <= set(selected.names):
        # Gains of the breaths' own can stand for a bent valve in the first rounds of a selection.
        start = fit_with_noise(evaluator, earlier.hypothesis, earlier)
        start = drop_redundant_terms(evaluator, start, start.names)
        other = forward_selection(evaluator, start, tell, single)
        selected, comparisons = _better_selection(evaluator, (selected, comparisons), other)
    if is_far_from_label(evaluator, selected):
        other = selection_at_label(evaluator, tell, single)
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
    remaining = _explain_remaining_error(evaluator, wide, reduced)
    if reduced is not selected and not remaining.prefers_term:
        # The term that explains the dropped mechanisms away must be there in their place.
        remaining = _explain_remaining_error(evaluator, wide, selected)
    else:
        selected = reduced
    if not evaluator.gain_sd and remaining.gain_sd:
        sd = remaining.gain_sd
        scattered = replace(evaluator, gain_sd=sd)
        return conclude(scattered, lambda: replace(wide, gain_sd=sd), tell, selected)
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
            full, beside = selected, _best_term(wide, selected)
        if beside is not None:
            place = component_of(beside.term)
            unnamed = UnnamedEffect(place, beside.term, None, beside.nats)
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
    selected, gains = _supported(evaluator, selected, (wide, full) if has_term else None)
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


@dataclass(frozen=True, eq=False)
class _Unexplained:
    """Explanation of the error that the mechanisms leave.

    Attributes:
        term: best nonparametric term, or None.
        latent: best latent input, or None.
        gain_sd: standard deviation of the logarithm of the breaths' gains; 0 if it does not matter.
        slow_noise: slow noise of the sensor; None if it gains nothing.
    """

    term: NonparametricFit | None
    latent: UnnamedEffect | None
    gain_sd: float
    slow_noise: UnnamedEffect | None

    @property
    def prefers_term(self) -> bool:
        """Whether the nonparametric term explains the most."""
        nats = 0.0 if self.latent is None else self.latent.nats
        return self.term is not None and self.term.nats >= nats


def _explain_remaining_error(
    evaluator: Evaluator, wide: Evaluator, selected: FittedModel
) -> _Unexplained:
    term = _best_term(wide, selected)
    passive = without_breath_terms(evaluator, selected)
    inputs = fit_latent_inputs(evaluator, passive, (GAIN_SCATTER, *PLACES))
    reference = log_likelihood_without_input(evaluator, selected)[1]
    scatter, settings = inputs.pop(GAIN_SCATTER), evaluator.settings
    scattered = _gain_scatters(scatter, inputs, reference, term, settings)
    gain_sd = scatter.size if scattered else 0.0
    inputs[GAIN_SCATTER] = scatter
    slow_noise = _slow_noise(inputs, reference, settings)
    if term is not None and slow_noise is not None and term.nats < slow_noise.nats:
        # A curve that is the same in all breaths may gain by what slow errors have in common. One
        # that is there gains more than noise, which has to be found anew in each breath.
        term = None
    latent = _best_input(inputs, reference, settings)
    if latent is not None and _is_negligible_input(evaluator, selected, latent):
        latent = None
    return _Unexplained(term, latent, gain_sd, slow_noise)


def _slow_noise(
    inputs: dict[str, LatentInput], reference: Floats, settings: SelectionConfig
) -> UnnamedEffect | None:
    """Slow noise of the sensor, if held-out breaths ask for it, with its rivals' weights."""
    sensor = inputs[MEASUREMENT]
    gained = sensor.held_out_log_likelihood - reference
    if not passes_heldout_test(gained, settings.held_out_test):
        return None
    places = tuple(place_weights(inputs.values()).items())
    return UnnamedEffect(MEASUREMENT, None, sensor, float(gained.sum()), places)


def _best_term(wide: Evaluator, selected: FittedModel) -> NonparametricFit | None:
    """The nonparametric term that explains most, if held-out breaths and BIC ask for it."""
    iterations = wide.settings.fit.start_iterations
    start = wide.fit(selected.hypothesis, selected.noise, selected, iterations=iterations)
    comparison = compare_nonparametric_terms(wide, start)
    if comparison is None or not passes_heldout_test(
        comparison.held_out_gain, wide.settings.held_out_test
    ):
        return None
    best = comparison.ranked[0]
    if wide.criterion(best.fitted) > wide.criterion(comparison.base):
        return None
    gained = wide.held_out_log_likelihood(best.fitted) - wide.held_out_log_likelihood(start)
    nats = float(gained.sum())
    if _is_negligible_term(wide, start, best.fitted, nats):
        return None
    return NonparametricFit(best.name, best.fitted, nats)


def _is_negligible_term(
    wide: Evaluator, selected: FittedModel, with_term: FittedModel, nats: float
) -> bool:
    """Whether a nonparametric term moves the pressure a little and explains little beside names."""
    if not selected.names or nats >= _least_beside_names(wide, selected):
        return False
    partition = wide.held_out
    moved = wide.predict(with_term, partition) - wide.predict(selected, partition)
    seen = partition.data.weight > 0.0
    return bool(np.sqrt(np.mean(np.square(moved[seen]))) < wide.settings.refinement.least_change)


def _least_beside_names(evaluator: Evaluator, selected: FittedModel) -> float:
    """Held-out log-likelihood, nats, below which an unnamed effect explains little beside names."""
    base = evaluator.fit(Hypothesis(), selected.noise, selected)
    held_out = evaluator.held_out_log_likelihood(selected)
    by_names = float((held_out - evaluator.held_out_log_likelihood(base)).sum())
    return evaluator.settings.held_out_test.negligible_share * by_names


def _gain_scatters(
    scatter: LatentInput,
    inputs: dict[str, LatentInput],
    reference: Floats,
    term: NonparametricFit | None,
    settings: SelectionConfig,
) -> bool:
    """Whether scatter of the valve's gain explains much of what any latent input does.

    A course within each breath imitates a gain that differs from breath to breath. The gain is the
    simpler of the two, and what it leaves is searched anew.
    """
    gained = scatter.held_out_log_likelihood - reference
    nats = float(gained.sum())
    if not passes_heldout_test(gained, settings.held_out_test):
        return False
    if term is not None and term.nats > nats:
        return False
    others = [
        float((latent.held_out_log_likelihood - reference).sum()) for latent in inputs.values()
    ]
    return nats > settings.latent_inputs.scatter_share * max(others)


def _best_input(
    inputs: dict[str, LatentInput], reference: Floats, settings: SelectionConfig
) -> UnnamedEffect | None:
    """The latent input that explains more than the mechanisms and than any nuisance, if any.

    Coloured noise and a gain that differs from breath to breath are nuisances.
    """
    test, limits = settings.held_out_test, settings.latent_inputs
    physical = dict(inputs)
    nuisances = physical.pop(MEASUREMENT), physical.pop(GAIN_SCATTER)
    sensor = nuisances[0]

    def unnamed(latent: LatentInput, gained: Floats) -> UnnamedEffect:
        places = tuple(place_weights(inputs.values()).items())
        return UnnamedEffect(latent.place, None, latent, float(gained.sum()), places)

    best = max(physical.values(), key=lambda latent: latent.training_log_likelihood)
    gained = best.held_out_log_likelihood - reference
    ahead = min(
        float((best.held_out_log_likelihood - other.held_out_log_likelihood).sum())
        for other in nuisances
    )
    if passes_heldout_test(gained, test, limits.threshold) and ahead > limits.threshold:
        return unnamed(best, gained)
    gained = sensor.held_out_log_likelihood - reference
    hum = sensor.periodic and sensor.size >= limits.sensor_amplitude
    if passes_heldout_test(gained, test) and hum:
        return unnamed(sensor, gained)
    return None


def _is_negligible_input(
    evaluator: Evaluator, selected: FittedModel, unnamed: UnnamedEffect
) -> bool:
    """Whether an input is far weaker than a mild effect and explains little beside the mechanisms.

    With many breaths, the least difference between the form of a mechanism and the library's passes
    the held-out test; :func:`~ventbench.diagnosis.selection.held_out_test.is_negligible` asks the
    same of mechanisms.
    """
    latent, settings = unnamed.latent_input, evaluator.settings
    if latent is None or not selected.names:
        return False
    limits = settings.latent_inputs
    least = limits.least_size * (limits.relative_size if latent.place == SUPPLY else 1.0)
    if latent.size >= least:
        return False
    return unnamed.nats < _least_beside_names(evaluator, selected)


def _supported(
    evaluator: Evaluator, selected: FittedModel, beside: tuple[Evaluator, FittedModel] | None
) -> tuple[FittedModel, dict[str, float]]:
    """Drop mechanisms that held-out breaths do not agree on; and the gains of the others, nats.

    Of a recording with few breaths, each is held out once (cross-validation).

    Args:
        evaluator: evaluator with the library's parameters.
        selected: the mechanisms.
        beside: the same with a nonparametric term, and its evaluator, if there is one. A mechanism
            may help only beside the term.
    """
    settings = evaluator.settings.plausibility

    def gains_in(evaluator: Evaluator, model: FittedModel, name: str) -> tuple[Floats, FittedModel]:
        left = evaluator.fit(model.hypothesis.without(name), model.noise, model)
        held_out = evaluator.held_out_log_likelihood(model)
        return held_out - evaluator.held_out_log_likelihood(left), left

    def compared(name: str) -> tuple[Floats, bool]:
        gains, left = gains_in(evaluator, selected, name)
        if is_negligible(evaluator, selected, left, name):
            return gains, False
        if is_consistent(gains, settings):
            return gains, True
        if beside is not None and name in beside[1].names:
            other = gains_in(*beside, name)[0]
            if is_consistent(other, settings):
                return other, True
        if gains.sum() <= 0.0:
            return gains, False
        validated = cross_validated_gain(evaluator, selected, left)
        return gains, is_consistent(validated, settings)

    while True:
        results = dict(zip(selected.names, parallel_map(compared, selected.names), strict=True))
        weak = [name for name, (_, supported) in results.items() if not supported]
        if not weak:
            return selected, {name: float(gains.sum()) for name, (gains, _) in results.items()}
        least = min(weak, key=lambda name: float(results[name][0].sum()))
        selected = fit_with_noise(evaluator, selected.hypothesis.without(least), selected)
