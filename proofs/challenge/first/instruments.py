"""The ends of the rig: the inspiratory valve behind its command, the sensor before its log."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import brentq

from hardware_eval.emulation.cases import Case, Effect
from proofs.challenge.questions import coloured_noise, parameter
from ventbench.base.arrays import Floats

EffectsByName = Mapping[str, Effect]

#: Range over which a bent sensor is right at both ends, cmH2O.
_BEND_RANGE = 40.0

#: Points of a valve curve's table; interpolating errs by far less than the sensor resolves.
_CURVE_POINTS = 4001


class Valve:
    """Inspiratory valve: rounding, play, dead band and curve, in that order.

    The valve remembers its position.

    Args:
        effects: effects of the rig, by name.
        gain: mL/s per %.
        breaths: number of breaths that run side by side.
    """

    def __init__(self, effects: EffectsByName, gain: float, breaths: int) -> None:
        self._effects = effects
        self._gain = gain
        self._position = np.zeros(breaths)
        self._curve = _curve(effects.get("valve_curve"))

    def flow(self, command: Floats) -> Floats:
        """Flow at the next command, L/s, ``(n,)``; ``command`` in %."""
        u = command
        if "command_rounding" in self._effects:
            nearest = self._effects["command_rounding"].form == "nearest"
            u = np.floor(u + 0.5) if nearest else np.floor(u)
        if "valve_hysteresis" in self._effects:
            u = self._after_play(u, self._effects["valve_hysteresis"])
        if "valve_dead_band" in self._effects:
            u = np.maximum(u - self._effects["valve_dead_band"].parameters["width"], 0.0)
        if self._curve is not None:
            at, flows = self._curve
            u = np.interp(u, at, flows)
        return 1e-3 * self._gain * u

    def _after_play(self, u: Floats, hysteresis: Effect) -> Floats:
        half = 0.5 * hysteresis.parameters["width"]
        apart = u - self._position
        if hysteresis.form == "soft play":  # yields a little before the play is taken up
            self._position = self._position + apart - half * np.tanh(apart / half)
        else:
            pushed = np.abs(apart) - half
            self._position = self._position + np.where(pushed > 0, np.sign(apart) * pushed, 0.0)
        return self._position


def _curve(curve: Effect | None) -> tuple[Floats, Floats] | None:
    """Table of a valve curve: commands, and commands at which a linear valve flows as much, %.

    ``loss`` is the share of flow that is missing fully open, against the slope at small commands
    (of a power law, which has none, against the line through 10 %).
    """
    if curve is None:
        return None
    loss = curve.parameters["loss"]
    x = np.linspace(0.0, 1.0, _CURVE_POINTS)
    if curve.form == "library":
        y = x / (1.0 + x * loss / (1.0 - loss))
    elif curve.form == "tanh":
        a = argument(lambda a: np.tanh(a) / a, 1.0 - loss)
        y = np.tanh(a * x) / a
    elif curve.form == "exponential":
        a = argument(lambda a: -np.expm1(-a) / a, 1.0 - loss)
        y = -np.expm1(-a * x) / a
    elif curve.form == "power law":
        power = 1.0 + np.log10(1.0 - loss)
        y = 0.1 * (x / 0.1) ** power
    else:  # convex: gains as much flow as the other forms lose
        y = x * (1.0 + loss * x)
    return 100.0 * x, 100.0 * y


def argument(
    function: Callable[[float], float], value: float, low: float = 1e-6, high: float = 50.0
) -> float:
    """Argument between two at which a monotonic function has a value."""
    return float(brentq(lambda x: function(x) - value, low, high, xtol=1e-14))  # type: ignore[arg-type]


class Sensor:
    """Pressure sensor: bend, drift, noise and converter.

    Args:
        case: case with its noise and converter.
        effects: effects of the rig, by name.
        position: position of each breath in its recording, 0 for the first, 1 for the last,
            ``(n,)``.
        rng: source of the noise.
    """

    def __init__(
        self, case: Case, effects: EffectsByName, position: Floats, rng: np.random.Generator
    ) -> None:
        self._step = case.step
        n = len(position)
        self._noise = coloured_noise(case, case.correlation, rng, (n, case.samples))
        self._offset = np.zeros(n)
        if "sensor_drift" in effects:
            drift = effects["sensor_drift"]
            share = position
            if drift.form == "warming":
                share = np.expm1(-3.0 * position) / np.expm1(-3.0)
            self._offset = drift.parameters["drift"] * share
        self._bend = 4.0 * parameter(effects, "sensor_nonlinearity", "bend")

    def read(self, k: int, pressure: Floats) -> Floats:
        """Reading of sample ``k``, cmH2O, ``(n,)``."""
        x = pressure / _BEND_RANGE
        reading = pressure + self._bend * x * (1.0 - x) + self._offset + self._noise[:, k]
        return np.round(reading / self._step) * self._step if self._step else reading
