"""Feed-forward from an identified lung, with the integral of what the model does not explain.

The model of a breath, with V the volume that has gone in and q the flow of the valve:

    pressure = offset + elastance V + resistance (q + bend q^2)

A Kalman filter estimates offset, elastance and resistance at every step (recursive least squares
with forgetting), once for each of several dead times; the dead time that predicts best counts
most. The command is the flow for which the model reaches the target when that flow arrives.

Plain floats: for so few numbers they are several times as fast as arrays.
"""

from bisect import bisect
from math import exp, sqrt

#: Flow of the valve, L/s, at commands, %: mean of the training rigs.
COMMANDS = [0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0, 14.0, 19.0, 26.0, 36.0, 50.0, 70.0, 100.0]
FLOWS = [
    *(0.0, 0.024, 0.054, 0.111, 0.16, 0.21, 0.297, 0.379, 0.461, 0.562, 0.671, 0.823, 1.008, 1.466),
]

#: Dead times of the filters, steps, and how many past flows are remembered.
LAGS = (0.4, 1.2, 2.2, 3.2)
DEPTH = 6

#: Bounds of elastance, cmH2O/L, resistance, cmH2O s/L, and offset, cmH2O.
LOW, HIGH = (6.0, 0.5, -20.0), (160.0, 60.0, 40.0)

#: Standard deviations by which a single pressure may at most correct a filter.
LIMIT = 4.0

#: How far the pressure must fall below that at the start of the breath for a tube that is off,
#: cmH2O, and the time in which the lung then empties, s.
OFF, EMPTYING = 2.5, 0.2

#: What was tuned; README.md says how.
TUNED = {
    "bend": 0.3,  # s/L; second coefficient of the resistance over the first
    "share": 1.3,  # of the way to the target in one step
    "early_noise": 1.45,  # of the pressure while the expiratory valve closes, cmH2O
    "open_first": 0.479,  # share of the flow that reaches the lung in the first step
    "open_second": 0.17,  # and in the second
    "noise": 1.56,  # of a measured pressure, with what the model lacks, cmH2O
    "edge_noise": 0.64,  # share of a change of the resistive pressure
    "elastance": 66.5,  # expected before anything is known, cmH2O/L
    "elastance_sd": 36.6,
    "resistance": 8.68,  # cmH2O s/L
    "resistance_sd": 2.69,
    "offset_sd": 3.18,  # at the start of a breath, cmH2O
    "elastance_drift": 1.8,  # standard deviation of a step's change
    "resistance_drift": 0.449,
    "offset_drift": 0.00222,
    "elastance_between": 1.53,  # standard deviation of a change between breaths
    "resistance_between": 0.706,
    "surprise": 4.88,  # squared, in standard deviations, from which the lung may have changed
    "change": 0.0655,  # share of the first uncertainty that then comes back
    "memory": 0.999,  # of a filter's prediction errors, a step
    "sharpness": 0.879,  # by which prediction errors exclude filters
    "lag_prior": 0.158,  # cost of a step of dead time
    "repeat": 0.299,  # share of the last breath's unexplained pressure that is expected again
}


def interpolate(x, xs, ys):
    """Straight lines between rising points, constant outside."""
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    k = bisect(xs, x)
    return ys[k - 1] + (ys[k] - ys[k - 1]) * (x - xs[k - 1]) / (xs[k] - xs[k - 1])


def within(value, k):
    return min(max(value, LOW[k]), HIGH[k])


