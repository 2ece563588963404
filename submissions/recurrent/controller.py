"""A network that reads whole breaths, plans the next and corrects the plan; see README.md."""

from pathlib import Path

import network
import numpy as np

with np.load(Path(__file__).parent / "weights.npz") as _arrays:
    WEIGHTS = {name: _arrays[name].astype(np.float64) for name in _arrays.files}


class Controller:
    def reset(self, task):
        self.breath = -1
        self.commands = np.zeros((network.BEFORE, network.COMMANDS))
        self.readings = np.zeros((network.BEFORE, network.READINGS))

    def act(self, seen):
        if seen.time == 0:
            self._begin(seen)
        else:
            self._record(seen)
        k = self.step
        self.step += 1
        if self.breath < network.BEFORE and k < network.READINGS:
            self.readings[self.breath, k] = seen.pressure
        if k >= network.COMMANDS:
            return seen.previous_u_in
        plan, expected, gains, context = (self.parts[name] for name in network.OUTPUTS)
        given = (plan[k], plan[min(k + 1, len(plan) - 1)], expected[k], gains[:, k], context)
        asked, self.state = network.feedback(
            np, WEIGHTS, self.state, seen.pressure, seen.target, given, WEIGHTS["steps"][k]
        )
        if seen.pressure > min(network.CAP, seen.target + network.ROOM):
            return 0.0
        return float(min(max(asked, 0.0), 100.0))

    def _begin(self, seen):
        self.breath, self.step = self.breath + 1, 0
        done = np.arange(network.BEFORE) < self.breath
        target = np.asarray(seen.target)
        dt, first = np.asarray(seen.dt), np.asarray(seen.pressure)
        before = (self.commands, self.readings, done.astype(float))
        x = network.features(np, *before, target, dt, first)
        _, self.parts = network.encode(np, WEIGHTS, x, target)
        self.state = network.begin(np, ())

    def _record(self, seen):
        """Remember what was applied in the step before."""
        k = self.step - 1
        if k < network.COMMANDS:
            if self.breath < network.BEFORE:
                self.commands[self.breath, k] = seen.previous_u_in
            plan = self.parts["plan"][k]
            self.state = network.remember(self.state, seen.previous_u_in, plan)
