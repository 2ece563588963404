"""Whether held-out breaths ask for a term, and whether it is a statement about a rig.

A likelihood asks only whether a term helps. A term may help by imitating another one with a
strength that no rig has, such as muscles that push where an effort pulls, or with one that is too
small to be told from a clock, an integrator or the form of another term. Bounds of parameters rule
out impossible values; what remains is ruled out here, by figures that each mechanism's file gives.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.diagnosis.settings import DEFAULT, HeldOutTestSettings, PlausibilitySettings
from ventbench.mechanics.labels import Estimate
from ventbench.physics.catalogue import mechanism, strength_path
from ventbench.system_id.data import Floats


def is_plausible(fitted: FittedModel, name: str, settings: PlausibilitySettings) -> bool:
    """Whether a mechanism's strength is at least the smallest that is named.

    An effort must reach that strength in some breaths, and nearly all of what does must pull.

    Args:
        fitted: a model with the mechanism.
        name: name of the mechanism, or of a basis term, which has no least strength.
        settings: every threshold.
    """
    about = mechanism(name).description
    beyond = fitted.column(strength_path(name)) - about.strength.neutral
    felt = np.abs(beyond) >= about.least
    if not varies_by_breath(name):
        return bool(felt.any())
    enough = felt.sum() >= max(settings.effort_breaths, settings.effort_share * len(felt))
    # By their squares: a breath without an effort may be given a small one of either sign.
    square = np.where(felt, beyond**2, 0.0)
    return bool(enough and square[beyond > 0].sum() >= settings.effort_pulls * square.sum())


def excludes_neutral(estimate: Estimate, name: str) -> bool:
    """Whether the 95 % interval of a mechanism's strength excludes that it is off.

    Args:
        estimate: estimate of the strength.
        name: name of the mechanism.
    """
    low, high = estimate.ci95
    neutral = mechanism(name).description.strength.neutral
    return not (np.isfinite(low) and np.isfinite(high)) or not low <= neutral <= high


def is_weak(name: str, beyond: Floats, share: float) -> bool:
    """Whether a mechanism's strengths are at most a share of what a mild one is beyond none.

    Args:
        name: name of the mechanism.
        beyond: by how much strengths differ from none, or from others, in their unit.
        share: the share.
    """
    strength = mechanism(name).description.strength
    return bool(np.max(np.abs(beyond)) <= share * abs(strength.mild - strength.neutral))


def is_consistent(gains: np.ndarray, settings: PlausibilitySettings) -> bool:
    """Whether held-out breaths agree that a mechanism helps.

    The sum over breaths must be positive, and so must all but the lowest few percent of the sums of
    resampled breaths (bootstrap by breath).

    Args:
        gains: log-likelihood that the mechanism gains in each held-out breath, nats, ``(n,)``.
        settings: every threshold.
    """
    if gains.sum() <= 0.0:
        return False
    if len(gains) < settings.bootstrap_breaths:
        return True
    rng = np.random.default_rng(0)
    drawn = gains[rng.integers(0, len(gains), (settings.bootstraps, len(gains)))]
    return bool(np.quantile(drawn.sum(axis=1), settings.bootstrap_level) > 0.0)


def explained_share(worth: float, left: float, rest: float) -> float:
    """Share of the squared error which is no noise that a name explains, 0..1.

    A name may be no more than the shadow of an effect that the library lacks: if one effect causes
    both, the name's part is the squared correlation of its template with that effect.

    Args:
        worth: root-mean-square error that the name takes away, cmH2O; NaN if unknown.
        left: error with the name, cmH2O.
        rest: part of it that tests of the residuals show to be no noise, cmH2O.

    Returns:
        The share; 1 where nothing is known to be left.
    """
    explained = max(worth, 0.0) * (2.0 * left + max(worth, 0.0))
    return explained / (explained + rest**2) if rest > 0.0 and np.isfinite(worth) else 1.0


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


def drop_redundant_terms(
    evaluator: Evaluator, current: FittedModel, names: Sequence[str]
) -> FittedModel:
    """Drop terms that are not needed, or negligible.

    Args:
        evaluator: evaluator of the recording.
        current: the model.
        names: the terms to judge.
    """
    for name in names:
        without = evaluator.fit(current.hypothesis.without(name), current.noise, current)
        needed = is_needed(evaluator, current, without)
        if not needed or is_negligible(evaluator, current, without, name):
            current = without
    return current
