"""Identify the rig from its breaths, plan the next one, and correct the plan by what is read.

The first breath follows the target by a cautious PI controller. At the start of every later breath

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

#: Standard deviations of the parameters over rigs and draws, in the order of ``NAMES``: half as
#: much again as on the training rigs, since others differ more.
SPREAD = np.array([0.21, 0.3, 0.18, 0.075, 0.18, 0.09, 0.6, 0.009, 0.45, 0.45])

#: Steps of the finite differences.
SHIFT = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-2, 1e-4, 1e-2, 1e-2])

#: Standard deviation of a reading, with what the rig's model lacks, cmH2O.
NOISE = 0.3

#: Standard deviation of the logarithm of the valve's gain from breath to breath of one rig.
BETWEEN = 0.116

#: Drift of the unexplained pressure from step to step, cmH2O, and at the first step of a breath.
DRIFT, FIRST = 0.05, 0.1

#: Errors below this count as squares, cmH2O; and weight of a change of the commands by 1 %.
SMALL, DAMPING = 0.3, 1e-3

#: Iterations of the estimate and of the plan.
FITS, PLANS = 3, 3

#: Steps for which a start of a plan is fully open, and its command afterwards, %.
OPEN, HOLD = (0, 1, 2, 3, 4, 6, 9, 13, 19, 27), 4.0

#: First trust region of a plan, %.
RADIUS = 30.0

#: PID controller of a first breath on an unknown lung: %, % per cmH2O, steps that it looks ahead,
#: and % per cmH2O and step.
FEED, PROPORTIONAL, AHEAD, INTEGRAL = 3.0, 1.0, 2.0, 0.12

#: Error below which it integrates, cmH2O.
NEAR = 8.0


def estimate(lungs, breaths):
    """Parameters of the rig, their covariance, and the lung.

    Each breath has a gain of its own, around that of the rig.

    Args:
        lungs: candidates.
        breaths: (dt, commands, readings) of each breath so far.

    Returns:
        Mean, covariance, index of the lung.
    """
    many, size, count = len(lungs), len(NAMES), len(breaths)
    mean = np.zeros((many, size + count))
    mean[:, :size] = RIG["means"][lungs]
    mean[:, START] = np.mean([readings[0] for _, _, readings in breaths])
    spread = np.concatenate([SPREAD, np.full(count, BETWEEN)])
    x = mean.copy()
    precision = np.diag(spread**-2.0)
    cost = np.full(many, np.inf)
    best, curvature = x.copy(), np.repeat(precision[None], many, 0)
    damping = np.full(many, 1e-2)
    slope = residual = np.zeros(0)
    dt = np.mean([dt for dt, _, _ in breaths])
    commands = np.tile(np.repeat([u for _, u, _ in breaths], size + 1, 0), (many, 1))
    readings = np.array([y for _, _, y in breaths])
    each = np.arange(count)
    rows = np.repeat(lungs, count * (size + 1))
    for _ in range(FITS):
        theta = np.repeat(x[:, None, :size], count, 1)
        theta[:, :, GAIN] += x[:, size:]
        shifted = np.repeat(theta[:, :, None], size + 1, 2)
        shifted[:, :, np.arange(size) + 1, np.arange(size)] += SHIFT
        shown, _ = simulate(RIG, shifted.reshape(-1, size), dt, commands, rows)
        shown = shown.reshape(many, count, size + 1, -1)
        slopes = np.zeros((many, size + count, count, readings.shape[1]))
        slopes[:, :size] = ((shown[:, :, 1:] - shown[:, :, :1]) / SHIFT[:, None]).swapaxes(1, 2)
        slopes[:, size + each, each] = slopes[:, GAIN, each]
        new_slope = slopes.reshape(many, size + count, -1)
        new_residual = (readings - shown[:, :, 0]).reshape(many, -1)
        scaled = new_residual / NOISE
        robust = np.where(np.abs(scaled) < 3.0, 0.5 * scaled**2, 3.0 * np.abs(scaled) - 4.5)
        new_cost = robust.sum(-1) + 0.5 * (((x - mean) / spread) ** 2).sum(-1)
        better = new_cost < cost
        if slope.size == 0:
            residual, slope = new_residual, new_slope
        cost = np.where(better, new_cost, cost)
        best[better] = x[better]
        residual = np.where(better[:, None], new_residual, residual)
        slope = np.where(better[:, None, None], new_slope, slope)
        damping = np.where(better, damping * 0.2, damping * 10.0)
        weight = 1.0 / np.maximum(np.abs(residual / NOISE) / 3.0, 1.0) / NOISE**2
        curvature = np.einsum("lit,lt,ljt->lij", slope, weight, slope) + precision
        gradient = np.einsum("lit,lt->li", slope, weight * residual) - (best - mean) / spread**2
        damped = curvature + damping[:, None, None] * np.einsum(
            "lij,ij->lij", curvature, np.eye(size + count)
        )
        x = best + np.linalg.solve(damped, gradient[..., None])[..., 0]
    lung = int(np.argmin(cost))
    return best[lung, :size], np.linalg.inv(curvature[lung])[:size, :size], lungs[lung]


def boxed(slope, error, weight, low, high, damping, iterations):
    """Changes x within bounds with least sum of weight (error - slope x)^2 + damping x^2."""
    square = (slope.T * weight) @ slope
    square[np.diag_indices_from(square)] += damping
    right = slope.T @ (weight * error)
    # Accelerated projected gradients with restart (O'Donoghue and Candes, 2015).
    rate = 1.0 / np.abs(square).sum(1).max()
    # A solution without bounds, and one with those fixed that it leaves, are a start.
    x = np.clip(np.linalg.solve(square, right), low, high)
    free = (x > low) & (x < high)
    if not free.all():
        held = right - square[:, ~free] @ x[~free]
        x[free] = np.linalg.solve(square[np.ix_(free, free)], held[free])
        x = np.clip(x, low, high)
    y, momentum = x, 1.0
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
        commands = best + boxed(slope, error, weight, low, high, DAMPING, 30)
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
            rise = observation.pressure - self.readings[-2] if step else 0.0
            error = observation.target - observation.pressure - AHEAD * rise
            if abs(error) < NEAR:  # not while the pressure still has to rise
                self.sum += error
            u = FEED + PROPORTIONAL * error + INTEGRAL * self.sum
            return float(min(max(u, 0.0), 100.0)) if error > 0.0 else 0.0
        return float(min(max(self._correct(step), 0.0), 100.0))

    def _begin(self, observation):
        self._end()
        self.dt, self.sum = observation.dt, 0.0
        self.readings, self.applied = [observation.pressure], []
        self.slope = np.zeros((0, 0))
        if self.breaths:
            theta, covariance, lung = estimate(self.lungs, self.breaths)
            theta = theta.copy()
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
            x = boxed(slope, error, weight, -now, 100.0 - now, 1e-3, 8)
        return now[0] + x[0]
