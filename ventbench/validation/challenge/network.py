"""One step of the rig: flows and pressures at its end, by implicit Euler and Newton's method.

Two half steps and one whole one are combined (Richardson), which makes the method second order; it
stays calm where pressure jumps because gas has mass or where the circuit takes up none.
"""

from __future__ import annotations

import numpy as np

from ventbench.validation.challenge.cases import Base
from ventbench.validation.challenge.lung import Airway, Outlets, Recoil
from ventbench.validation.challenge.sources import Sources
from ventbench.validation.challenge.valve import Effects, Floats

#: Rows of the state, ``(9, n)``: L, L/s, cmH2O.
VOLUME, SECOND, FLOW, PRESSURE, STRESS, VALVE, VALVE_2, SUPPLY, READING = range(9)

_TOLERANCE = 1e-9  # L/s
_NEWTON = 60


class Network:
    """Everything between the valve's command and the sensor.

    Args:
        effects: of the rig, by name.
        base: the rig.
        sources: what drives it beside the valve.
    """

    def __init__(self, effects: Effects, base: Base, sources: Sources) -> None:
        def own(name: str, key: str) -> float:
            return effects[name].parameters[key] if name in effects else 0.0

        self._sources = sources
        self._recoil = Recoil(effects, base)
        self._airway = Airway(effects, base)
        self._outlets = Outlets(effects, base)
        self._tau = own("valve_lag", "tau")
        self._double = "valve_lag" in effects and effects["valve_lag"].form == "two lags"
        self._drop = own("supply_droop", "drop")
        self._recovery = own("supply_droop", "recovery")
        self._subtract = "supply_droop" in effects and self._drop and (
            effects["supply_droop"].form == "subtractive"
        )  # fmt: skip
        self._tubing = 1e-3 * own("circuit_compliance", "compliance")
        self._mass = own("inertance", "inertance")
        self._stress = own("viscoelasticity", "ratio") / self._recoil.C
        self._relax = own("viscoelasticity", "time") or 1.0
        self._slow = own("sensor_lag", "tau")
        self._second: tuple[float, float] | None = None
        if "second_compartment" in effects:
            share = effects["second_compartment"].parameters["share"]
            C2 = share * self._recoil.C
            self._recoil.C -= C2
            self._second = (C2, own("second_compartment", "time") / C2)

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
            state: before, ``(9, n)``.
            h: lengths of the step, s, ``(n,)``.
            asked: flow that the valve is asked for during it, L/s, ``(n,)``.
            opened: 1 if the expiratory valve is open during it, ``(n,)``.
            t: at its start, s from the breath's first sample, ``(n,)``.
        """
        half = 0.5 * h
        middle = self._euler(state, half, asked, opened, t + half)
        fine = self._euler(middle, half, asked, opened, t + h)
        return 2.0 * fine - self._euler(state, h, asked, opened, t + h)

    def _euler(self, x: Floats, h: Floats, asked: Floats, opened: Floats, t: Floats) -> Floats:
        after = x.copy()
        q = self._supplied(x, after, h, asked, t)
        inside = -self._sources.pull(t)
        slope = 0.0
        if self._stress:
            left = 1.0 / (1.0 + h / self._relax)
            inside = inside + x[STRESS] * left
            slope = h * self._stress * left
        R = self._airway.resistance(x[VOLUME])
        flow, p, steep, change = x[FLOW], x[PRESSURE], x[FLOW], x[FLOW]
        for count in range(_NEWTON):
            p, steep = self._pressure(x, flow, h, R)
            p, steep = p + inside + slope * flow, steep + slope
            lost, open_slope = self._outlets(p, opened)
            stored = self._tubing / h
            excess = q - flow - lost - stored * (p - x[PRESSURE])
            change = excess / (1.0 + (open_slope + stored) * steep)
            flow = flow + (change if count < 20 else 0.5 * change)
            if np.abs(change).max() < _TOLERANCE:
                break
        self._settle(x, after, h, flow, R, slope)
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
        """Resistances of two compartments with what a step fills, and the flow they drive."""
        assert self._second
        C2, R2 = self._second
        near, far = 0.5 * R + h / self._recoil.C, R2 + h / C2
        return near, far, x[VOLUME] / self._recoil.C / near + x[SECOND] / C2 / far

    def _settle(
        self, x: Floats, after: Floats, h: Floats, flow: Floats, R: Floats | float,
        slope: Floats | float,
    ) -> None:  # fmt: skip
        """Write what the flow has filled."""
        after[FLOW] = flow
        if self._second:
            near, far, source = self._branches(x, h, R)
            parting = (flow + source) / (1.0 / near + 1.0 / far)
            first = (parting - x[VOLUME] / self._recoil.C) / near
            after[VOLUME] = x[VOLUME] + h * first
            after[SECOND] = x[SECOND] + h * (flow - first)
        else:
            after[VOLUME] = x[VOLUME] + h * flow
        if self._stress:
            after[STRESS] = x[STRESS] / (1.0 + h / self._relax) + slope * flow

    def _supplied(self, x: Floats, after: Floats, h: Floats, asked: Floats, t: Floats) -> Floats:
        """Flow that arrives at the airway, L/s."""
        q = asked
        if self._tau:
            kept = np.exp(-h / (self._tau / 2 if self._double else self._tau))
            first = q + (x[VALVE] - q) * kept
            if self._double:
                after[VALVE_2] = q = first + (x[VALVE_2] - first) * kept
            else:
                q = first
            after[VALVE] = first
        q = self._sources.pulsed(q, t)
        if self._drop:
            recent = x[SUPPLY]
            if self._subtract:
                q = q * np.maximum(1.0 - self._drop * recent / 0.5, 0.2)
            else:
                q = q / (1.0 + self._drop / (1.0 - self._drop) / 0.5 * recent)
            after[SUPPLY] = (self._recovery * recent + h * q) / (self._recovery + h)
        return q
