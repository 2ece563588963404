"""A PID with a feed-forward that is learned from breath to breath; there is no model of a lung.

After Reinders et al., "Improving performance of mechanical ventilators by repetitive control"
(arXiv 2004.00312). With ``f`` the feed-forward of a breath and ``e`` its error, each over the steps
of the breath, the next breath has

    f <- b + Q (f - b) + L e

with matrices ``Q`` and ``L``: a breath is over when it is learned from, so that they may look
ahead. After a command at an end of the valve's range an error does not count, so that nothing winds
up. If the readings follow ``T f``, what is wrong in ``f`` is multiplied by ``Q - L T`` from breath
to breath: the learning converges on a rig where the norm of this matrix is below 1. ``make.py``
measures it.

The first breath, which is not scored, has gains that are best for all lungs together. What it took
is compared with what it takes on the six lungs of the protocol; weights of these kinds give the
PID, ``L`` and ``b``, the feed-forward to begin with, and stay. A lung that is told has no doubt.
"""

from pathlib import Path

import numpy as np

#: Steps of an inspiration, and time constant of the averages of the PID, s.
STEPS, TIME_CONSTANT = 34, 0.5

#: Lungs that have parameters of their own.
LUNGS = ("R5C10", "R5C20", "R5C50", "R20C10", "R20C20", "R20C50")

#: A reading so far above the target, cmH2O, closes the valve, and leaves this share of the largest
#: command until the run ends: the loop swings on rigs that answer later than those it was tuned on.
ABOVE, SHARE = 8.0, 0.7


def effort(applied, readings, rise):
    """What a breath took, shape ``(..., 8)``.

    Args:
        applied: commands of a breath, %, shape ``(..., STEPS)``.
        readings: pressures, cmH2O, shape ``(..., STEPS)``.
        rise: that was wanted, cmH2O, shape ``(...)``.

    Returns:
        Logarithms of commands of three parts of the breath for the rise, of the first pressures for
        the first commands, of pressures of three parts for the rise, and of the rise.
    """
    up = readings - readings[..., :1]

    def command(*part):
        return applied[..., slice(*part)].mean(-1) + 1.0

    def pressure(*part):
        return np.maximum(up[..., slice(*part)].mean(-1), 0.2)

    shares = [
        command(16, 33) / rise,
        command(4, 8) / rise,
        pressure(5, 10) / rise,
        command(8, 16) / rise,
        pressure(2, 5) / rise,
        pressure(10, 20) / rise,
        pressure(3, 6) / command(1, 4),
        rise,
    ]
    return np.log(np.stack(shares, axis=-1))


def kinds(p, took):
    """Weights of the kinds of lungs, shape ``(6,)``.

    Args:
        p: parameters.
        took: from :func:`effort`, shape ``(8,)``.
    """
    away = took - p["centre"]
    distance = ((away @ p["precision"]) * away).sum(-1)
    weight = np.exp(-0.5 * (distance - distance.min()))
    return weight / weight.sum()


def features(p, took, rise):
    """What the feed-forward to begin with of each kind is linear in, shape ``(6, 5)``.

    Args:
        p: parameters.
        took: from :func:`effort`, shape ``(8,)``.
        rise: target minus pressure at the start of the breath, cmH2O.
    """
    away = np.clip((took - p["centre"]) / p["deviation"], -2.0, 2.0)[:, :3]
    ones = np.ones((len(away), 1))
    return np.hstack([ones, ones * rise / 20.0, away * rise / 20.0])


def counted(applied, errors):
    """Errors that learning counts: not those that follow a command at an end of the range.

    Args:
        applied: commands, %, shape ``(STEPS,)``.
        errors: target minus reading, cmH2O, shape ``(STEPS,)``.
    """
    free = (applied[:-1] > 0.0) & (applied[:-1] < 100.0)
    return np.append(0.0, errors[1:] * free)


class Controller:
    def reset(self, task):
        with np.load(Path(__file__).parent / "parameters.npz") as file:
            self.p = dict(file)
        self.gains, self.weight, self.lung = self.p["first"], None, task.lung
        self.most = 100.0
        self.forward = np.zeros(STEPS)
        self.readings, self.applied, self.errors = [], [], []

    def act(self, observation):
        if observation.time == 0:  # a new breath
            rise = max(observation.target - observation.pressure, 1.0)
            if len(self.readings) == STEPS:
                self._learn(rise)
            self.rise = rise
            self.readings, self.applied, self.errors = [], [], []
            self.before = self.integral = self.derivative = 0.0
        else:
            self.applied.append(observation.previous_u_in)
        step = min(len(self.readings), STEPS - 1)
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before = error
        self.readings.append(observation.pressure)
        self.errors.append(error)
        p, i, d = self.gains
        u = p * error + i * self.integral + d * self.derivative + self.forward[step]
        self.last = float(min(max(u, 0.0), self.most))
        if error <= -ABOVE:
            self.most, self.last = SHARE * self.most, 0.0
        return self.last

    def _learn(self, rise):
        applied, errors = np.array([*self.applied, self.last]), np.array(self.errors)
        if self.weight is None:
            took = effort(applied, np.array(self.readings), self.rise)
            known = np.array([float(self.lung == name) for name in LUNGS])
            self.weight = known if known.any() else kinds(self.p, took)
            self.gains = np.exp(self.weight @ np.log(self.p["gains"]))
            self.L = np.tensordot(self.weight, self.p["learning"], 1)
            each = features(self.p, took, rise) * self.weight[:, None]
            self.begin = self.forward = np.tensordot(each, self.p["begin"], 2)
            return
        away = self.p["keep"] @ (self.forward - self.begin)
        self.forward = self.begin + away + self.L @ counted(applied, errors)
