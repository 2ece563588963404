"""What a network is shown, the PID that it corrects, and its layers: plain numpy."""

from pathlib import Path

import numpy as np

GAINS = (6.0, 6.0, 0.3)  # P, I, D, %/cmH2O: one set for all lungs, the best of the paper's grid
TIME_CONSTANT = 0.5  # s, of both averages
PAST = 4  # errors and commands before this step that are shown
# With the breath before: earlier errors and commands of this breath, and steps of the last one.
ERRORS, COMMANDS, AHEAD = 5, 6, 6
BIAS, DT = 5.0, 0.03  # %, the command before an inspiration; s, the nominal control step


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


class LookingBack:
    """The features of `residual_mlp`: this breath, and the one before from this step on."""

    def __init__(self):
        """Nothing is known before the first breath."""
        self.errors, self.commands = [], []  # at each step of this breath, cmH2O and %

    def __call__(self, observation):
        """Return the features, all of the order of 1, and the command of the PID, %."""
        if observation.time == 0:
            self.errors_before, self.commands_before = self.errors, self.commands
            self.errors, self.commands = [], []
            self.before = self.integral = self.derivative = 0.0
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before = error
        # The latest first; before the breath the first error and the bias flow.
        past = (self.errors[::-1] + [self.errors[0] if self.errors else error] * ERRORS)[:ERRORS]
        self.errors.append(error)
        self.commands.append(observation.previous_u_in)
        commands = (self.commands[::-1] + [BIAS] * COMMANDS)[:COMMANDS]
        step = len(self.errors) - 1
        errors = [error, self.integral, self.derivative, *past, *window(self.errors_before, step)]
        known = float(len(self.errors_before) > 0)
        rest = [observation.target / 40, observation.time, (observation.dt / DT - 1) / 0.1, known]
        commands += window(self.commands_before, step)
        p, i, d = GAINS
        base = min(max(p * error + i * self.integral + d * self.derivative, 0.0), 100.0)
        return np.concatenate([np.array(errors) / 10, rest, np.array(commands) / 100]), base


def window(values, first):
    """Return the values of the breath before from a step on, zero where there are none."""
    return (values[first : first + AHEAD] + [0.0] * AHEAD)[:AHEAD]


class Network:
    """Dense layers with tanh between them: layer k does ``x @ wk + bk``."""

    def __init__(self, arrays, name):
        """Take the layers ``name.w0``, ``name.b0``, ``name.w1``, ... out of an npz file."""
        count = sum(key.startswith(f"{name}.w") for key in arrays)
        layers = [[arrays[f"{name}.{kind}{k}"] for kind in "wb"] for k in range(count)]
        self.layers = [(w.astype(float), b.astype(float)) for w, b in layers]

    def features(self):
        """Return what it is shown, which its number of inputs tells."""
        return Features() if len(self.layers[0][0]) == 7 + 2 * PAST else LookingBack()

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
