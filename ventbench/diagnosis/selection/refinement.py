"""Selected terms beside effects that the library has no mechanism for: keep, drop or replace.

Forward selection can only choose mechanisms of the library. Where the recording contains something
else, a sum of mechanisms may imitate it. Three questions separate the two:

- :class:`SingleTermAlternative`: does one nonparametric term alone do better than many mechanisms?
- :func:`drop_compensating_terms`: does a nonparametric term related to one mechanism explain a
  second mechanism away, which then only compensated for the first one's form?
- :func:`backward_elimination`: which mechanisms are needed beside a nonparametric term or a latent
  input that explains what is left?

The ``evaluator`` has predictors with the library's parameters; ``wide`` is the same recording with
the parameters of the nonparametric terms as well, which take longer to compile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from operator import itemgetter

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.latent_inputs import (
    ALVEOLUS,
    LatentInput,
    fit_latent_inputs,
    log_likelihood_without_input,
)
from ventbench.diagnosis.selection.acceptance import is_needed, is_plausible, passes_heldout_test
from ventbench.diagnosis.selection.candidate_comparison import (
    Comparison,
    RankedModel,
    compare_candidates,
    fit_with_noise,
    fit_with_white_noise,
)
from ventbench.diagnosis.selection.forward import Progress
from ventbench.diagnosis.selection.screening import (
    component_of,
    score_nonparametric_terms,
    screen_mechanisms,
)
from ventbench.diagnosis.settings import RefinementSettings
from ventbench.physics.catalogue import special_cases


@dataclass(frozen=True, eq=False)
class NonparametricFit:
    """A nonparametric basis term beside mechanisms."""

    term: str  #: name of the basis term.
    full: FittedModel  #: the model with the term and the mechanisms.
    nats: float  #: held-out log-likelihood that the term gains.
    #: components whose best term BIC cannot tell from it, and their weights, the largest first.
    places: tuple[tuple[str, float], ...] = ()


def places_of(
    comparison: Comparison, settings: RefinementSettings
) -> tuple[tuple[str, float], ...]:
    """Components that BIC cannot tell from the best one's, and their weights."""
    best = comparison.ranked[0].criterion
    odds: dict[str, float] = {}
    for model in comparison.ranked:
        behind = model.criterion - best
        if behind < settings.close_criterion:
            odds.setdefault(component_of(model.name), float(np.exp(-0.5 * behind)))
    total = sum(odds.values())
    return tuple((name, each / total) for name, each in odds.items())


def compare_nonparametric_terms(wide: Evaluator, current: FittedModel) -> Comparison | None:
    """Fit the most promising nonparametric terms beside a model; None if none is promising."""
    candidates = score_nonparametric_terms(current, wide.settings)
    chosen = candidates[: wide.settings.refinement.fitted_terms]
    return compare_candidates(wide, current, chosen, restarts=False)


class SingleTermAlternative:
    """The best nonparametric term alone, fitted when it is first asked for."""

    def __init__(
        self, evaluator: Evaluator, wider: Callable[[], Evaluator], base: FittedModel
    ) -> None:
        """Keep what the term is compared on.

        Args:
            evaluator: evaluator with the library's parameters.
            wider: gives the evaluator with those of the nonparametric terms as well.
            base: the base model, fitted with its noise.
        """
        self._evaluator, self._wider, self._base = evaluator, wider, base

    def __call__(self, selected: FittedModel) -> FittedModel | None:
        """Model that replaces many mechanisms if one nonparametric term does better; else None.

        The replacement has the mechanisms that are special cases of the term, or none.
        """
        evaluator = self._evaluator
        least = evaluator.settings.refinement.imitation_terms
        if len(selected.names) < least or self._best is None:
            return None
        wide, single = self._wider(), self._best.fitted
        if wide.criterion(single) > evaluator.criterion(selected):
            return None
        held_out = evaluator.held_out_log_likelihood(selected).sum()
        if wide.held_out_log_likelihood(single).sum() < held_out:
            return None
        related = special_cases(self._best.name)
        kept = tuple(name for name in selected.names if name in related)
        if not kept:
            return self._base
        dropped = set(selected.names) - set(kept)
        return fit_with_noise(evaluator, selected.hypothesis.without(*dropped), selected)

    @cached_property
    def _best(self) -> RankedModel | None:
        wide, base = self._wider(), self._base
        start = wide.fit(
            Hypothesis(), base.noise, base, iterations=wide.settings.fit.start_iterations
        )
        comparison = compare_nonparametric_terms(wide, start)
        if comparison is None:
            return None
        best = comparison.ranked[0]
        fitted = fit_with_noise(wide, best.fitted.hypothesis, best.fitted)
        return RankedModel(best.name, fitted, best.criterion)


