"""One PID for all six lungs; it is not told which one it ventilates."""

TIME_CONSTANT = 0.5  # s, of both averages

#: Each reading so far above the target, cmH2O, leaves this share of the largest command until the
#: run ends: the loop swings on rigs that answer later than those it was tuned on.
ABOVE, SHARE = 8.0, 0.7

GAINS = (4.0, 8.0, 9.0)  # P, I, D, %/cmH2O


class Controller:
    def reset(self, task):
        self.most = 100.0

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
        p, i, d = GAINS
        return min(p * error + i * self.integral + d * self.derivative, self.most)
