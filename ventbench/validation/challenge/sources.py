"""What drives the rig beside its valve: muscles, the heart, a supply that pulsates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ventbench.validation.challenge.valve import Effects, Floats

#: Share of the breaths with an effort.
_PRESENT = 0.6


class Sources:
    """Sources in time; each breath has its own effort, the oscillations run on between breaths.

    Args:
        effects: of the rig, by name.
        began: time of each breath's first sample since the recording began, s, ``(n,)``.
        rng: what efforts and phases are drawn from.
    """

    def __init__(self, effects: Effects, began: Floats, rng: np.random.Generator) -> None:
        n = len(began)
        # Drawn whether there are any or not, so that one effect does not change the others.
        present = rng.uniform(size=n) < _PRESENT
        self._onset = rng.uniform(0.0, 1.2, n)
        size = rng.uniform(0.7, 1.3, n)
        phases = rng.uniform(0.0, 2.0 * np.pi, 2)
        self._effort = effects.get("patient_effort")
        if self._effort:
            self._amplitude = self._effort.parameters["amplitude"] * size * present
        self._heart = _oscillation(effects, "cardiogenic", began, phases[0])
        self._pulse = _oscillation(effects, "pulsating_supply", began, phases[1])

    def pull(self, t: Floats) -> Floats | float:
        """Pressure taken away at the alveolus, cmH2O, ``(n,)``."""
        pull: Floats | float = 0.0
        if self._effort:
            x = np.clip((t - self._onset) / self._effort.parameters["duration"], 0.0, 1.0)
            pull = self._amplitude * _shape(x, self._effort.form)
        if self._heart:
            amplitude, rate, phase = self._heart
            pull = pull + amplitude * np.sin(rate * t + phase)
        return pull

    def pulsed(self, flow: Floats, t: Floats) -> Floats:
        """Flow of the valve on the supply as it is, L/s, ``(n,)``."""
        if not self._pulse:
            return flow
        amplitude, rate, phase = self._pulse
        return flow * (1.0 + amplitude * np.sin(rate * t + phase))


def _oscillation(
    effects: Effects, name: str, began: Floats, phase: float
) -> tuple[float, float, NDArray[np.float64]] | None:
    item = effects.get(name)
    if item is None:
        return None
    rate = 2.0 * np.pi * item.parameters["frequency"]
    return item.parameters["amplitude"], rate, rate * began + phase


def _shape(x: Floats, form: str) -> Floats:
    """An effort of height 1 over 0..1."""
    if form == "raised cosine":
        return 0.5 * (1.0 - np.cos(2.0 * np.pi * x))
    if form == "trapezoid":
        return np.minimum(1.0, 4.0 * np.minimum(x, 1.0 - x))
    return np.sin(np.pi * x)