def drop_compensating_terms(
    evaluator: Evaluator, wide: Evaluator, selected: FittedModel, tell: Progress
) -> FittedModel:
    """Drop mechanisms that only compensate for the form of another one.

    Where the recording's leak is linear and the library's a square root, a second mechanism may
    bend one into the other, and held-out breaths accept it. A nonparametric term that contains the
    first mechanism then does as well or better, and beside it the second is no longer needed. A
    mechanism that acts passes this test: no term related to another one explains it away.

    Args:
        evaluator: evaluator with the library's parameters.
        wide: evaluator with the parameters of the nonparametric terms as well.
        selected: the selected mechanisms.
        tell: called with a description of each step before it runs.
    """
    while len(selected.names) > 1:
        tell("looking for mechanisms that only compensate for others")
        name = _compensating_term(wide, selected)
        if name is None:
            break
        selected = fit_with_noise(evaluator, selected.hypothesis.without(name), selected)
    return selected


def _compensating_term(wide: Evaluator, selected: FittedModel) -> str | None:
    """The weakest of the mechanisms that only compensate for another one."""
    base = wide.fit(Hypothesis(), selected.noise)
    log_likelihood = wide.training_log_likelihood(selected)
    whole = max(log_likelihood - base.log_likelihood, 1e-9)
    most = wide.settings.refinement.max_compensating_share * whole
    reduced = parallel_map(
        lambda name: wide.fit(selected.hypothesis.without(name), selected.noise, selected),
        selected.names,
    )
    lost = [log_likelihood - wide.training_log_likelihood(model) for model in reduced]
    for name, model, nats in sorted(
        zip(selected.names, reduced, lost, strict=True), key=itemgetter(2)
    ):
        if nats < most and _is_explained_away(wide, selected, model, name, nats):
            return name
    return None


def _is_explained_away(
    wide: Evaluator, selected: FittedModel, reduced: FittedModel, name: str, nats: float
) -> bool:
    """Whether a related nonparametric term makes a mechanism idle.

    Args:
        wide: evaluator with the parameters of the nonparametric terms.
        selected: model with the mechanism.
        reduced: model without it.
        name: name of the mechanism.
        nats: training log-likelihood that it gains.
    """
    settings = wide.settings.refinement
    held_out = wide.held_out_log_likelihood(selected)
    gained = float((held_out - wide.held_out_log_likelihood(reduced)).sum())
    for candidate in score_nonparametric_terms(reduced, wide.settings):
        related = special_cases(candidate.name)
        if not set(related) & set(reduced.names):
            continue
        if candidate.promise < settings.promise_share * nats:
            continue
        term = Hypothesis((candidate.name,))
        instead = wide.fit(reduced.hypothesis.plus(term), reduced.noise, reduced)
        ahead = wide.held_out_log_likelihood(instead) - held_out
        # A term that contains both mechanisms can always stand for one of them. It counts only if
        # it does better, so that both have another form.
        shortfall = -min(settings.shortfall_share * gained, settings.shortfall_nats)
        if name in related:
            if not passes_heldout_test(ahead, wide.settings.held_out_test):
                continue
        elif ahead.sum() < shortfall:
            continue
        both = wide.fit(selected.hypothesis.plus(term), selected.noise, instead)
        beside = wide.held_out_log_likelihood(both) - wide.held_out_log_likelihood(instead)
        if float(beside.sum()) < settings.remaining_share * gained:
            return True
    return False


