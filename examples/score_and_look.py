"""Score a controller of ten lines, and look at what it does."""

from pathlib import Path

import ventbench
from ventbench import pages

OUT = Path("runs/score_and_look")


class PI:
    """Proportional and integral control of the pressure."""

    def reset(self, task):
        """Begin a run of three breaths."""
        self.integral = 0.0

    def act(self, observation):
        """Return u_in, %."""
        if observation.time == 0:  # a new breath
            self.integral = 0.0
        error = observation.target - observation.pressure
        self.integral += observation.dt / (observation.dt + 0.5) * (error - self.integral)
        return 3.0 * error + 6.0 * self.integral


score = ventbench.score(PI)
print(score)  # mean |pressure - target| of each lung, cmH2O; lower is better
print(score.to_frame())  # the same for every lung and PIP

baseline = ventbench.score("pid_robust")
print(f"this controller {score.score:.3f}, pid_robust {baseline.score:.3f} cmH2O")

OUT.mkdir(parents=True, exist_ok=True)
runs = [score.trajectories, baseline.trajectories]
print("wrote", pages.write_report(OUT / "pi.html", runs))
print("wrote", pages.write_rerun(OUT / "pi.rrd", runs))
