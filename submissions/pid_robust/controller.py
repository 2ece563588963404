"""One PID for all six lungs; it is not told which one it ventilates."""

TIME_CONSTANT = 0.5  # s, of both averages

GAINS = (4.0, 8.0, 9.0)  # P, I, D, %/cmH2O


class Controller:
    def reset(self, task):
        pass  # nothing to prepare: the state starts at every breath

    def act(self, observation):
        if observation.time == 0:  # a new breath
            self.before = self.integral = self.derivative = 0.0
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before = error
        p, i, d = GAINS
        return p * error + i * self.integral + d * self.derivative
