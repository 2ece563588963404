"""From the logged command to the flow that the inspiratory valve is asked for, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ventbench.validation.challenge.cases import Effect

Floats = NDArray[np.float64]
Effects = Mapping[str, Effect]


class Valve:
    """Rounding, play, dead band and curve, in that order; remembers where it stands.

    Args:
        effects: of the rig, by name.
        gain: mL/s per %.
        breaths: side by side.
    """

    def __init__(self, effects: Effects, gain: float, breaths: int) -> None:
        self._effects = effects
        self._gain = gain
        self._stands = np.zeros(breaths)
        self._curve = _curve(effects.get("valve_curve"))

    def flow(self, command: Floats) -> Floats:
        """Flow that the next command asks for, L/s, ``(n,)``; ``command`` in %."""
        u = command
        if "command_rounding" in self._effects:
            nearest = self._effects["command_rounding"].form == "nearest"
            u = np.floor(u + 0.5) if nearest else np.floor(u)
        if "valve_hysteresis" in self._effects:
            u = self._play(u, self._effects["valve_hysteresis"])
        if "valve_dead_band" in self._effects:
            u = np.maximum(u - self._effects["valve_dead_band"].parameters["width"], 0.0)
        if self._curve is not None:
            at, flows = self._curve
            u = np.interp(u, at, flows)
        return 1e-3 * self._gain * u

    def _play(self, u: Floats, item: Effect) -> Floats:
        half = 0.5 * item.parameters["width"]
        apart = u - self._stands
        if item.form == "soft play":  # it gives a little before it is pushed
            self._stands = self._stands + apart - half * np.tanh(apart / half)
        else:
            pushed = np.abs(apart) - half
            self._stands = self._stands + np.where(pushed > 0, np.sign(apart) * pushed, 0.0)
        return self._stands


def _curve(item: Effect | None) -> tuple[Floats, Floats] | None:
    """Table of the curve: commands and the commands of a linear valve, %.

    ``loss`` is the share of flow that is missing fully open, against the slope at small commands
    (of a power law, which has none, against the line through 10 %).
    """
    if item is None:
        return None
    loss = item.parameters["loss"]
    x = np.linspace(0.0, 1.0, 4001)
    if item.form == "library":
        y = x / (1.0 + x * loss / (1.0 - loss))
    elif item.form == "tanh":
        a = _bend(lambda a: np.tanh(a) / a, 1.0 - loss)
        y = np.tanh(a * x) / a
    elif item.form == "exponential":
        a = _bend(lambda a: -np.expm1(-a) / a, 1.0 - loss)
        y = -np.expm1(-a * x) / a
    elif item.form == "power law":
        power = 1.0 + np.log10(1.0 - loss)
        y = 0.1 * (x / 0.1) ** power
    else:  # convex: as much gained as others lose
        y = x * (1.0 + loss * x)
    return 100.0 * x, 100.0 * y


def _bend(left, share: float) -> float:
    """Where a falling function of a positive number has a value, by bisection."""
    low, high = 1e-6, 50.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if left(middle) > share else (low, middle)
    return low
