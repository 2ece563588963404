"""A PID for all lungs, corrected by the choice that a network, trained by DQN, values highest."""

import network
import numpy as np

# Corrections to choose from, %.
CHOICES = np.array(
    [-90, -60, -40, -25, -15, -9, -5, -2.5, -1, 0, 1, 2.5, 5, 9, 15, 25, 40, 60, 90], float
)

#: Each reading so far above the target, cmH2O, leaves this share of the largest command until the
#: run ends: the loop swings on rigs that answer later than those of the training.
ABOVE, SHARE = 8.0, 0.7

NETWORKS = network.load()


class Controller:
    """One for each run of three breaths."""

    def reset(self, task):
        """Take the network of the lung, or the one for all if the lung is not told."""
        self.network = NETWORKS[task.lung or "all"]
        self.features, self.most = self.network.features(), 100.0

    def act(self, observation):
        """Return u_in, %: the PID plus the correction of the highest value."""
        x, base = self.features(observation)
        if observation.pressure > observation.target + ABOVE:
            self.most *= SHARE
        return min(base + CHOICES[np.argmax(self.network(x))], self.most)
