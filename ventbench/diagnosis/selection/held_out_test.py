"""Whether held-out breaths ask for a term, and whether it is large enough to be one."""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.plausibility import is_plausible, is_weak
from ventbench.diagnosis.settings import DEFAULT, HeldOutTestSettings
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats


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
    beyond = with_term.column(f"{name}.{about.name}") - about.neutral
    if varies_by_breath(name) or not is_weak(name, beyond, settings.negligible_strength):
        return False
    criterion = evaluator.criterion(with_term)
    base = evaluator.criterion(evaluator.fit(Hypothesis(), with_term.noise, with_term))
    return evaluator.criterion(without_term) - criterion < settings.negligible_share * (
        base - criterion
    )
