"""System identification: data, noise, predictions, least squares, fits and their intervals."""

from ventbench.system_id.data import Data, make_data
from ventbench.system_id.fit import (
    ConfidenceInterval,
    Fit,
    fit,
    interval,
    profile_interval,
    refit_breath_parameters,
)
from ventbench.system_id.noise import Noise, robust_noise
from ventbench.system_id.predictor import START, Predictor
from ventbench.system_id.problem import (
    Problem,
    Unknowns,
    free_paths,
    make_unknowns,
    parameter_values,
)

__all__ = [
    "START",
    "ConfidenceInterval",
    "Data",
    "Fit",
    "Noise",
    "Predictor",
    "Problem",
    "Unknowns",
    "fit",
    "free_paths",
    "interval",
    "make_data",
    "make_unknowns",
    "parameter_values",
    "profile_interval",
    "refit_breath_parameters",
    "robust_noise",
]
