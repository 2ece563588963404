"""Lung mechanics from pressure with flow or volume, and whether a lung is what its label says."""

from ventbench.mechanics.fitted import Term
from ventbench.mechanics.identify import Mechanics, identify
from ventbench.mechanics.labels import label, labels, match, matching, settings_of
from ventbench.mechanics.respiraworks import Surveyed, breaths_of, survey, table

__all__ = [
    "Mechanics",
    "Surveyed",
    "Term",
    "breaths_of",
    "identify",
    "label",
    "labels",
    "match",
    "matching",
    "settings_of",
    "survey",
    "table",
]
