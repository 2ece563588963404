"""A PI controller plus a small network that corrects it; the network starts as zero."""

from network import Features, Network

GAINS = (1.0, 10.0)  # P, I, %/cmH2O
LARGEST = 20.0  # of the correction, %

network = Network()


class Controller:
    """One for each run of three breaths."""

    def reset(self, task):
        """Prepare; task.lung names the lung in the performance track, else it is None."""
        self.features = Features()

    def act(self, observation):
        """Return u_in, %, for the next step."""
        x = self.features(observation)
        correction = min(max(network(x)[0], -1.0), 1.0)
        p, i = GAINS
        return 10 * (p * x[0] + i * x[1]) + LARGEST * correction
