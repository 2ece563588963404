"""From the pressure in the sensor's chamber to the reading that is logged."""

from __future__ import annotations

import numpy as np

from ventbench.validation.challenge.cases import Case
from ventbench.validation.challenge.valve import Effects, Floats

#: Range over which a bent sensor is right at both ends, cmH2O.
_SCALE = 40.0


class Sensor:
    """Bend, drift, noise and converter.

    Args:
        case: with noise and converter.
        effects: of the rig, by name.
        position: of each breath in its recording, 0 the first, 1 the last, ``(n,)``.
        rng: of the noise.
    """

    def __init__(
        self, case: Case, effects: Effects, position: Floats, rng: np.random.Generator
    ) -> None:
        self._step = case.step
        n = len(position)
        white = rng.standard_normal((n, case.samples))
        slow = rng.standard_normal((n, case.samples))
        fresh = np.sqrt(1.0 - case.correlation**2)
        for k in range(1, case.samples):
            slow[:, k] = case.correlation * slow[:, k - 1] + fresh * slow[:, k]
        mixed = np.sqrt(1.0 - case.coloured) * white + np.sqrt(case.coloured) * slow
        self._noise = case.noise * mixed
        self._offset = np.zeros(n)
        if "sensor_drift" in effects:
            item = effects["sensor_drift"]
            grown = position
            if item.form == "warming":
                grown = np.expm1(-3.0 * position) / np.expm1(-3.0)
            self._offset = item.parameters["drift"] * grown
        item = effects.get("sensor_nonlinearity")
        self._bend = 4.0 * item.parameters["bend"] if item else 0.0

    def read(self, k: int, pressure: Floats) -> Floats:
        """Reading of sample ``k``, cmH2O, ``(n,)``."""
        x = pressure / _SCALE
        seen = pressure + self._bend * x * (1.0 - x) + self._offset + self._noise[:, k]
        return np.round(seen / self._step) * self._step if self._step else seen
