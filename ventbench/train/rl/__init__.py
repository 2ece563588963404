"""Reinforcement learning of a correction of the PID: environment, trainings side by side."""
