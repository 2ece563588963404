"""Other mechanisms that could take the place of a selected one: exchanged for it, or listed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.selection.acceptance import is_plausible, passes_heldout_test
from ventbench.diagnosis.selection.candidate_comparison import (
    Comparison,
    RankedModel,
    compare_candidates,
    fit_with_noise,
    fit_with_white_noise,
)
from ventbench.diagnosis.selection.screening import screen_mechanisms
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats


@dataclass(frozen=True, eq=False)
class Alternatives:
    """Alternative explanations of the effect of a selected mechanism."""

    names: tuple[str, ...]  #: other mechanisms, the likeliest first.
    confidence: float  #: posterior probability of the selected mechanism, with equal priors.
    models: tuple[RankedModel, ...]  #: the fitted alternatives among the library's mechanisms.


#: Alternatives that have been fitted, the best first, by the rest of a hypothesis and the name that
#: they replace.
Replacements = dict[tuple[Hypothesis, str], list[RankedModel]]


def exchange(
    evaluator: Evaluator,
    selected: FittedModel,
    comparisons: list[Comparison],
    known: Replacements,
) -> FittedModel | None:
    """The model with one mechanism exchanged, if BIC and held-out breaths prefer it; else None.

    A mechanism that tied with the right one in its round may be worse beside the later ones.

    Args:
        evaluator: evaluator of the recording.
        selected: the selected mechanisms.
        comparisons: comparisons of the forward selection, which answer part of the question.
        known: receives what is fitted.
    """
    held_out = evaluator.held_out_log_likelihood(selected)
    for model in _better(
        evaluator, selected, _replacements(evaluator, selected, comparisons, known)
    ):
        fitted = evaluator.fit(model.hypothesis, selected.noise, model)
        gained = evaluator.held_out_log_likelihood(fitted) - held_out
        if passes_heldout_test(gained, evaluator.settings.held_out_test):
            return fit_with_noise(evaluator, fitted.hypothesis, fitted)
    return None


def find_alternatives(
    evaluator: Evaluator,
    selected: FittedModel,
    comparisons: list[Comparison],
    *,
    swap: bool = True,
    known: Replacements | None = None,
) -> tuple[FittedModel, dict[str, Alternatives]]:
    """Replace each mechanism by every other one.

    Args:
        evaluator: evaluator of the recording.
        selected: the selected mechanisms.
        comparisons: comparisons of the forward selection, which answer part of the question.
        swap: whether a better mechanism takes the place of a selected one.
        known: what :func:`exchange` has fitted.

    Returns:
        The best model, and the alternatives to each of its mechanisms.
    """
    known = {} if known is None else known
    for last in (False, False, True):
        ranked = _replacements(evaluator, selected, comparisons, known)
        better = _better(evaluator, selected, ranked)
        if last or not swap or not better:
            break
        selected, comparisons = better[0], []
    criterion = evaluator.criterion(selected)
    return selected, {
        name: _alternatives(evaluator, name, models, criterion) for name, models in ranked.items()
    }


def _replacements(
    evaluator: Evaluator,
    selected: FittedModel,
    comparisons: list[Comparison],
    known: Replacements,
) -> dict[str, list[RankedModel]]:
    """Alternatives to each mechanism at the noise of the selected model, the best first."""
    rest = {name: selected.hypothesis.without(name) for name in selected.names}
    asked = [name for name in selected.names if (rest[name], name) not in known]
    fitted = parallel_map(partial(_fitted_instead, evaluator, selected, comparisons), asked)
    known |= {(rest[name], name): models for name, models in zip(asked, fitted, strict=True)}

    def at_noise(model: RankedModel) -> RankedModel:
        criterion = evaluator.criterion(model.fitted, selected.noise)
        return RankedModel(model.name, model.fitted, criterion)

    return {
        name: sorted(map(at_noise, known[rest[name], name]), key=lambda model: model.criterion)
        for name in selected.names
    }


def _better(
    evaluator: Evaluator, selected: FittedModel, ranked: dict[str, list[RankedModel]]
) -> list[FittedModel]:
    """Models with one mechanism exchanged that BIC prefers, if it is large enough to be named."""
    criterion, settings = evaluator.criterion(selected), evaluator.settings.plausibility
    firsts = (models[0] for models in ranked.values() if models)
    return [
        first.fitted
        for first in sorted(firsts, key=lambda first: first.criterion)
        if first.criterion < criterion and is_plausible(first.fitted, first.name, settings)
    ]


def _fitted_instead(
    evaluator: Evaluator, selected: FittedModel, comparisons: list[Comparison], name: str
) -> list[RankedModel]:
    """Models with another mechanism in the place of one."""
    count = evaluator.settings.refinement.compared_alternatives
    rest = selected.hypothesis.without(name)
    known = [
        comparison
        for comparison in comparisons
        if comparison.base.hypothesis == rest and comparison.ranked[0].name == name
    ]
    if known:
        # Those that stayed far behind were not fitted to the end.
        return list(known[-1].ranked[1 : count + 1])
    base = evaluator.fit(rest, selected.noise, selected)
    white = fit_with_white_noise(evaluator, base)
    candidates = screen_mechanisms(base, white, evaluator.allowed_mechanisms)
    others = [candidate for candidate in candidates if candidate.name != name]
    comparison = compare_candidates(evaluator, base, others, white, restarts=False, rival=selected)
    if comparison is None or not passes_heldout_test(
        comparison.held_out_gain, evaluator.settings.held_out_test
    ):
        return []
    return list(comparison.ranked[:count])


def _alternatives(
    evaluator: Evaluator, name: str, models: list[RankedModel], criterion: float
) -> Alternatives:
    settings = evaluator.settings.refinement
    limit = criterion + settings.close_criterion
    close = [model for model in models if model.criterion < limit]
    close = close[: settings.listed_alternatives]
    behind = np.array([max(model.criterion - criterion, 0.0) for model in close])
    odds: Floats = np.exp(-0.5 * behind)
    names = tuple(model.name for model in close) + mechanism(name).description.equivalents
    confidence = float(1.0 / (1.0 + odds.sum()))
    return Alternatives(names[: settings.listed_alternatives], confidence, tuple(close))
