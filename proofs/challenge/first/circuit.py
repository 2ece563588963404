"""The rig's pneumatic circuit: lung, airway, outlets, disturbances, and one step of time.

A step solves implicit Euler by Newton's method. Two half steps and one whole step are combined
(Richardson extrapolation), which makes the method second order; it stays stable where pressure
jumps, because gas has mass or because the circuit stores none.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hardware_eval.emulation.cases import Base
from proofs.challenge.first.instruments import EffectsByName, argument
from proofs.challenge.questions import parameter
from ventbench.base.arrays import Floats

#: Flow at which both forms of turbulence cost the same pressure, L/s.
_EQUAL_TURBULENCE = 0.7

#: Pressure of the lower bend of the sigmoid lung, cmH2O.
_LOWER_BEND = 5.0

#: Share of the breaths with a patient's effort.
_EFFORT_SHARE = 0.6

#: Rows of the state, ``(9, n)``: L, L/s, cmH2O.
VOLUME, SECOND, FLOW, PRESSURE, STRESS, VALVE, VALVE_2, SUPPLY, READING = range(9)

#: Newton's method ends below this change of flow, L/s, or after so many iterations.
_TOLERANCE = 1e-9
_NEWTON_STEPS = 60

#: Iterations after which Newton's steps are halved, so that they cannot go round in circles.
_FULL_STEPS = 20


class Disturbances:
    """Respiratory muscles, heart and pulsating supply.

    Each breath has its own effort; the oscillations continue between breaths.

    Args:
        effects: effects of the rig, by name.
        began: time of each breath's first sample since the recording began, s, ``(n,)``.
        rng: source of efforts and phases.
    """

    def __init__(self, effects: EffectsByName, began: Floats, rng: np.random.Generator) -> None:
        # The same breath has the same random numbers, however often it is asked for.
        alike, which = np.unique(began, return_inverse=True)
        n = len(alike)
        # Drawn in any case, so that one effect does not change the random numbers of the others.
        present = (rng.uniform(size=n) < _EFFORT_SHARE)[which]
        self._onset = rng.uniform(0.0, 1.2, n)[which]
        size = rng.uniform(0.7, 1.3, n)[which]
        phases = rng.uniform(0.0, 2.0 * np.pi, 2)
        self._effort = effects.get("patient_effort")
        if self._effort:
            self._amplitude = self._effort.parameters["amplitude"] * size * present
        self._heart = _oscillation(effects, "cardiogenic", began, phases[0])
        self._pulse = _oscillation(effects, "pulsating_supply", began, phases[1])

    def pull(self, t: Floats) -> Floats | float:
        """Pressure that muscles and heart subtract at the alveolus, cmH2O, ``(n,)``."""
        pull: Floats | float = 0.0
        if self._effort:
            x = np.clip((t - self._onset) / self._effort.parameters["duration"], 0.0, 1.0)
            pull = self._amplitude * _effort_shape(x, self._effort.form)
        if self._heart:
            pull = pull + self._heart(t)
        return pull

    def pulsed(self, flow: Floats, t: Floats) -> Floats:
        """Flow of the valve with the supply's pulsation, L/s, ``(n,)``."""
        return flow * (1.0 + self._pulse(t)) if self._pulse else flow


def _oscillation(
    effects: EffectsByName, name: str, began: Floats, phase: float
) -> Callable[[Floats], Floats] | None:
    """A sine of the time in each breath, s, that goes on between breaths; None without it."""
    if name not in effects:
        return None
    given = effects[name].parameters
    rate = 2.0 * np.pi * given["frequency"]
    phases = rate * began + phase
    return lambda t: given["amplitude"] * np.sin(rate * t + phases)


def _effort_shape(x: Floats, form: str) -> Floats:
    """Effort of amplitude 1 over the relative time 0..1."""
    if form == "raised cosine":
        return 0.5 * (1.0 - np.cos(2.0 * np.pi * x))
    if form == "trapezoid":
        return np.minimum(1.0, 4.0 * np.minimum(x, 1.0 - x))
    return np.sin(np.pi * x)


