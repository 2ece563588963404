"""Whether a fitted mechanism is a statement about a rig: its sign, its size, its interval.

A likelihood asks only whether a term helps. A term may help by imitating another one with a
strength that no rig has, such as muscles that push where an effort pulls, or with one that is too
small to be told from a clock, an integrator or the form of another term. Bounds of parameters rule
out impossible values; what remains is ruled out here, by figures that each mechanism's file gives.
"""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.hypothesis import FittedModel, varies_by_breath
from ventbench.diagnosis.settings import PlausibilitySettings
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
