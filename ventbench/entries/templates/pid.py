"""A PID with one set of gains for all lungs. Change it into whatever you like."""

GAINS = (6.0, 6.0, 0.3)  # P, I, D, %/cmH2O
TIME_CONSTANT = 0.5  # s, of both averages


class Controller:
    """One for each run of three breaths."""

    def reset(self, task):
        """Prepare; task.lung names the lung in the performance track, else it is None."""

    def act(self, observation):
        """Return u_in, %, for the next step."""
        if observation.time == 0:  # a new breath
            self.before = self.integral = self.derivative = 0.0
        error = observation.target - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (error - self.integral)
        self.derivative += a * (error - self.before - self.derivative)
        self.before = error
        p, i, d = GAINS
        return p * error + i * self.integral + d * self.derivative
