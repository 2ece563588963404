"""Training of the learned plant, the paper's network."""

from ventbench.training.learned.fit import LearnedConfig, fit

__all__ = ["LearnedConfig", "fit"]
