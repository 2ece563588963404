"""A policy whose network gives the mean action in -1..1; it starts as a PI controller."""

from network import Features, Network

network = Network()


class Controller:
    """One for each run of three breaths."""

    def reset(self, task):
        """Prepare; task.lung names the lung in the performance track, else it is None."""
        self.features = Features()

    def act(self, observation):
        """Return u_in, %, for the next step: the mean action, without exploration."""
        action = min(max(network(self.features(observation))[0], -1.0), 1.0)
        return 50 + 50 * action
