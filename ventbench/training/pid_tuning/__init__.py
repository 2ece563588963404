"""The exhaustive search for PID gains: in parts that are kept, anywhere, and its results."""

from ventbench.training.pid_tuning.grid import Grid, tune
from ventbench.training.pid_tuning.table import best_gains, read, summary, write

__all__ = ["Grid", "best_gains", "read", "summary", "tune", "write"]
