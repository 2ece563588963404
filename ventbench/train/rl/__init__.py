"""Reinforcement learning of a correction of the PID: policy gradient, PPO and DQN."""
