"""Lung mechanics from pressure with flow or volume, and whether a lung is what its label says."""

from ventbench.mechanics.identify import Mechanics as Mechanics
from ventbench.mechanics.identify import identify as identify
from ventbench.mechanics.identify import share_faults as share_faults
from ventbench.mechanics.labels import match_labels as match_labels
from ventbench.mechanics.respiraworks import RespiraWorksRun as RespiraWorksRun
from ventbench.mechanics.respiraworks import SurveyedRun as SurveyedRun
from ventbench.mechanics.respiraworks import breaths_of as breaths_of
from ventbench.mechanics.respiraworks import load_respiraworks as load_respiraworks
from ventbench.mechanics.respiraworks import survey as survey
from ventbench.mechanics.respiraworks import survey_table as survey_table
