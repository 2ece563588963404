"""Lung mechanics from pressure with flow or volume, and whether a lung is what its label says."""

from ventbench.mechanics.identify import Mechanics, Term, identify
from ventbench.mechanics.labels import (
    match_label,
    match_labels,
    matching_settings,
    settings_by_label,
)
from ventbench.mechanics.respiraworks import SurveyedRun, breaths_of, survey, survey_table

__all__ = [
    "Mechanics",
    "SurveyedRun",
    "Term",
    "breaths_of",
    "identify",
    "match_label",
    "match_labels",
    "matching_settings",
    "settings_by_label",
    "survey",
    "survey_table",
]
