"""Fits of physics to measurements: data, noise, unknowns, search, intervals."""

from ventbench.system_id.data import Data, recorded
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.fit import Fit, fit, held_out
from ventbench.system_id.noise import Noise, estimate
from ventbench.system_id.problem import Problem, settings
from ventbench.system_id.profile import Interval, interval, profile
from ventbench.system_id.unknowns import Unknowns, freed, unknowns

__all__ = [
    "START",
    "Data",
    "Fit",
    "Interval",
    "Noise",
    "Problem",
    "Simulator",
    "Unknowns",
    "estimate",
    "fit",
    "freed",
    "held_out",
    "interval",
    "profile",
    "recorded",
    "settings",
    "unknowns",
]