class Recoil:
    """Elastic recoil pressure of the lung as a function of its volume."""

    def __init__(self, effects: EffectsByName, base: Base) -> None:
        self.C = 1e-3 * base.C
        stiffening = effects.get("nonlinear_compliance")
        self._form = stiffening.form if stiffening else "linear"
        self._k = parameter(effects, "nonlinear_compliance", "stiffening")
        if self._form == "sigmoid":
            self._width = _sigmoid_width(1.0 / self._k)
            self._share = 1.0 / (1.0 + np.exp(_LOWER_BEND / self._width))

    def __call__(self, volume: Floats) -> tuple[Floats, Floats]:
        """Pressure, cmH2O, and its slope by volume, cmH2O/L, ``(n,)`` each."""
        x = volume / self.C
        if self._form == "linear":
            return x, np.full_like(x, 1.0 / self.C)
        if self._form == "library":
            left = np.maximum(1.0 - self._k * x, 0.05)
            over = np.maximum(self._k * x - 0.95, 0.0) / 0.05  # continued by its tangent
            return (over - np.log(left)) / self._k, 1.0 / left / self.C
        if self._form == "quadratic":
            bend = 0.773 * self._k  # the same pressure at half the capacity
            return x * (1.0 + bend * x), (1.0 + 2.0 * bend * x) / self.C
        d = self._width
        y = np.clip(x / (4.0 * d) + self._share, 1e-3, 0.995)
        slope = 0.25 / (y * (1.0 - y))
        beyond = x - 4.0 * d * (y - self._share)
        return _LOWER_BEND + d * np.log(y / (1.0 - y)) + slope * beyond, slope / self.C

    def volume(self, pressure: Floats) -> Floats:
        """Volume at rest, L, by Newton's method."""
        volume = self.C * pressure
        for _ in range(50):
            p, slope = self(volume)
            volume = volume - (p - pressure) / slope
        return volume


def _sigmoid_width(capacity: float) -> float:
    """Width of the sigmoid whose span above zero pressure is ``capacity``, both cmH2O."""

    def missing(d: float) -> float:
        return -4.0 * d * (1.0 - 1.0 / (1.0 + np.exp(_LOWER_BEND / d)))

    return argument(missing, -capacity, 1.0, 100.0)


class Airway:
    """Pressure drop of a flow between the sensor and the alveolus."""

    def __init__(self, effects: EffectsByName, base: Base) -> None:
        self._R = base.R
        turbulent = effects.get("turbulent_resistance")
        self._K = parameter(effects, "turbulent_resistance", "quadratic")
        self._power = 1.0
        if turbulent and turbulent.form == "exponent 1.75":
            self._power = 0.75
            self._K *= _EQUAL_TURBULENCE**0.25
        self._out = parameter(effects, "direction_resistance", "ratio", 1.0)
        self._change = parameter(effects, "volume_resistance", "change")
        self._rest, self._span = 1e-3 * base.C * base.peep, 1e-3 * base.C * 20.0

    def resistance(self, volume: Floats) -> Floats | float:
        """Resistance at a volume, cmH2O/(L/s)."""
        if not self._change:
            return self._R
        filled = np.clip((volume - self._rest) / self._span, -0.2, 1.2)
        return self._R * (1.0 + self._change * filled)

    def __call__(self, flow: Floats, R: Floats | float) -> tuple[Floats, Floats]:
        """Pressure drop, cmH2O, and its slope by flow, cmH2O/(L/s), ``(n,)`` each."""
        slope = R * np.where(flow < 0.0, self._out, 1.0) if self._out != 1.0 else R + 0.0 * flow
        drop = slope * flow
        if self._K:
            size = np.abs(flow) ** self._power
            drop = drop + self._K * flow * size
            slope = slope + self._K * (1.0 + self._power) * size
        return drop, slope