def backward_elimination(
    evaluator: Evaluator, wide: Evaluator, selected: FittedModel, unnamed: NonparametricFit
) -> tuple[FittedModel, NonparametricFit]:
    """Drop the mechanisms that are not needed beside a nonparametric term.

    Args:
        evaluator: evaluator with the library's parameters.
        wide: evaluator with the parameters of the nonparametric terms as well.
        selected: the selected mechanisms.
        unnamed: the term beside them.

    Returns:
        The mechanisms that are kept, and the term beside these. If none is kept, the term is chosen
        anew.
    """
    settings = wide.settings.refinement
    term, full, nats, places = unnamed.term, unnamed.full, unnamed.nats, unnamed.places
    kept = selected.hypothesis
    for name in selected.names:
        left = wide.fit(full.hypothesis.without(name), full.noise, full)
        base = wide.fit(Hypothesis(), full.noise, full)
        whole = full.log_likelihood - base.log_likelihood
        if name in special_cases(term):
            least = evaluator.fit(kept.without(name), selected.noise, selected)
            without = least.log_likelihood_at(full.noise)
            by_name = selected.log_likelihood_at(full.noise) - without
            if by_name >= settings.related_share * (full.log_likelihood - without):
                continue
        # A name that explains more than the term does is no correction of the term's form, however
        # much an effect beside both explains.
        by_term = full.log_likelihood - selected.log_likelihood_at(full.noise)
        enough = min(settings.compensating_share * whole, by_term)
        if not is_needed(wide, full, left) or full.log_likelihood - left.log_likelihood < enough:
            full, kept = fit_with_noise(wide, left.hypothesis, left), kept.without(name)
    if kept != selected.hypothesis:
        selected = fit_with_noise(evaluator, kept, selected)
    if not kept.names:
        # The mechanisms took part of the effect when the term was chosen.
        comparison = compare_nonparametric_terms(
            wide, wide.fit(Hypothesis(), selected.noise, selected)
        )
        if comparison is not None and passes_heldout_test(
            comparison.held_out_gain, wide.settings.held_out_test
        ):
            term, full = comparison.ranked[0].name, comparison.ranked[0].fitted
            nats = float(comparison.held_out_gain.sum())
            places = places_of(comparison, settings)
    return selected, NonparametricFit(term, full, nats, places)


def special_case_of(
    evaluator: Evaluator, selected: FittedModel, unnamed: NonparametricFit
) -> FittedModel | None:
    """The selected mechanisms and one that a nonparametric term contains, if it is most of it.

    Forward selection may have gone another way: a lag of the valve in a lung of high resistance
    looks like a circuit at first, and three names that make up for that are no better than the
    term, which replaces them. What the term stands for has a name all the same.

    Args:
        evaluator: evaluator with the library's parameters.
        selected: the mechanisms that are kept beside the term.
        unnamed: the term beside them.

    Returns:
        The mechanisms with the new one last, fitted with its noise; None if none is needed that
        explains at least half of what the term does, or nearly all of it where the term may be no
        more than the form of a mechanism that is selected already.
    """
    related = special_cases(unnamed.term)
    others = set(related) - set(selected.names)
    names = tuple(name for name in evaluator.allowed_mechanisms if name in others)
    if not names:
        return None
    settings = evaluator.settings.refinement
    is_form = bool(set(related) & set(selected.names))  # the term may be the form of a name
    share = settings.beside_related_share if is_form else settings.related_share
    noise = unnamed.full.noise
    without = evaluator.fit(selected.hypothesis, noise, selected)
    whole = unnamed.full.log_likelihood - without.log_likelihood
    white = fit_with_white_noise(evaluator, selected)
    candidates = screen_mechanisms(selected, white, names)
    comparison = compare_candidates(evaluator, selected, candidates, white)
    # R, C and the valves that were fitted beside the term are near the truth; those fitted without
    # it make up for the effect, and a fit that starts from them may end in a local minimum.
    trials = parallel_map(
        lambda name: evaluator.fit(
            selected.hypothesis.plus(Hypothesis((name,))), noise, unnamed.full
        ),
        [name for name in names if not varies_by_breath(name)],
    )
    if comparison is not None:
        trials.append(comparison.ranked[0].fitted)
    if not trials:
        return None
    first = min(trials, key=lambda trial: evaluator.criterion(trial, noise))
    best = fit_with_noise(evaluator, first.hypothesis, first)
    by_name = best.log_likelihood_at(noise) - without.log_likelihood
    if by_name < share * whole:
        return None
    if not is_plausible(best, best.names[-1], evaluator.settings.plausibility):
        return None
    beside = evaluator.fit(selected.hypothesis, best.noise, selected)
    return best if is_needed(evaluator, best, beside) else None


