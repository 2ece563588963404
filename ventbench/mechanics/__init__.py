"""Lung mechanics from pressure with flow or volume, and whether a lung is what its label says."""

from ventbench.mechanics.identify import Mechanics as Mechanics
from ventbench.mechanics.identify import identify as identify
from ventbench.mechanics.identify import share_faults as share_faults
from ventbench.mechanics.labels import match_labels as match_labels
