"""A network that corrects a PID, trained through the simulators (the paper's controller)."""

from ventbench.training.residual.fit import ResidualConfig, fit
from ventbench.training.residual.train import train_residual

__all__ = ["ResidualConfig", "fit", "train_residual"]