class Filter:
    """Identified lung for one dead time."""

    def __init__(self, lag, tuned):
        t = self.tuned = tuned
        self.whole = int(lag)
        self.part = lag - self.whole
        # Volume that commands already given will bring until a new one arrives, by their age.
        self.coming = [0.0] * DEPTH
        for age in range(self.whole):
            self.coming[age] += 1.0 - self.part
            self.coming[age + 1] += self.part
        self.coming[0] += self.part
        self.a, self.b = t["elastance"], t["resistance"]
        self.prior = (t["elastance_sd"] ** 2, t["resistance_sd"] ** 2, t["offset_sd"] ** 2)
        self.P = [self.prior[0], 0.0, 0.0, self.prior[1], 0.0, 0.0]  # upper triangle, by rows
        self.lag_cost = t["lag_prior"] * lag
        self.cost = self.lag_cost
        self.seen, self.before = [], []

    def begin(self, pressure, flow):
        """Start a breath at rest at a measured pressure."""
        t, P = self.tuned, self.P
        if self.seen:  # what this breath did not explain, by what is known at its end
            self.before = [
                p - self.a * volume - self.b * drop - self.c if volume > 0.0 else 0.0
                for p, volume, drop in self.seen
            ]
        self.seen = []
        self.c = self.start = pressure
        self.volume, self.step = 0.0, 0
        self.drop = flow + t["bend"] * flow * flow
        elastance = P[0] + t["elastance_between"] ** 2
        self.P = [elastance, P[1], 0.0, P[3] + t["resistance_between"] ** 2, 0.0, self.prior[2]]

    def expected(self, step):
        """Pressure that the model did not explain at this step of the last breath, cmH2O."""
        known = 1 <= step <= len(self.before)
        return self.tuned["repeat"] * self.before[step - 1] if known else 0.0

    def observe(self, dt, pressure, flows):
        """Learn from the pressure that the last flow has led to."""
        t, w = self.tuned, self.part
        self.step += 1
        if pressure < self.start - OFF:  # the tube is off: nothing to learn, and the lung empties
            self.volume *= exp(-dt / EMPTYING)
            self.seen.append((pressure, 0.0, 0.0))
            return
        new, old = flows[self.whole], flows[self.whole + 1]
        early = self.step <= 2
        share = (t["open_first"], t["open_second"])[self.step - 1] if early else 1.0
        self.volume += share * dt * ((1.0 - w) * new + w * old)
        flow = (1.0 - w * w) * new + w * w * old
        drop = share * (flow + t["bend"] * flow * flow)
        x, y = self.volume, drop  # the third regressor is 1
        self.seen.append((pressure, x, y))
        error = pressure - self.a * x - self.b * y - self.c - self.expected(self.step)
        edge = t["edge_noise"] * self.b * (drop - self.drop)
        self.drop = drop
        noise = t["early_noise" if early else "noise"] ** 2 + edge * edge

        P00, P01, P02, P11, P12, P22 = self.P
        P00 += t["elastance_drift"] ** 2
        P11 += t["resistance_drift"] ** 2
        P22 += t["offset_drift"] ** 2
        g0 = P00 * x + P01 * y + P02
        g1 = P01 * x + P11 * y + P12
        g2 = P02 * x + P12 * y + P22
        s = x * g0 + y * g1 + g2 + noise
        # Far off what was expected: the lung has changed, and what is known of it counts less.
        lost = t["change"] * min(max(error * error / s - t["surprise"], 0.0), 10.0)
        if lost > 0.0:
            l0, l1, l2 = (lost * variance for variance in self.prior)
            P00, P11, P22 = P00 + l0, P11 + l1, P22 + l2
            g0, g1, g2 = g0 + l0 * x, g1 + l1 * y, g2 + l2
            s += l0 * x * x + l1 * y * y + l2
        limit = LIMIT * sqrt(s)
        step = min(max(error, -limit), limit) / s
        self.a = within(self.a + g0 * step, 0)
        self.b = within(self.b + g1 * step, 1)
        self.c = within(self.c + g2 * step, 2)
        self.P = [
            *(P00 - g0 * g0 / s, P01 - g0 * g1 / s, P02 - g0 * g2 / s),
            *(P11 - g1 * g1 / s, P12 - g1 * g2 / s, P22 - g2 * g2 / s),
        ]
        self.cost = t["memory"] * self.cost + error * error / s

    def flow(self, dt, target, flows):
        """Flow that brings the pressure towards the target when it arrives, L/s."""
        t, a, b = self.tuned, self.a, self.b
        now, bend = flows[0], t["bend"]
        coming = sum(share * flow for share, flow in zip(self.coming, flows, strict=True))
        rest = self.c + a * (self.volume + dt * coming) + self.expected(self.step + 1)
        linear = b + a * dt * (1.0 - self.part)
        held = b * bend * now * now + linear * now
        aim = held + t["share"] * (target - rest - held)
        # b bend q^2 + linear q = aim
        root = sqrt(max(linear * linear + 4.0 * b * bend * aim, 0.0))
        return min(max((root - linear) / (2.0 * b * bend), 0.0), FLOWS[-1])


class Controller:
    def reset(self, task):
        self.filters = [Filter(lag, TUNED) for lag in LAGS]

    def act(self, observation):
        flow = interpolate(observation.previous_u_in, COMMANDS, FLOWS)
        if observation.time == 0:
            self.flows = [flow] * DEPTH  # the latest first
            for one in self.filters:
                one.begin(observation.pressure, flow)
        else:
            self.flows = [flow, *self.flows[:-1]]
            for one in self.filters:
                one.observe(observation.dt, observation.pressure, self.flows)
        costs = [one.cost + one.lag_cost for one in self.filters]
        least, sharpness = min(costs), TUNED["sharpness"]
        weights = [exp(-0.5 * sharpness * (cost - least)) for cost in costs]
        flows = [one.flow(observation.dt, observation.target, self.flows) for one in self.filters]
        mean = sum(w * q for w, q in zip(weights, flows, strict=True)) / sum(weights)
        return interpolate(mean, FLOWS, COMMANDS)
