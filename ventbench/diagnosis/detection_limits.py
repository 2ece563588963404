"""Which strength of each mechanism a recording would have shown, had it been there.

"Nothing is missing" is worth as much as the recording could tell. The effect of a mechanism on the
prediction, less what a refit absorbs, is a template (see :mod:`.linearisation`). Its power is twice
the log-likelihood that the mechanism would gain. The limit is the strength at which the testing
breaths are expected to gain twice what they must.
"""

from __future__ import annotations

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, varies_by_breath
from ventbench.diagnosis.linearisation import Linearisation, linearise
from ventbench.diagnosis.settings import DetectionSettings
from ventbench.physics.catalogue import mechanism, strength_path


def detection_limits(evaluator: Evaluator, fitted: FittedModel) -> dict[str, float]:
    """Smallest strength of each mechanism that would have been seen.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model in which nothing more is missing, fitted to the training breaths.

    Returns:
        Distance from the neutral strength, in its unit, by name; infinite if not even the largest
        possible strength would have been seen. Mechanisms that differ from breath to breath are
        left out, and none is below the least strength that is named.
    """
    linear = linearise(fitted.problem, fitted.minimum.x, evaluator.settings.screening)
    count = [float(part.data.weight.sum()) for part in (evaluator.held_out, evaluator.training)]
    share = count[0] / max(count[1], 1.0)
    settings = evaluator.settings.detection
    names = [
        name
        for name in evaluator.allowed_mechanisms
        if name not in fitted.names and not varies_by_breath(name)
    ]
    limits = parallel_map(lambda name: _limit(linear, name, share, settings), names)
    return dict(zip(names, limits, strict=True))


def _limit(linear: Linearisation, name: str, share: float, settings: DetectionSettings) -> float:
    """Strength at which the testing breaths gain enough, by the secant from two strengths."""
    about = mechanism(name).description
    strength, predictor = about.strength, linear.problem.predictor
    column = predictor.names.index(strength_path(name))
    largest = abs(strength.high - strength.neutral)
    distance = abs(strength.mild - strength.neutral)
    others = [p for p in about.parameters[1:] if not p.shape]
    limit = np.inf
    for _ in range(settings.rounds):
        trial = linear.values.copy()
        trial[:, column] = strength.neutral + distance
        for other in others:
            trial[:, predictor.names.index(f"{name}.{other.name}")] = other.mild
        template = linear.template(predictor.predict(trial))
        nats = 0.5 * share * float(np.sum(template**2))
        if not nats > 0.0:
            return np.inf
        limit = distance * float(np.sqrt(settings.nats / nats))
        if limit > largest and distance >= largest:
            return np.inf
        distance = float(np.clip(limit, 0.2 * distance, largest))
    return max(limit, about.least) if limit <= largest else np.inf
