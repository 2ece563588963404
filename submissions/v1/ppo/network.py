"""What a network is shown, the PID that it corrects, and its layers: plain numpy."""

from pathlib import Path

import numpy as np

GAINS = (6.0, 6.0, 0.3)  # P, I, D, %/cmH2O: one set for all lungs, the best of the paper's grid
TIME_CONSTANT = 0.5  # s, of both averages
PAST = 4  # errors and commands before this step that are shown


class Features:
    """Error, averages, command of the PID, targets, time, and the last errors and commands."""

    def __init__(self):
        """Nothing is known before the first step, which begins a breath."""
        self.before = self.integral = self.derivative = 0.0
        self.errors = self.commands = []

    def __call__(self, observation):
        """Return the features, all of the order of 1, and the command of the PID, %."""
        error = observation.target - observation.pressure
        if observation.time == 0:  # a new breath
            self.before = self.integral = self.derivative = 0.0
            self.errors = [error] * PAST
            self.commands = [observation.previous_u_in] * PAST
        self.commands = [observation.previous_u_in, *self.commands[:-1]]
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        p, i, d = GAINS
        base = min(max(p * error + i * self.integral + d * self.derivative, 0.0), 100.0)
        now = (
            error / 10,
            self.integral / 10,
            self.derivative,
            base / 50 - 1,
            observation.target / 40,
            observation.targets_ahead[-1] / 40,
            observation.time,
        )
        past = (value / 10 for value in self.errors)
        commands = (value / 50 - 1 for value in self.commands)
        self.before, self.errors = error, [error, *self.errors[:-1]]
        return np.array([*now, *past, *commands]), base


class Network:
    """Dense layers with tanh between them: layer k does ``x @ wk + bk``."""

    def __init__(self, arrays, name):
        """Take the layers ``name.w0``, ``name.b0``, ``name.w1``, ... out of an npz file."""
        count = sum(key.startswith(f"{name}.w") for key in arrays)
        layers = [[arrays[f"{name}.{kind}{k}"] for kind in "wb"] for k in range(count)]
        self.layers = [(w.astype(float), b.astype(float)) for w, b in layers]

    def __call__(self, x):
        """Return the outputs for one vector of features."""
        for w, b in self.layers[:-1]:
            x = np.tanh(x @ w + b)
        w, b = self.layers[-1]
        return x @ w + b


def load():
    """Networks by the lung they are for; ``all`` does not know it."""
    with np.load(Path(__file__).with_name("weights.npz")) as file:
        arrays = dict(file)
    return {name: Network(arrays, name) for name in sorted({key.split(".")[0] for key in arrays})}