class Outlets:
    """Flows out of the circuit: a leak, and the expiratory valve when open."""

    def __init__(self, effects: EffectsByName, base: Base) -> None:
        self._peep, self._R_ex = base.peep, base.R_ex
        self._orifice = "expiratory_valve_orifice" in effects
        leak = effects.get("leak")
        self._form = leak.form if leak else None
        self._g = 1e-3 * parameter(effects, "leak", "conductance")

    def __call__(self, p: Floats, opened: Floats) -> tuple[Floats, Floats]:
        """Flow, L/s, and its slope by airway pressure, ``(n,)`` each."""
        over = np.maximum(p - self._peep, 0.0)
        if self._orifice:  # flows as much as the linear valve at 15 cmH2O
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
        """Flow of the leak and its slope; all forms lose the same at 15 cmH2O."""
        if self._form == "linear":
            scale = self._g / np.sqrt(15.0)
            return scale * p, np.full_like(p, scale)
        power = 0.65 if self._form == "exponent 0.65" else 0.5
        scale = self._g * 15.0 ** (0.5 - power)
        size = np.abs(p) + 0.05
        flow = scale * p * size ** (power - 1.0)
        return flow, scale * size ** (power - 2.0) * (size + (power - 1.0) * np.abs(p))


class Circuit:
    """Everything between the flow that the valve is set to and the pressure that the sensor reads.

    Args:
        effects: effects of the rig, by name.
        base: values of the rig.
        disturbances: what drives the circuit beside the valve.
    """

    def __init__(self, effects: EffectsByName, base: Base, disturbances: Disturbances) -> None:
        self._disturbances = disturbances
        self._recoil = Recoil(effects, base)
        self._airway = Airway(effects, base)
        self._outlets = Outlets(effects, base)
        self._tau = parameter(effects, "valve_lag", "tau")
        self._double = "valve_lag" in effects and effects["valve_lag"].form == "two lags"
        self._drop = parameter(effects, "supply_droop", "drop")
        self._recovery = parameter(effects, "supply_droop", "recovery")
        droop = effects.get("supply_droop")
        self._subtract = droop is not None and droop.form == "subtractive"
        self._tubing = 1e-3 * parameter(effects, "circuit_compliance", "compliance")
        self._mass = parameter(effects, "inertance", "inertance")
        self._stress = parameter(effects, "viscoelasticity", "ratio") / self._recoil.C
        self._relax = parameter(effects, "viscoelasticity", "time")
        self._slow = parameter(effects, "sensor_lag", "tau")
        self._second: tuple[float, float] | None = None
        if "second_compartment" in effects:
            C2 = parameter(effects, "second_compartment", "share") * self._recoil.C
            self._recoil.C -= C2
            self._second = (C2, parameter(effects, "second_compartment", "time") / C2)

    def start(self, pressure: Floats) -> Floats:
        """State at rest at an airway pressure, cmH2O, ``(9, n)``."""
        state = np.zeros((9, len(pressure)))
        state[VOLUME] = self._recoil.volume(pressure)
        if self._second:
            state[SECOND] = self._second[0] * pressure
        state[PRESSURE] = state[READING] = pressure
        return state

    def step(self, state: Floats, h: Floats, asked: Floats, opened: Floats, t: Floats) -> Floats:
        """State after a step.

        Args:
            state: state before the step, ``(9, n)``.
            h: length of the step, s, ``(n,)``.
            asked: flow that the valve is set to during the step, L/s, ``(n,)``.
            opened: 1 if the expiratory valve is open during the step, ``(n,)``.
            t: start of the step, s from the breath's first sample, ``(n,)``.
        """
        half = 0.5 * h
        middle = self._euler(state, half, asked, opened, t + half)
        fine = self._euler(middle, half, asked, opened, t + h)
        return 2.0 * fine - self._euler(state, h, asked, opened, t + h)

    def _euler(self, x: Floats, h: Floats, asked: Floats, opened: Floats, t: Floats) -> Floats:
        after = x.copy()
        q = self._supplied(x, after, h, asked, t)
        inside = -self._disturbances.pull(t)
        slope = 0.0
        if self._relax:
            left = 1.0 / (1.0 + h / self._relax)
            inside = inside + x[STRESS] * left
            slope = h * self._stress * left
        R = self._airway.resistance(x[VOLUME])
        flow, p, steep, change = x[FLOW], x[PRESSURE], x[FLOW], x[FLOW]
        for count in range(_NEWTON_STEPS):
            p, steep = self._pressure(x, flow, h, R)
            p, steep = p + inside + slope * flow, steep + slope
            lost, open_slope = self._outlets(p, opened)
            stored = self._tubing / h
            excess = q - flow - lost - stored * (p - x[PRESSURE])
            change = excess / (1.0 + (open_slope + stored) * steep)
            flow = flow + (change if count < _FULL_STEPS else 0.5 * change)
            if np.abs(change).max() < _TOLERANCE:
                break
        self._store(x, after, h, flow, R, slope)
        after[PRESSURE] = p + steep * change
        if self._slow:
            after[READING] = (self._slow * x[READING] + h * after[PRESSURE]) / (self._slow + h)
        else:
            after[READING] = after[PRESSURE]
        return after

    def _pressure(
        self, x: Floats, flow: Floats, h: Floats, R: Floats | float
    ) -> tuple[Floats, Floats]:
        """Airway pressure after a step at a flow into the lung, and its slope by that flow."""
        if self._second:
            near, far, source = self._branches(x, h, R)
            half = 0.5 * R
            both = 1.0 / (1.0 / near + 1.0 / far)
            return half * flow + both * (flow + source), half + both
        drop, steep = self._airway(flow, R)
        recoil, stiff = self._recoil(x[VOLUME] + h * flow)
        p, steep = drop + recoil, steep + h * stiff
        if self._mass:
            p, steep = p + self._mass * (flow - x[FLOW]) / h, steep + self._mass / h
        return p, steep

    def _branches(self, x: Floats, h: Floats, R: Floats | float) -> tuple[Floats, Floats, Floats]:
        """Effective resistances of both compartments over a step, and the flow that they drive."""
        assert self._second
        C2, R2 = self._second
        near, far = 0.5 * R + h / self._recoil.C, R2 + h / C2
        return near, far, x[VOLUME] / self._recoil.C / near + x[SECOND] / C2 / far

    def _store(
        self,
        x: Floats,
        after: Floats,
        h: Floats,
        flow: Floats,
        R: Floats | float,
        slope: Floats | float,
    ) -> None:
        """Write the volumes and the stress that result from the flow into the lung."""
        after[FLOW] = flow
        if self._second:
            near, far, source = self._branches(x, h, R)
            parting = (flow + source) / (1.0 / near + 1.0 / far)
            first = (parting - x[VOLUME] / self._recoil.C) / near
            after[VOLUME] = x[VOLUME] + h * first
            after[SECOND] = x[SECOND] + h * (flow - first)
        else:
            after[VOLUME] = x[VOLUME] + h * flow
        if self._relax:
            after[STRESS] = x[STRESS] / (1.0 + h / self._relax) + slope * flow

    def _supplied(self, x: Floats, after: Floats, h: Floats, asked: Floats, t: Floats) -> Floats:
        """Flow that reaches the circuit, L/s; the states of valve and supply go into ``after``."""
        q = asked
        if self._tau:
            kept = np.exp(-h / (self._tau / 2 if self._double else self._tau))
            first = q + (x[VALVE] - q) * kept
            if self._double:
                after[VALVE_2] = q = first + (x[VALVE_2] - first) * kept
            else:
                q = first
            after[VALVE] = first
        q = self._disturbances.pulsed(q, t)
        if self._drop:
            recent = x[SUPPLY]
            if self._subtract:
                q = q * np.maximum(1.0 - self._drop * recent / 0.5, 0.2)
            else:
                q = q / (1.0 + self._drop / (1.0 - self._drop) / 0.5 * recent)
            after[SUPPLY] = (self._recovery * recent + h * q) / (self._recovery + h)
        return q
