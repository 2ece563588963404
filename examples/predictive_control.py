"""Model-predictive control in numpy: a linear model of the lung, and a plan by it at every step.

The model says the next pressure from the last pressures and commands. It starts as what fits the
six lungs together; recursive least squares makes it that of the lung at hand.
"""

from pathlib import Path

import numpy as np

import ventbench
from ventbench.base.files import write_json
from ventbench.task.lungs import LUNG_IDS

HORIZON, MEMORY = 8, 3  # steps that are planned; pressures and commands that the model sees
NOISE, CHANGE = 0.3, 0.01  # of a prediction, cmH2O; weight of a change of the command by 1 %


def learn():
    """Mean and covariance over the lungs of the model that fits each."""
    rng, models = np.random.default_rng(0), []
    for lung in LUNG_IDS:
        u_in = np.repeat(rng.uniform(0.0, 30.0, 30), 6)
        p = ventbench.simulate(u_in, lung=lung).pressure
        x = [[*p[k : k + MEMORY], *u_in[k : k + MEMORY], 10.0] for k in range(len(p) - MEMORY)]
        models.append(np.linalg.lstsq(np.array(x), p[MEMORY:], rcond=1e-4)[0])
    return np.mean(models, axis=0), np.cov(np.transpose(models)) + 1e-5 * np.eye(2 * MEMORY + 1)


MEAN, SPREAD = learn()


class Predictive:
    def reset(self, task):
        self.model, self.spread = MEAN, SPREAD

    def act(self, observation):
        if observation.time == 0:  # a new breath, from rest
            self.p = [observation.pressure] * MEMORY
            self.u = [observation.previous_u_in] * (MEMORY - 1)
        else:
            x = np.array([*self.p, *self.u, 10.0])
            gain = self.spread @ x / (NOISE**2 + x @ self.spread @ x)
            self.model = self.model + gain * (observation.pressure - x @ self.model)
            self.spread = self.spread - np.outer(gain, x @ self.spread)
            self.p, self.u = [*self.p[1:], observation.pressure], self.u[1:]
        u_in = self.plan([observation.target, *observation.targets_ahead][1 : HORIZON + 1])
        self.u = [*self.u, u_in]
        return u_in

    def predict(self, commands):
        """Pressures that follow commands, (HORIZON,) each."""
        p, u = list(self.p), [*self.u, *commands]
        for k in range(HORIZON):
            p.append(self.model @ [*p[-MEMORY:], *u[k : k + MEMORY], 10.0])
        return np.array(p[MEMORY:])

    def plan(self, targets):
        """The first of the commands that bring the pressure to its targets with little change."""
        free = self.predict(np.zeros(HORIZON))
        effect = np.stack([self.predict(row) - free for row in np.eye(HORIZON)], axis=1)
        steps = np.eye(HORIZON) - np.eye(HORIZON, k=-1)
        start = np.eye(HORIZON)[0] * self.u[-1]
        left = np.concatenate([effect, CHANGE**0.5 * steps])
        right = np.concatenate([targets - free, CHANGE**0.5 * start])
        return float(np.clip(np.linalg.lstsq(left, right)[0][0], 0.0, 100.0))


if __name__ == "__main__":
    mine, pid = ventbench.score(Predictive), ventbench.score("pid_robust")
    print(mine)
    print(f"predictive {mine.score:.3f}, PID {pid.score:.3f} cmH2O")
    write_json(Path("runs/predictive_control/score.json"), mine.to_json())
