"""A PID whose gains follow from the lung that it has identified; it is told nothing of the lung.

After each breath the equation of motion is fitted to all breaths so far (least squares with a
prior),

    pressure = start + elastance V + resistance q + offset,

with q the flow of the valve by the mean curve of the training rigs and V its volume. The distances
of (log elastance, log resistance) from those of the six lungs give weights, and the weights a
mean of the six lungs' gains. A first breath, which is not scored, has the gains that are
best for all lungs together.
"""

from pathlib import Path

import numpy as np

STEPS, TIME_CONSTANT = 34, 0.5  # of an inspiration; s, of both averages

#: Each reading so far above the target, cmH2O, leaves this share of the largest command until the
#: run ends: the loop swings on rigs that answer later than those it was tuned on.
ABOVE, SHARE = 8.0, 0.7

#: Flow of the valve, L/s, at commands, %: mean of the training rigs.
COMMANDS = [0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0, 14.0, 19.0, 26.0, 36.0, 50.0, 70.0, 100.0]
FLOWS = [
    *(0.0, 0.024, 0.054, 0.111, 0.16, 0.21, 0.297, 0.379, 0.461, 0.562, 0.671, 0.823, 1.008, 1.466),
]

#: Dead time, steps, and steps in which the expiratory valve closes and most of the flow is lost.
DELAY, EARLY = 0.5, 3

#: What is expected of elastance, cmH2O/L, resistance, cmH2O s/L, and offset, cmH2O, before a
#: breath; its standard deviations; and that of a reading with what the model lacks, cmH2O.
EXPECTED, SPREAD, NOISE = np.array([50.0, 12.0, 0.0]), np.array([40.0, 10.0, 1.0]), 1.0

#: Least elastance and resistance.
LEAST = np.array([5.0, 1.0])


def estimate(dt, commands, readings):
    """Logarithms of elastance and resistance.

    Args:
        dt: control step of each breath, s, shape ``(..., B)``.
        commands: that were held after each reading, %, shape ``(..., B, STEPS)``.
        readings: cmH2O, shape ``(..., B, STEPS)``.
    """
    flow = np.interp(commands, COMMANDS, FLOWS)
    before = [np.concatenate([0.0 * flow[..., :k], flow[..., :-k]], axis=-1) for k in (1, 2)]
    flow = (1.0 - DELAY) * before[0] + DELAY * before[1]
    volume = np.cumsum(flow, axis=-1) * np.asarray(dt)[..., None]
    rows = np.stack([volume, flow, np.ones_like(flow)], axis=-1)[..., EARLY:, :]
    rise = (readings - readings[..., :1])[..., EARLY:]
    rows = rows.reshape(*rows.shape[:-3], -1, 3) / NOISE
    rise = rise.reshape(*rise.shape[:-2], -1) / NOISE
    precision = np.diag(SPREAD**-2.0)
    normal = np.swapaxes(rows, -1, -2) @ rows + precision
    right = np.einsum("...ni,...n->...i", rows, rise) + precision @ EXPECTED
    found = np.linalg.solve(normal, right[..., None])[..., :2, 0]
    return np.log(np.maximum(found, LEAST))


def scheduled(lungs, found):
    """Gains for an estimate, % per cmH2O.

    Args:
        lungs: the six lungs' ``gains``, ``centre`` of their estimates, and the ``precision`` that
            the estimates of one lung have.
        found: from :func:`estimate`, shape ``(2,)``.
    """
    away = found - lungs["centre"]
    distance = np.einsum("li,ij,lj->l", away, lungs["precision"], away)
    weight = np.exp(-0.5 * (distance - distance.min()))
    return weight @ lungs["gains"] / weight.sum()


class Controller:
    def reset(self, task):
        with np.load(Path(__file__).parent / "lungs.npz") as file:
            self.lungs = dict(file)
        self.gains, self.most = self.lungs["single"], 100.0
        self.breaths, self.readings = [], []

    def act(self, observation):
        if observation.time == 0:  # a new breath
            self._begin()
        else:
            self.applied.append(observation.previous_u_in)
        self.readings.append(observation.pressure)
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before, self.dt = error, observation.dt
        if error < -ABOVE:
            self.most *= SHARE
        p, i, d = self.gains
        return float(min(p * error + i * self.integral + d * self.derivative, self.most))

    def _begin(self):
        if len(self.readings) == STEPS:
            self.breaths.append((self.dt, [*self.applied, 0.0], self.readings))
            dt, applied, readings = (np.array(x) for x in zip(*self.breaths, strict=True))
            self.gains = scheduled(self.lungs, estimate(dt, applied, readings))
        self.before = self.integral = self.derivative = 0.0
        self.readings, self.applied = [], []
