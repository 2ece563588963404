"""Pressures of airway and lung, as functions with their slopes; L, L/s, cmH2O."""

from __future__ import annotations

import numpy as np

from ventbench.validation.challenge.cases import Base
from ventbench.validation.challenge.valve import Effects, Floats

#: Flow at which both forms of turbulence cost the same, L/s.
_MEETING = 0.7

#: Pressure of the lower bend of the sigmoid lung, cmH2O.
_LOWER = 5.0


class Recoil:
    """Elastic pressure of a volume."""

    def __init__(self, effects: Effects, base: Base) -> None:
        self.C = 1e-3 * base.C
        item = effects.get("nonlinear_compliance")
        self._form = item.form if item else "linear"
        self._k = item.parameters["stiffening"] if item else 0.0
        if self._form == "sigmoid":
            self._width = _width(1.0 / self._k)
            self._share = 1.0 / (1.0 + np.exp(_LOWER / self._width))

    def __call__(self, volume: Floats) -> tuple[Floats, Floats]:
        """Pressure and its slope by volume, ``(n,)`` each."""
        x = volume / self.C
        if self._form == "linear":
            return x, np.full_like(x, 1.0 / self.C)
        if self._form == "library":
            left = np.maximum(1.0 - self._k * x, 0.05)
            over = np.maximum(self._k * x - 0.95, 0.0) / 0.05  # its tangent from there on
            return (over - np.log(left)) / self._k, 1.0 / left / self.C
        if self._form == "quadratic":
            bend = 0.773 * self._k  # the same pressure at half the capacity
            return x * (1.0 + bend * x), (1.0 + 2.0 * bend * x) / self.C
        d = self._width
        y = np.clip(x / (4.0 * d) + self._share, 1e-3, 0.995)
        slope = 0.25 / (y * (1.0 - y))
        beyond = x - 4.0 * d * (y - self._share)
        return _LOWER + d * np.log(y / (1.0 - y)) + slope * beyond, slope / self.C

    def volume(self, pressure: Floats) -> Floats:
        """Volume at rest, L, by Newton's method."""
        volume = self.C * pressure
        for _ in range(50):
            p, slope = self(volume)
            volume = volume - (p - pressure) / slope
        return volume


def _width(capacity: float) -> float:
    """Width of the sigmoid whose span above zero pressure is the capacity, both cmH2O."""
    low, high = 1.0, 100.0
    for _ in range(80):
        d = 0.5 * (low + high)
        span = 4.0 * d * (1.0 - 1.0 / (1.0 + np.exp(_LOWER / d)))
        low, high = (d, high) if span < capacity else (low, d)
    return low


class Airway:
    """Pressure that a flow costs between the sensor and the alveolus."""

    def __init__(self, effects: Effects, base: Base) -> None:
        self._R = base.R
        turbulent = effects.get("turbulent_resistance")
        self._K = turbulent.parameters["quadratic"] if turbulent else 0.0
        self._power = 1.0
        if turbulent and turbulent.form == "exponent 1.75":
            self._power = 0.75
            self._K *= _MEETING**0.25
        item = effects.get("direction_resistance")
        self._out = item.parameters["ratio"] if item else 1.0
        item = effects.get("volume_resistance")
        self._change = item.parameters["change"] if item else 0.0
        self._rest, self._span = 1e-3 * base.C * base.peep, 1e-3 * base.C * 20.0

    def resistance(self, volume: Floats) -> Floats | float:
        """Resistance at a volume, cmH2O s/L."""
        if not self._change:
            return self._R
        filled = np.clip((volume - self._rest) / self._span, -0.2, 1.2)
        return self._R * (1.0 + self._change * filled)

    def __call__(self, flow: Floats, R: Floats | float) -> tuple[Floats, Floats]:
        """Pressure and its slope by flow, ``(n,)`` each."""
        slope = R * np.where(flow < 0.0, self._out, 1.0) if self._out != 1.0 else R + 0.0 * flow
        drop = slope * flow
        if self._K:
            size = np.abs(flow) ** self._power
            drop = drop + self._K * flow * size
            slope = slope + self._K * (1.0 + self._power) * size
        return drop, slope


class Outlets:
    """Flows that leave the airway beside the lung: a leak, and the expiratory valve when open."""

    def __init__(self, effects: Effects, base: Base) -> None:
        self._peep, self._R_ex = base.peep, base.R_ex
        self._orifice = "expiratory_valve_orifice" in effects
        item = effects.get("leak")
        self._form = item.form if item else None
        self._g = 1e-3 * item.parameters["conductance"] if item else 0.0

    def __call__(self, p: Floats, opened: Floats) -> tuple[Floats, Floats]:
        """Flow, L/s, and its slope by the airway's pressure, ``(n,)`` each."""
        over = np.maximum(p - self._peep, 0.0)
        if self._orifice:  # as the straight valve at 15 cmH2O
            part = over / np.sqrt(over + 0.1)
            scale = opened * np.sqrt(15.0) / self._R_ex
            flow = scale * part
            slope = scale * (0.5 * over + 0.1) / (over + 0.1) ** 1.5 * (over > 0)
        else:
            flow = opened * over / self._R_ex
            slope = opened * (over > 0) / self._R_ex
        if self._g:
            lost, steeper = self._leak(p)
            return flow + lost, slope + steeper
        return flow, slope

    def _leak(self, p: Floats) -> tuple[Floats, Floats]:
        """All forms lose the same at 15 cmH2O."""
        if self._form == "linear":
            scale = self._g / np.sqrt(15.0)
            return scale * p, np.full_like(p, scale)
        power = 0.65 if self._form == "exponent 0.65" else 0.5
        scale = self._g * 15.0 ** (0.5 - power)
        size = np.abs(p) + 0.05
        flow = scale * p * size ** (power - 1.0)
        return flow, scale * size ** (power - 2.0) * (size + (power - 1.0) * np.abs(p))
