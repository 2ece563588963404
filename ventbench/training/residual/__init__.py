"""A network that corrects a PID, trained through the simulators (the paper's controller)."""

from ventbench.training.residual.fit import fit
from ventbench.training.residual.recipe import Progress, Recipe
from ventbench.training.residual.weights import ALL, load, save

__all__ = ["ALL", "Progress", "Recipe", "fit", "load", "save"]
