"""Fits of physics to measurements: data, noise, unknowns, search, intervals."""

from ventbench.physics.fits.data import Data, recorded
from ventbench.physics.fits.derivatives import START, Simulator
from ventbench.physics.fits.fit import Fit, fit, held_out
from ventbench.physics.fits.noise import Noise, estimate
from ventbench.physics.fits.problem import Problem, settings
from ventbench.physics.fits.profile import Interval, interval, profile
from ventbench.physics.fits.unknowns import Unknowns, freed, unknowns

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
