"""Search with the lung that the label says, where the usual search has left it far behind.

Strong lags let a refit take R to nothing, and three or four terms then imitate what the lags do in
a lung without resistance. No step from there leads back. With R and C held at the label until the
terms are there, the lags are found at once; with R and C free again, BIC and held-out breaths
choose between the two results.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel
from ventbench.diagnosis.selection.candidate_comparison import Comparison, fit_with_noise
from ventbench.diagnosis.selection.forward import (
    Progress,
    Replacement,
    drop_redundant_terms,
    forward_selection,
)

#: Values of the lung that are held.
_LUNG = ("R", "C")


def is_far_from_label(evaluator: Evaluator, selected: FittedModel) -> bool:
    """Whether R or C of a recording of one lung is a large factor away from its label."""
    if evaluator.at_label is None:
        return False
    data, factor = evaluator.training.data, evaluator.settings.forward.label_factor
    ratios = np.concatenate([selected.column("R") / data.R, selected.column("C") / data.C])
    return bool(np.any(np.abs(np.log(ratios)) > np.log(factor)))


def selection_at_label(
    evaluator: Evaluator, tell: Progress, replacement: Replacement
) -> tuple[FittedModel, list[Comparison]]:
    """Select terms with R and C at the label, free R and C, and go on.

    Args:
        evaluator: evaluator of a recording of one lung.
        tell: called with a description of each step before it runs.
        replacement: see :func:`~ventbench.diagnosis.selection.forward.forward_selection`.
    """
    label = evaluator.at_label
    assert label is not None, "a recording of several labels is not searched at one"
    tell("searching with the labelled lung")
    held, _ = forward_selection(evaluator, fit_with_noise(evaluator, label), tell)
    fixed = tuple((path, value) for path, value in held.hypothesis.fixed if path not in _LUNG)
    free = fit_with_noise(evaluator, replace(held.hypothesis, fixed=fixed), held)
    return forward_selection(
        evaluator, drop_redundant_terms(evaluator, free, free.names), tell, replacement
    )
