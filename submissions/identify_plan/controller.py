"""Identify the rig from its breaths, plan the next one, and correct the plan by what is read.

The first breath follows the target by a cautious PI controller, unless the lung is told. At the
start of every later breath

1. the parameters of the rig are estimated from all breaths so far: maximum a posteriori by
   Gauss-Newton, from one start for each lung that it may be, all in one batch;
2. the commands of the breath are planned: least sum of |pressure - target| within the range of the
   valve, by reweighted least squares on the simulated rig.

Within a breath the plan is a linear model in the commands and in the parameters. Each reading
corrects the parameters (a Kalman filter with a drifting pressure beside them), and the rest of the
plan is solved again.
"""

from pathlib import Path

import numpy as np
from rig import NAMES, simulate

RIG = dict(np.load(Path(__file__).parent / "rig.npz"))
SMOOTH = RIG | {"direction": np.zeros(3)}  # play has no derivative
LUNGS = ["R5C10", "R5C20", "R5C50", "R20C10", "R20C20", "R20C50"]  # in the order of RIG
STEPS = 34
START = NAMES.index("start")
GAIN = NAMES.index("gain")

#: Standard deviations of the parameters over rigs and draws, in the order of ``NAMES``.
SPREAD = np.array([0.14, 0.2, 0.12, 0.05, 0.12, 0.06, 0.4, 0.006, 0.3, 0.3])

#: Steps of the finite differences.
SHIFT = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-2, 1e-4, 1e-2, 1e-2])

#: Standard deviation of a reading, with what the rig's model lacks, cmH2O.
NOISE = 0.3

#: What may have changed between two breaths of one rig: standard deviation of the gain's logarithm.
BETWEEN = 0.02

#: Drift of the unexplained pressure from step to step, cmH2O, and at the first step of a breath.
DRIFT, FIRST = 0.05, 0.1

#: Errors below this count as squares, cmH2O; and weight of a change of the commands by 1 %.
SMALL, DAMPING = 0.1, 1e-3

#: Iterations of the estimate and of the plan.
FITS, PLANS = 5, 6

#: Steps for which a start of a plan is fully open, and its command afterwards, %.
OPEN, HOLD = (0, 1, 2, 3, 4, 6, 9, 13, 19, 27), 4.0

#: First trust region of a plan, %.
RADIUS = 30.0

#: PID controller of a first breath on an unknown lung: %, % per cmH2O, steps that it looks ahead,
#: and % per cmH2O and step.
FEED, PROPORTIONAL, AHEAD, INTEGRAL = 3.0, 1.0, 2.0, 0.12


def estimate(lungs, breaths):
    """Parameters of the rig, their covariance, and the lung.

    Args:
        lungs: candidates.
        breaths: (dt, commands, readings) of each breath so far.

    Returns:
        Mean, covariance, index of the lung.
    """
    many, size = len(lungs), len(NAMES)
    mean = RIG["means"][lungs].copy()
    mean[:, START] = np.mean([readings[0] for _, _, readings in breaths])
    theta = mean.copy()
    rows = np.repeat(lungs, size + 1)
    precision = np.diag(SPREAD**-2.0)
    cost = np.full(many, np.inf)
    best, curvature = theta.copy(), np.repeat(precision[None], many, 0)
    damping = np.full(many, 1e-2)
    slope = residual = np.zeros(0)
    for _ in range(FITS):
        shifted = np.repeat(theta[:, None], size + 1, 1)
        shifted[:, np.arange(size) + 1, np.arange(size)] += SHIFT
        parts, slopes = [], []
        for dt, commands, readings in breaths:
            shown, _ = simulate(
                RIG, shifted.reshape(-1, size), dt, np.repeat(commands[None], len(rows), 0), rows
            )
            shown = shown.reshape(many, size + 1, -1)[:, :, : len(readings)]
            parts.append(readings - shown[:, 0])
            slopes.append((shown[:, 1:] - shown[:, :1]) / SHIFT[:, None])
        new_residual, new_slope = np.concatenate(parts, -1), np.concatenate(slopes, -1)
        scaled = new_residual / NOISE
        robust = np.where(np.abs(scaled) < 3.0, 0.5 * scaled**2, 3.0 * np.abs(scaled) - 4.5)
        new_cost = robust.sum(-1) + 0.5 * (((theta - mean) / SPREAD) ** 2).sum(-1)
        better = new_cost < cost
        if slope.size == 0:
            residual, slope = new_residual, new_slope
        cost = np.where(better, new_cost, cost)
        best[better] = theta[better]
        residual = np.where(better[:, None], new_residual, residual)
        slope = np.where(better[:, None, None], new_slope, slope)
        damping = np.where(better, damping * 0.2, damping * 10.0)
        weight = 1.0 / np.maximum(np.abs(residual / NOISE) / 3.0, 1.0) / NOISE**2
        curvature = np.einsum("lit,lt,ljt->lij", slope, weight, slope) + precision
        gradient = np.einsum("lit,lt->li", slope, weight * residual) - (best - mean) / SPREAD**2
        damped = curvature + damping[:, None, None] * np.einsum(
            "lij,ij->lij", curvature, np.eye(size)
        )
        theta = best + np.linalg.solve(damped, gradient[..., None])[..., 0]
    lung = int(np.argmin(cost))
    return best[lung], np.linalg.inv(curvature[lung]), lungs[lung]


