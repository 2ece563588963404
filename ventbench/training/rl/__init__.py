"""Learning a correction of the PID: policy gradient through the simulator, PPO, DQN."""
