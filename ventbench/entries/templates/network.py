"""What the network is shown, and the network: a few dense layers in numpy."""

from pathlib import Path

import numpy as np

TIME_CONSTANT = 0.5  # s, of the averaged error


class Features:
    """Make the network's inputs, all of the order of 1."""

    def __call__(self, observation):
        """Return error, averaged error, pressure, target, target 10 steps ahead, command before."""
        if observation.time == 0:  # a new breath
            self.integral = 0.0
        error = observation.target - observation.pressure
        self.integral += observation.dt / (observation.dt + TIME_CONSTANT) * (error - self.integral)
        return np.array(
            [
                error / 10,
                self.integral / 10,
                observation.pressure / 40,
                observation.target / 40,
                observation.targets_ahead[-1] / 40,
                observation.previous_u_in / 100,
            ]
        )


def activation(x):
    """Between layers."""
    return np.maximum(x, 0.0)


class Network:
    """Layers w0, b0, w1, b1, ... of an npz file; layer k does x @ wk + bk."""

    def __init__(self):
        """Read the weights, which lie beside this file."""
        with np.load(Path(__file__).with_name("weights.npz")) as file:
            self.layers = [(file[f"w{k}"], file[f"b{k}"]) for k in range(len(file.files) // 2)]

    def __call__(self, x):
        """Return the outputs for one input vector."""
        for w, b in self.layers[:-1]:
            x = activation(x @ w + b)
        w, b = self.layers[-1]
        return x @ w + b