def boxed(slope, error, weight, low, high, damping, iterations):
    """Changes x within bounds with least sum of weight (error - slope x)^2 + damping x^2."""
    square = (slope.T * weight) @ slope
    square[np.diag_indices_from(square)] += damping
    right = slope.T @ (weight * error)
    # Accelerated projected gradients with restart (O'Donoghue and Candes, 2015).
    rate = 1.0 / np.abs(square).sum(1).max()
    x = y = np.zeros(len(right))
    momentum = 1.0
    for _ in range(iterations):
        gradient = square @ y - right
        new = np.minimum(np.maximum(y - rate * gradient, low), high)
        change = new - x
        if gradient @ change > 0.0:
            momentum = 1.0
        following = 0.5 + np.sqrt(0.25 + momentum * momentum)
        y = new + (momentum - 1.0) / following * change
        x, momentum = new, following
    return x


def plan(theta, lung, dt, target, commands):
    """Commands with the least error on the identified rig, and the rig about them.

    Returns:
        Commands, %, ``(STEPS - 1,)``; and the slopes of the airway pressures in them,
        ``(STEPS - 1, STEPS - 1)``.
    """
    size = STEPS - 1
    rows = np.full(size + 1, lung)
    thetas = np.repeat(theta[None], size + 1, 0)
    starts = np.where(np.arange(size) < np.array(OPEN)[:, None], 100.0, HOLD)
    starts = np.concatenate([commands[None], starts])
    _, airway = simulate(RIG, thetas[: len(starts)], dt, starts, rows[: len(starts)])
    commands = starts[np.abs(target[1:] - airway[:, 1:]).sum(1).argmin()]
    best, least, radius = commands, np.inf, RADIUS
    error, slope = np.zeros(0), np.zeros((0, 0))
    for _ in range(PLANS):
        away = target[1:] - simulate(RIG, theta[None], dt, commands[None], rows[:1])[1][0, 1:]
        total = np.abs(away).sum()
        if total < least:
            least, best, error = total, commands, away
            shifted = np.repeat(commands[None], size + 1, 0)
            step = np.where(commands > 50.0, -0.5, 0.5)
            shifted[np.arange(size) + 1, np.arange(size)] += step
            _, airway = simulate(SMOOTH, thetas, dt, shifted, rows)
            slope = ((airway[1:, 1:] - airway[0, 1:]) / step[:, None]).T
            radius *= 1.5
        else:
            radius *= 0.3
        weight = 1.0 / np.maximum(np.abs(error), SMALL)
        low, high = np.maximum(-best, -radius), np.minimum(100.0 - best, radius)
        commands = best + boxed(slope, error, weight, low, high, DAMPING, 120)
    return best, slope


