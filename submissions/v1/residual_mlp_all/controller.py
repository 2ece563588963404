"""A PID and a network that corrects it, which looks back at this breath and at the one before."""

from pathlib import Path

import numpy as np

TIME_CONSTANT = 0.5  # s, of the PID's averages
BIAS = 5.0  # %, the command before an inspiration
DT = 0.03  # s, the nominal control step
# What brings features to the order of 1: cmH2O, cmH2O, %, share of the control step.
ERROR, TARGET, COMMAND, STEP = 10.0, 40.0, 100.0, 0.1


class Network:
    """One network of the file: dense layers with tanh between them, and the PID it corrects."""

    def __init__(self, file, name):
        self.gains = file[f"{name}.gains"].tolist()  # P, I, D, %/cmH2O
        self.limit = float(file[f"{name}.limit"])  # of the correction, %
        self.pressures, self.commands, self.ahead = file[f"{name}.windows"].tolist()
        count = sum(key.startswith(f"{name}.b") for key in file.files)
        self.layers = [
            (file[f"{name}.w{k}"].astype(float), file[f"{name}.b{k}"].astype(float))
            for k in range(count)
        ]

    def __call__(self, x):
        """Return the correction, %."""
        for w, b in self.layers[:-1]:
            x = np.tanh(x @ w + b)
        w, b = self.layers[-1]
        return self.limit * float(np.tanh(x @ w + b)[0])


def load():
    """Return the networks of the file by their lung; the one for all lungs is named `all`."""
    with np.load(Path(__file__).with_name("weights.npz"), allow_pickle=False) as file:
        names = [key.removesuffix(".gains") for key in file.files if key.endswith(".gains")]
        return {name: Network(file, name) for name in names}


NETWORKS = load()


def window(values, first, count):
    """Return `count` values from `first` on, zero where there are none."""
    return (values[first : first + count] + [0.0] * count)[:count]


class Controller:
    """`u_in = PID + limit tanh(network(features))`, %."""

    def reset(self, task):
        self.network = NETWORKS[task.lung if task.lung in NETWORKS else "all"]
        self.errors, self.commands = [], []  # at each step of this breath, cmH2O and %

    def begin(self):
        """Start a breath: what was seen of the last one is what is known of it."""
        self.errors_before, self.commands_before = self.errors, self.commands
        self.errors, self.commands = [], []
        self.before = self.integral = self.derivative = 0.0

    def act(self, observation):
        if observation.time == 0:
            self.begin()
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before = error
        self.errors.append(error)
        self.commands.append(observation.previous_u_in)
        p, i, d = self.network.gains
        pid = p * error + i * self.integral + d * self.derivative
        return pid + self.network(self.features(observation))

    def features(self, observation):
        """Return what the network is shown."""
        network, step = self.network, len(self.errors) - 1
        # The latest first; before the breath the first error and the bias flow.
        past = self.errors[-2::-1] + [self.errors[0]] * network.pressures
        commands = self.commands[::-1] + [BIAS] * network.commands
        errors = [
            self.errors[-1],
            self.integral,
            self.derivative,
            *past[: network.pressures],
            *window(self.errors_before, step, network.ahead),
        ]
        known = float(len(self.errors_before) > 0)
        rest = [
            observation.target / TARGET,
            observation.time,
            (observation.dt / DT - 1.0) / STEP,
            known,
        ]
        given = commands[: network.commands] + window(self.commands_before, step, network.ahead)
        return np.concatenate([np.array(errors) / ERROR, rest, np.array(given) / COMMAND])
