"""Lung, circuit and valves of the second generator: a fixed-step, semi-implicit integration.

The states are the pressure of the circuit's node, the flow through the airway (with the inertia of
its gas), the volume of each compartment, the stress of the tissue, the position of the inspiratory
valve, the pressure deficit of the supply, the position of the expiratory valve, and the sensor's.
Stiff terms are implicit and nonlinear ones are linearised at the step before, at a fixed step of a
tenth of a millisecond, so that no step depends on where commands change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hardware_eval.emulation.cases import Base, Effect
from proofs.challenge.questions import parameter
from ventbench.base.arrays import Bools, Floats

#: Flow at which a laminar resistance and another form of friction have the same drop, L/s.
_FLOW = 0.6

#: Pressure at which leaks of all forms are alike, cmH2O.
_PRESSURE = 20.0

#: Flow at which the drop of the supply is stated, L/s.
_SUPPLY_FLOW = 0.5

#: Volume of the lung at PEEP to which the resistance of a breathing lung refers, in units of
#: compliance times cmH2O.
_BEAT_HARMONIC = 0.35

#: Share of a stiffening lung's capacity up to which its curve is followed. Beyond, gas and walls
#: still give a little.
_FULL = 0.97

#: Time constant of a slowly opening expiratory valve, as a share of its dead time's strength.
_SLOW = 0.7


@dataclass(eq=False)
class Rig:
    """The physics of n breaths side by side; :meth:`advance` changes the state in place.

    Args of all methods are arrays ``(n,)``.
    """

    base: Base
    effects: dict[str, Effect]
    position: Floats
    dead_space: float
    phases: Floats
    efforts: Floats

    def __post_init__(self) -> None:
        """Derive the coefficients, in L, s and cmH2O."""
        n, base = len(self.position), self.base
        self.n = n
        change_C = self._strength("compliance_change", "change") * self.position
        change_R = self._strength("resistance_change", "change") * self.position
        self.C = base.C * 1e-3 * (1.0 + change_C)
        self.R = base.R * (1.0 + change_R)
        self.Rex = np.full(n, base.R_ex)
        self.circuit = self.dead_space * 1e-3
        self.circuit += self._strength("circuit_compliance", "compliance") * 1e-3
        self.circuit += self._strength("inertance", "circuit") * 1e-3
        self.inertia = self._strength("inertance", "inertance")
        self.gain = base.gain * 1e-3

    def start(self, pressure: Floats) -> None:
        """Rest at airway pressures, cmH2O."""
        n = self.n
        self.p = pressure.astype(float).copy()
        self.rest = np.full(n, self.base.peep)
        self.q = np.zeros(n)
        self.v, self.v2 = self._volumes(self.p - self.rest)  # beyond those at PEEP
        self.stress = np.zeros(n)
        self.held = np.zeros(n)  # hysteresis, and the command before, whose travel it follows
        self.command = np.zeros(n)
        self.valve = np.zeros(n)
        self.speed = np.zeros(n)
        self.deficit = np.zeros(n)
        self.outlet = np.zeros(n)
        self.reading, self.filter = self.p.copy(), self.p.copy()

    def steady_command(self, u: Floats, due: Bools) -> Floats:
        """Opening of the inspiratory valve that commands ask for, %; the due breaths move on."""
        effects = self.effects
        if "command_rounding" in effects:
            u = np.floor(u + 1e-9)
        if (dead := effects.get("valve_dead_band")) is not None:
            width = dead.parameters["width"]
            u = (
                np.maximum(u - width, 0.0)
                if dead.form == "spool overlap"
                else np.where(u > width, u, 0.0)
            )
        if (play := effects.get("valve_hysteresis")) is not None:
            half = 0.5 * play.parameters["width"]
            if play.form == "backlash":
                held = np.clip(self.held, u - half, u + half)
                opening = np.maximum(held, 0.0)
            else:  # Bouc-Wen: the play approaches its width exponentially with the travel
                travel = u - self.command
                full = np.sign(travel) * half
                held = full + (self.held - full) * np.exp(-np.abs(travel) / half)
                opening = np.maximum(u - held, 0.0)
            self.held, self.command = np.where(due, held, self.held), np.where(due, u, self.command)
            u = opening
        if (curve := effects.get("valve_curve")) is not None:
            loss, x = curve.parameters["loss"], u / 100.0
            if curve.form == "rational saturation":
                u = 100.0 * x / (1.0 + loss / (1.0 - loss) * x)
            elif curve.form == "equal percentage":
                # Convex, and as steep as a linear valve near closure times 1 - loss.
                b = np.log(30.0)
                shape = (np.exp(b * x) - 1.0) / (np.exp(b) - 1.0)
                u = 100.0 * ((1.0 - loss) * x + loss * shape)
            else:
                u = 100.0 * ((1.0 - loss) * x + loss * np.sqrt(x))
        return u

    def advance(self, opening: Floats, out: Floats, time: float, h: float) -> None:
        """Advance by one step.

        Args:
            opening: what the inspiratory valve is asked for now, %, ``(n,)``.
            out: expiratory valve, 0 or 1, ``(n,)``.
            time: since the start of the breath, at the end of the step, s.
            h: length of the step, s.
        """
        inflow, outlet = self._inflow(opening, time, h), self._outlet(out, h)
        leak_slope, leak_flow = self._leak()
        R = self._resistance()
        recoil, slope = self._recoil()
        muscle = self._pressure_inside(time)
        stiff, relaxed = self._tissue(h)
        # Airway: inertia (q' - q)/h + R q' = p' - (recoil + stress after the step) + muscle.
        inner = slope * h + stiff * h
        drive = recoil + relaxed - muscle - self.inertia * self.q / h
        conductance = 1.0 / (R + inner + self.inertia / h)
        if "second_compartment" in self.effects:
            self._two_compartments(inflow, outlet, leak_slope, leak_flow, R, slope, h)
        else:
            total = self.circuit / h + conductance + leak_slope
            source = self.circuit * self.p / h + inflow + conductance * drive - leak_flow
            shut = source / total
            vented = (source + outlet * self.base.peep) / (total + outlet)
            self.p = np.where(shut > self.base.peep, vented, shut)
            self.q = conductance * (self.p - drive)
            self.v = self.v + h * self.q
        if "viscoelasticity" in self.effects:
            self.stress = relaxed + stiff * h * self.q
        self._sense(h)

    def shown(self) -> Floats:
        """Pressure that the sensor shows, without noise, cmH2O."""
        y = self.reading
        if (bent := self.effects.get("sensor_nonlinearity")) is not None:
            y = y + bent.parameters["bend"] * np.sin(np.pi * np.clip(y, -20.0, 60.0) / 40.0)
        if (drift := self.effects.get("sensor_drift")) is not None:
            course = self.position
            if drift.form == "warming":
                course = (1.0 - np.exp(-3.0 * self.position)) / (1.0 - np.exp(-3.0))
            y = y + drift.parameters["drift"] * course
        return y

    def _strength(self, name: str, key: str) -> float:
        return parameter(self.effects, name, key)

    def _inflow(self, opening: Floats, time: float, h: float) -> Floats:
        """Flow out of the inspiratory valve, L/s."""
        lag = self.effects.get("valve_lag")
        if lag is None:
            self.valve = opening
        elif lag.form == "second order":  # critically damped, with the same mean delay
            w = 2.0 / lag.parameters["tau"]
            push = w * w * (opening - self.valve)
            self.speed = (self.speed + h * push) / (1.0 + 2.0 * w * h + (w * h) ** 2)
            self.valve = self.valve + h * self.speed
        else:
            decay = np.exp(-h / lag.parameters["tau"])
            self.valve = opening + (self.valve - opening) * decay
        flow = self.gain * self.valve
        if (droop := self.effects.get("supply_droop")) is not None:
            # What leaves the reservoir empties it, not what the valve asks for.
            drawn = flow * np.clip(1.0 - self.deficit, 0.05, 1.0)
            full = droop.parameters["drop"] * drawn / _SUPPLY_FLOW
            rate = np.exp(-h / droop.parameters["recovery"])
            self.deficit = full + (self.deficit - full) * rate
            flow = flow * np.clip(1.0 - self.deficit, 0.05, 1.0)
        if "supply_back_pressure" in self.effects:
            supply = self._strength("supply_back_pressure", "supply")
            flow = flow * np.sqrt(np.clip((supply - self.p) / supply, 0.0, 2.0))
        if (pulse := self.effects.get("pulsating_supply")) is not None:
            angle = 2.0 * np.pi * pulse.parameters["frequency"] * time + self.phases
            # A piston delivers in strokes: a sine with its second harmonic.
            wave = np.sin(angle) + 0.3 * np.sin(2.0 * angle)
            flow = flow * (1.0 + pulse.parameters["amplitude"] * wave)
        return flow

    def _outlet(self, out: Floats, h: float) -> Floats:
        """Conductance of the expiratory valve, L/s per cmH2O."""
        late = self.effects.get("exhalation_valve_delay")
        if late is not None and late.form == "slow opening":
            rate = np.exp(-h / (_SLOW * late.parameters["opening"]))
            self.outlet = np.where(out > 0, out + (self.outlet - out) * rate, 0.0)
        else:
            self.outlet = out
        conductance = self.outlet / self.Rex
        if "expiratory_valve_orifice" in self.effects:
            # The same as R_ex at 10 cmH2O, by Bernoulli elsewhere.
            above = np.maximum(self.p - self.base.peep, 0.05)
            conductance = conductance * np.sqrt(10.0 / above)
        return conductance

    def _leak(self) -> tuple[Floats | float, Floats | float]:
        """Slope of the leak, L/s per cmH2O, and flow at zero pressure on that tangent."""
        leak = self.effects.get("leak")
        if leak is None:
            return 0.0, 0.0
        orifice, p = leak.parameters["conductance"] * 1e-3, np.maximum(self.p, 0.2)
        power = {"laminar": 1.0, "exponent 0.7": 0.7}.get(leak.form, 0.5)
        flow = orifice * np.sqrt(_PRESSURE) * (p / _PRESSURE) ** power
        slope = power * flow / p
        return slope, flow - slope * p

    def _resistance(self) -> Floats:
        """Resistance of the airway at the flow of the step before, cmH2O/(L/s)."""
        R, size = self.R, np.abs(self.q)
        if (rough := self.effects.get("turbulent_resistance")) is not None:
            K2 = rough.parameters["quadratic"]
            blasius = rough.form == "Blasius"
            R = R + (K2 * _FLOW**0.25 * size**0.75 if blasius else K2 * size)
        if "direction_resistance" in self.effects:
            R = np.where(self.q < 0.0, R * self._strength("direction_resistance", "ratio"), R)
        if "volume_resistance" in self.effects:
            reference = self.base.C * 1e-3 * self._strength("volume_resistance", "capacity")
            R = R * 1.3 / (1.0 + np.maximum(self.v, 0.0) / reference)
        return R

    def _recoil(self) -> tuple[Floats, Floats]:
        """Recoil at the volume of the step before, cmH2O, and its slope, cmH2O/L."""
        stiff = self.effects.get("nonlinear_compliance")
        if stiff is None:
            return self.rest + self.v / self.C, 1.0 / self.C
        capacity = stiff.parameters["capacity"]  # cmH2O: volume of the lung over its compliance
        # A full lung takes no more at the same pressure: the curve goes on as its tangent.
        x = self.v / (self.C * capacity)
        within = np.clip(x, -_FULL, _FULL)
        if stiff.form == "Salazar-Knowles":  # V = Vmax (1 - exp(-p / capacity))
            curve, slope = -np.log1p(-within), 1.0 / (1.0 - within)
        else:  # Venegas: a logistic of volume, here from its middle upwards
            curve, slope = np.arctanh(within), 1.0 / (1.0 - within**2)
        return self.rest + capacity * (curve + slope * (x - within)), slope / self.C

    def _volumes(self, above: Floats) -> tuple[Floats, Floats]:
        """Volumes of the lung, and of the second compartment, at rest above PEEP, L."""
        if "second_compartment" in self.effects:
            share = self._strength("second_compartment", "share")
            return (1.0 - share) * self.C * above, share * self.C * above
        stiff, zero = self.effects.get("nonlinear_compliance"), np.zeros(self.n)
        if stiff is None:
            return self.C * above, zero
        capacity = stiff.parameters["capacity"]
        x = above / capacity
        exponential = stiff.form == "Salazar-Knowles"
        return self.C * capacity * (-np.expm1(-x) if exponential else np.tanh(x)), zero

    def _tissue(self, h: float) -> tuple[float | Floats, float | Floats]:
        """Slope of the stress of the tissue after a step, cmH2O/L, and stress at zero flow."""
        maxwell = self.effects.get("viscoelasticity")
        if maxwell is None:
            return 0.0, 0.0
        decay = 1.0 / (1.0 + h / maxwell.parameters["time"])
        return maxwell.parameters["ratio"] / self.C * decay, self.stress * decay

    def _pressure_inside(self, time: float) -> Floats | float:
        """Pressure of muscles and heart at the alveolus, that draws gas in, cmH2O."""
        total: Floats | float = 0.0
        if (effort := self.effects.get("patient_effort")) is not None:
            size, onset = self.efforts
            since = (time - onset) / effort.parameters["duration"]
            acting = since > 0.0
            if effort.form == "half sine":
                shape = np.where(acting & (since < 1.0), np.sin(np.pi * np.clip(since, 0, 1)), 0.0)
            else:  # rises to its peak at 60 % of the duration, then relaxes exponentially
                rise = (1.0 - np.exp(-since / 0.25)) / (1.0 - np.exp(-0.6 / 0.25))
                fall = np.exp(-(since - 0.6) / 0.15)
                shape = np.where(acting, np.where(since < 0.6, rise, fall), 0.0)
            total = total + size * shape
        if (heart := self.effects.get("cardiogenic")) is not None:
            angle = 2.0 * np.pi * heart.parameters["frequency"] * time + self.phases
            wave = np.sin(angle) + _BEAT_HARMONIC * np.sin(2.0 * angle + 1.0)
            total = total + heart.parameters["amplitude"] * wave
        return total

    def _two_compartments(
        self,
        inflow: Floats,
        outlet: Floats,
        leak_slope: Floats | float,
        leak_flow: Floats | float,
        R: Floats,
        slope: Floats,
        h: float,
    ) -> None:
        """Otis: a common airway of half the resistance, and two parallel lungs behind it."""
        share = self._strength("second_compartment", "share")
        slow = self._strength("second_compartment", "time")
        common = 0.5 * R
        C2 = share * self.C
        C1 = self.C - C2
        # Conductances of the branches over an implicit step of their volumes.
        g1, g2 = 1.0 / (0.5 * R + h / C1), 1.0 / (slow / C2 + h / C2)
        p1, p2 = self.rest + self.v / C1, self.rest + self.v2 / C2
        inner = g1 + g2
        behind = (g1 * p1 + g2 * p2) / inner
        conductance = 1.0 / (common + 1.0 / inner)
        total = self.circuit / h + conductance + leak_slope
        source = self.circuit * self.p / h + inflow + conductance * behind - leak_flow
        shut = source / total
        vented = (source + outlet * self.base.peep) / (total + outlet)
        self.p = np.where(shut > self.base.peep, vented, shut)
        self.q = conductance * (self.p - behind)
        node = self.p - common * self.q
        self.v = self.v + h * g1 * (node - p1)
        self.v2 = self.v2 + h * g2 * (node - p2)

    def _sense(self, h: float) -> None:
        lag = self.effects.get("sensor_lag")
        if lag is None:
            self.reading = self.p
        elif lag.form == "second order":  # two equal lags with the same mean delay
            decay = np.exp(-2.0 * h / lag.parameters["tau"])
            self.filter = self.p + (self.filter - self.p) * decay
            self.reading = self.filter + (self.reading - self.filter) * decay
        else:
            decay = np.exp(-h / lag.parameters["tau"])
            self.reading = self.p + (self.reading - self.p) * decay
