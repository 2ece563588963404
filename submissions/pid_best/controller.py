"""The best PID of the paper's grid on each lung, tuned on the rigs."""

TIME_CONSTANT = 0.5  # s, of both averages

#: Each reading so far above the target, cmH2O, leaves this share of the largest command until the
#: run ends: the loop swings on rigs that answer later than those it was tuned on.
ABOVE, SHARE = 8.0, 0.7

# (P, I, D), %/cmH2O
GAINS = {
    "R5C10": (10.0, 0.0, 10.0),
    "R5C20": (10.0, 3.0, 10.0),
    "R5C50": (10.0, 10.0, 10.0),
    "R20C10": (7.0, 0.1, 4.0),
    "R20C20": (4.0, 10.0, 0.1),
    "R20C50": (4.0, 10.0, 0.0),
}


class Controller:
    def reset(self, task):
        self.gains, self.most = GAINS[task.lung], 100.0

    def act(self, observation):
        if observation.time == 0:  # a new breath
            self.before = self.integral = self.derivative = 0.0
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before = error
        if error < -ABOVE:
            self.most *= SHARE
        p, i, d = self.gains
        return min(p * error + i * self.integral + d * self.derivative, self.most)