def eliminate_beside_input(
    evaluator: Evaluator, selected: FittedModel, latent: LatentInput, nats: float
) -> FittedModel:
    """Drop the mechanisms that are not needed beside a latent input.

    An input differs from breath to breath and can take over what is the same in all breaths.
    Mechanisms that explain more than the input are therefore kept in any case.

    Args:
        evaluator: evaluator of the recording.
        selected: the selected mechanisms.
        latent: the input.
        nats: held-out log-likelihood that the input gains.
    """
    current = without_breath_terms(evaluator, selected)
    gains = parallel_map(partial(_held_out_gain, evaluator, current), current.names)
    strong = {name for name, gain in zip(current.names, gains, strict=True) if gain > nats}
    if _is_effort(evaluator, selected, current, latent):
        current = selected
    while True:
        asked = [
            name for name in current.names if not varies_by_breath(name) and name not in strong
        ]
        idle = [
            removal
            for removal in parallel_map(
                partial(_without_idle, evaluator, current, latent, nats), asked
            )
            if removal is not None
        ]
        if not idle:
            return current
        # The least needed one first: others may be needed once it has gone.
        _, current, latent = min(idle, key=itemgetter(0))


def without_breath_terms(evaluator: Evaluator, selected: FittedModel) -> FittedModel:
    """The model without terms that differ from breath to breath: a latent input replaces them."""
    own = selected.hypothesis.breath_terms
    if not own:
        return selected
    return evaluator.fit(selected.hypothesis.without(*own), selected.noise, selected)


def _held_out_gain(evaluator: Evaluator, selected: FittedModel, name: str) -> float:
    """Held-out log-likelihood that a mechanism gains beside the others, nats."""
    left = evaluator.fit(selected.hypothesis.without(name), selected.noise, selected)
    held_out = evaluator.held_out_log_likelihood(selected)
    return float((held_out - evaluator.held_out_log_likelihood(left)).sum())


def _without_idle(
    evaluator: Evaluator, current: FittedModel, latent: LatentInput, nats: float, name: str
) -> tuple[float, FittedModel, LatentInput] | None:
    """Nats lost without a mechanism beside an input, and what is left; None if it is needed.

    ``nats`` are those that the input gains on held-out breaths.
    """
    left = evaluator.fit(current.hypothesis.without(name), current.noise, current)
    shared = without_breath_terms(evaluator, left)
    other = fit_latent_inputs(evaluator, shared, (latent.place,))[latent.place]
    lost = latent.held_out_log_likelihood - other.held_out_log_likelihood
    # Beside an input that explains much, a mechanism may only trim its linearised response.
    settings, test = evaluator.settings.refinement, evaluator.settings.held_out_test
    least = max(test.threshold, min(settings.compensating_share * nats, settings.shortfall_nats))
    needed = passes_heldout_test(lost, test, least)
    return None if needed else (float(lost.sum()), left, other)


def _is_effort(
    evaluator: Evaluator, selected: FittedModel, without: FittedModel, latent: LatentInput
) -> bool:
    """Whether an input is patient effort of another form: effort explains most of it."""
    if not selected.hypothesis.breath_terms or latent.periodic or latent.place != ALVEOLUS:
        return False
    none = log_likelihood_without_input(evaluator, without)[1].sum()
    by_effort = log_likelihood_without_input(evaluator, selected)[1].sum() - none
    by_input = latent.held_out_log_likelihood.sum() - none
    return bool(by_effort >= evaluator.settings.refinement.related_share * by_input)