class Controller:
    def reset(self, task):
        self.told = LUNGS.index(task.lung) if task.lung in LUNGS else None
        self.lungs = np.arange(len(LUNGS)) if self.told is None else np.array([self.told])
        self.breaths, self.readings, self.applied = [], [], []
        self.commands = np.zeros(0)
        self.slope = np.zeros((0, 0))

    def act(self, observation):
        if observation.time == 0:
            self._begin(observation)
        else:
            self.applied.append(observation.previous_u_in)
            self.readings.append(observation.pressure)
        step = len(self.readings) - 1
        if step >= STEPS - 1:
            return self.applied[-1]
        if self.slope.size == 0:
            error = observation.target - observation.pressure
            self.sum += error
            rise = observation.pressure - self.readings[-2] if step else 0.0
            u = FEED + PROPORTIONAL * (error - AHEAD * rise) + INTEGRAL * self.sum
            return float(min(max(u, 0.0), 100.0))
        return float(min(max(self._correct(step), 0.0), 100.0))

    def _begin(self, observation):
        self._end()
        self.dt, self.sum = observation.dt, 0.0
        self.readings, self.applied = [observation.pressure], []
        self.slope = np.zeros((0, 0))
        if self.breaths:
            theta, covariance, lung = estimate(self.lungs, self.breaths)
            theta = theta.copy()
        elif self.told is not None:
            theta, covariance, lung = RIG["means"][self.told].copy(), np.diag(SPREAD**2), self.told
            theta[START] = observation.pressure
        else:
            return
        covariance = covariance.copy()
        covariance[GAIN, GAIN] += BETWEEN**2
        self.target = np.array([observation.target] * STEPS)
        first = self.commands if self.commands.size else np.full(STEPS - 1, 10.0)
        self.commands, self.slope = plan(theta, lung, self.dt, self.target, first)
        shifted = np.repeat(theta[None], len(NAMES) + 1, 0)
        shifted[np.arange(len(NAMES)) + 1, np.arange(len(NAMES))] += SHIFT
        rows = np.full(len(shifted), lung)
        held = np.repeat(self.commands[None], len(shifted), 0)
        shown, airway = simulate(RIG, shifted, self.dt, held, rows)
        # Deviations of the parameters, and the unexplained pressure behind them.
        self.shown, self.airway = shown[0], airway[0]
        ones = np.ones(STEPS)
        self.shown_by = np.vstack([(shown[1:] - shown[0]) / SHIFT[:, None], ones])
        self.airway_by = np.vstack([(airway[1:] - airway[0]) / SHIFT[:, None], ones])
        size = len(NAMES)
        self.deviation = np.zeros(size + 1)
        self.covariance = np.zeros((size + 1, size + 1))
        self.covariance[:size, :size] = covariance
        self.covariance[size, size] = FIRST**2

    def _end(self):
        readings = np.array(self.readings[:STEPS])
        applied = np.array((self.applied + [0.0] * STEPS)[: STEPS - 1])
        if len(readings) == STEPS:
            self.breaths.append((self.dt, applied, readings))

    def _correct(self, step):
        """Learn from the last reading, and solve the rest of the plan again."""
        apart = np.array(self.applied) - self.commands[:step]
        by_command = self.slope[:, :step] @ apart
        if step > 0:
            covariance = self.covariance
            covariance[-1, -1] += DRIFT**2
            h = self.shown_by[:, step]
            gain = covariance @ h
            variance = h @ gain + NOISE**2
            expected = self.shown[step] + by_command[step - 1] + h @ self.deviation
            surprise = self.readings[-1] - expected
            self.deviation = self.deviation + gain * (surprise / variance)
            self.covariance = covariance - np.outer(gain, gain) / variance
        ahead = self.airway[1:] + by_command + self.deviation @ self.airway_by[:, 1:]
        error = (self.target[1:] - ahead)[step:]
        slope = self.slope[step:, step:]
        now = self.commands[step:]
        x = np.zeros(len(now))
        for _ in range(2):
            left = error - slope @ x
            weight = 1.0 / np.maximum(np.abs(left), SMALL)
            x = boxed(slope, error, weight, -now, 100.0 - now, 1e-3, 60)
        return now[0] + x[0]
