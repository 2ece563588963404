"""The same physics written anew: ordinary differential equations for scipy, one breath at a time.

No code, no discretisation and no state is shared with the package: between all edges of the delayed
commands an adaptive solver integrates, and the airway's pressure, where it has no state of its own,
comes from a root finder.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


def valve_positions(u_in, m):
    """What reaches the valve's orifice, as the command of a linear valve, %."""
    out, stands, asked, rests = [], 0.0, 0.0, 0.0
    for u in u_in:
        if "command_rounding" in m:
            rule = {"step": 1.0, "bias": 0.0} | m["command_rounding"]
            u = rule["step"] * float(np.floor(u / rule["step"] + rule["bias"]))
        dead = {"crack": 0.0, "driver": 0.0} | m.get("valve_dead_band", {})
        if dead["driver"]:
            u = remainder(u, dead["driver"] * dead["width"], dead["crack"])
        if "valve_hysteresis" in m:
            m_play = {"give": 0.0, "smooth": 0.0} | m["valve_hysteresis"]
            play, give, smooth = m_play["width"] / 2, m_play["give"], m_play["smooth"]
            soft = u - play * np.tanh((u - stands) / play)
            up = 1.0 if u > asked else -1.0
            slow = u - play * (up + ((asked - stands) / play - up) * np.exp(-abs(u - asked) / play))
            asked = u
            if u - stands > play:
                stands = u - play
            elif stands - u > play:
                stands = u + play
            yielding = give * soft + (1 - give) * stands
            u = stands = smooth * slow + (1 - smooth) * yielding
        if "valve_stiction" in m:
            band, away = m["valve_stiction"]["band"], u - rests
            u = rests = rests + away * np.clip(0.5 + (abs(away) - band) / (0.2 * band), 0.0, 1.0)
        if dead["driver"] < 1 and "valve_dead_band" in m:
            u = remainder(u, (1 - dead["driver"]) * dead["width"], dead["crack"])
        if "valve_curve" in m:
            u = u / (1 + u / 100 * m["valve_curve"]["loss"] / (1 - m["valve_curve"]["loss"]))
        out.append(u)
    return out


def remainder(u, width, crack):
    """What a dead band leaves of a command."""
    stuck = u * np.clip(0.5 + (u - width) / (0.2 * width), 0.0, 1.0)  # lets go
    return (1 - crack) * max(0.0, u - width) + crack * stuck


def recoil(volume, C, m):
    linear = volume / (C / 1000)
    k = m.get("nonlinear_compliance", {}).get("stiffening", 0.0)
    share = m.get("nonlinear_compliance", {}).get("sigmoid", 0.0)
    x = k * linear
    return np.log((1 + share * x) / (1 - x)) / (1 + share) / k if k else linear


#: Time, s, in which a limited valve follows what it can.
AT_ONCE = 1e-4

#: Radii of the stops of a hysteresis, cmH2O.
RADII = np.array([1.0, 3.0, 9.0])


class Breath:
    """Right-hand side.

    States: volume, valve, supply, stress, airway, flow, sensor, second lags of valve and sensor,
    limited valve, reading of a line and its slope, share of a plug.
    """

    def __init__(self, R, C, m, R_ex, peep):
        self.R, self.C, self.m, self.R_ex, self.peep = R, C, m, R_ex, peep
        self.K2 = self.get("turbulent_resistance", "quadratic")
        self.power = m.get("turbulent_resistance", {}).get("exponent", 2.0)
        self.tank = self.get("circuit_compliance", "compliance") / 1000
        self.mass = self.get("inertance", "inertance")
        if self.mass:  # tubing that acts with the mass alone
            self.tank += self.get("inertance", "tubing") / 1000 * self.mass / (self.mass + 0.003)
        loss = self.get("supply_pressure", "loss")
        self.source = 30 / (1 - (1 - loss) ** 2) if loss else np.inf
        self.lag, self.second = self.get("valve_lag", "tau"), self.get("valve_lag", "second")
        self.slow, self.filter = self.get("sensor_lag", "tau"), self.get("sensor_lag", "second")
        self.opening, self.opened_at = 0.0, 0.0  # lag of the expiratory valve, and when it opens
        stroke = self.get("valve_rate", "stroke")
        self.rate = 2.28 / stroke if stroke else np.inf
        self.line = self.get("pressure_line", "time")
        self.damping = m.get("pressure_line", {}).get("damping", 0.3)
        self.loop = self.get("lung_hysteresis", "height")
        self.stops, self.began = -np.ones(3), 0.0  # at the start of a stretch
        self.plug = self.get("airway_opening", "resistance")
        self.opens = m.get("airway_opening", {}).get("opening", 13.0)
        self.tap = self.get("tap_constriction", "drop")
        self.ratio, self.relax = self.get("viscoelasticity", "ratio"), 1.0
        if self.ratio:
            self.relax = m["viscoelasticity"]["time"]
        assert not self.mass or self.tank, "a gas with mass needs somewhere to go"

    def get(self, mechanism, name):
        return self.m.get(mechanism, {}).get(name, 0.0)

    def muscle(self, t):
        if "patient_effort" not in self.m:
            return 0.0
        e = self.m["patient_effort"]
        x = (t - e["onset"]) / e["duration"]
        sine = np.sin(np.pi * x) if 0 < x < 1 else 0.0
        relaxing = e.get("relaxing", 0.0)
        muscle = 0.0 if x < 0 else np.sin(0.75 * np.pi * x) if x < 2 / 3 else np.exp(4 - 6 * x)
        return e["amplitude"] * ((1 - relaxing) * sine + relaxing * muscle)

    def lost(self, p):
        """Leaks, L/s: an orifice that is rounded off at 0.2 cmH2O, and one with a spring."""
        above = max(p - self.get("relief_leak", "opening"), 0.0)
        above *= self.get("relief_leak", "conductance") / 1000
        return self.get("leak", "conductance") / 1000 * p / np.sqrt(np.hypot(p, 0.2)) + above

    def balance(self, t, y, wanted, opened):
        """Flow of the valve against the airway and against none, into the lung, out; pressures."""
        volume, valve, supply, stress, airway, flow, _, behind, _, limited, *_ = y
        q = behind if self.second else valve if self.lag else wanted
        q = limited if np.isfinite(self.rate) else q
        d, linear = self.get("supply_droop", "drop"), self.get("supply_droop", "linear")
        levelling = 1 / (1 + d / (1 - d) * supply / 0.5)
        q = q * ((1 - linear) * levelling + linear * max(1 - d * supply / 0.5, 0.02))
        through = q

        def fed(p):
            return through * np.sqrt(max(1 - p / self.source, 1e-9))

        inside = recoil(volume, self.C, self.m)
        inside += stress - self.muscle(t)
        if self.loop:
            inside += self.loop * (1 + np.mean(self.stops_at(volume))) / 2
        R = self.R + self.plug * y[12]

        def into(p):
            if self.mass:
                return flow
            x = p - inside
            if not self.K2:
                return x / R
            if self.power == 2:
                root = np.sqrt(R**2 + 4 * self.K2 * abs(x))
                return np.sign(x) * (root - R) / 2 / self.K2
            size = abs(x)
            return np.sign(x) * brentq(
                lambda q: R * q + self.K2 * q**self.power - size,
                0.0,
                size / R + 1e-9,
                xtol=1e-13,
            )

        wide = opened
        if opened and self.opening:
            wide = 1 - np.exp(-(t - self.opened_at) / self.opening)

        def out(p):
            return wide * max(p - self.peep, 0.0) / self.R_ex

        if not self.tank:
            airway = brentq(
                lambda p: fed(p) - self.lost(p) - out(p) - into(p), -2000, 3000, xtol=1e-11
            )
        return fed(airway), q, into(airway), out(airway), airway, inside, R

    def slope(self, t, y, wanted, opened):
        _, valve, supply, stress, _, _, sensor, behind, filtered, limited, line, speed, *_ = y
        q, drawn, flow, out, p, inside, R = self.balance(t, y, wanted, opened)
        asked = behind if self.second else valve if self.lag else wanted
        seen = p - self.tap * flow**2
        shown = filtered if self.filter else sensor if self.slow else seen
        drop = R * flow + self.K2 * flow * abs(flow) ** (self.power - 1)
        return [
            flow,
            (wanted - valve) / self.lag if self.lag else 0.0,
            (drawn - supply) / 1.0,
            self.ratio / (self.C / 1000) * flow - stress / self.relax,
            (q - flow - out - self.lost(p)) / self.tank if self.tank else 0.0,
            (p - inside - drop) / self.mass if self.mass else 0.0,
            (seen - sensor) / self.slow if self.slow else 0.0,
            (valve - behind) / self.second if self.second else 0.0,
            (sensor - filtered) / self.filter if self.filter else 0.0,
            np.clip((asked - limited) / AT_ONCE, -self.rate, self.rate)
            if np.isfinite(self.rate)
            else 0.0,
            speed if self.line else 0.0,
            (shown - line) / self.line**2 - 2 * self.damping * speed / self.line
            if self.line
            else 0.0,
            -y[12] * np.clip(0.5 + (p - self.opens) / 0.5, 0.0, 1.0) / 0.03 if self.plug else 0.0,
        ]

    def stops_at(self, volume):
        """Stops of the lung's hysteresis, in a stretch in which the volume goes one way."""
        return np.clip(self.stops + (volume - self.began) / (self.C / 1000) / RADII, -1.0, 1.0)

    def reading(self, y, flow, p):
        """What the sensor shows, but for its hysteresis."""
        seen = p - self.tap * flow**2
        return y[10] if self.line else y[8] if self.filter else y[6] if self.slow else seen


def breath(R, C, u_in, u_out, dt, start, m, *, peep=5.0, gain=22.8, R_ex=5.0, position=0.0):
    """Pressure, cmH2O, flow, mL/s, and volume, mL, at each sample, ``(3, T)``."""

    def drift(name, of="change"):
        own = m.get(name, {})
        w = own.get("warming", 0.0)
        return own.get(of, 0.0) * (
            (1 - np.exp(-w * position)) / (1 - np.exp(-w)) if w else position
        )

    def step(name):
        own = m.get(name, {"at": 0.0, "change": 0.0})
        return own["change"] if position > own["at"] else 0.0

    zero = drift("sensor_drift", "drift") + step("zero_step")
    bend = m.get("sensor_curve", {}).get("bend", 0.0)

    def shown(p):
        return p + 4 * bend * p / 40 * (1 - p / 40) + zero

    R = R * (1 + drift("resistance_drift")) * (1 + step("resistance_step"))
    C = C * (1 + drift("compliance_drift")) * (1 + step("compliance_step"))
    gain = gain * (1 + drift("gain_drift")) * (1 + step("gain_step"))
    rig = Breath(R, C, m, R_ex, peep)
    p0 = brentq(lambda p: shown(p) - start, -20.0, 60.0, xtol=1e-13) if bend else start - zero
    inside = p0 + rig.get("trapped_gas", "pressure")
    v0 = brentq(lambda v: recoil(v, C, m) - inside, -0.01, 0.0239 * C, xtol=1e-14)
    times = np.concatenate([[0.0], np.cumsum(dt[:-1])])
    asked = [gain / 1000 * u for u in valve_positions(u_in, m)]
    late, late_out = rig.get("valve_delay", "delay"), rig.get("exhalation_valve_delay", "opening")
    late_shut = rig.get("exhalation_valve_closing", "closing")
    rig.opening = late_out * rig.get("exhalation_valve_delay", "slow")
    late_out -= rig.opening
    behind, skew = rig.get("clock_offset", "offset"), rig.get("clock_skew", "skew")

    def arrives(t):
        """When a command is seen in pressure, by the clock of pressure."""
        return (t + behind) / (1 - skew)

    opens = arrives(times[1:][np.diff(u_out) > 0] + late_out)
    edges = set(times).union(*(arrives(times + x) for x in (0.0, late, late_out, late_shut)))
    if "patient_effort" in m:
        e = m["patient_effort"]
        edges |= {e["onset"] + share * e["duration"] for share in (0.0, 2 / 3, 1.0)}
    edges = sorted(t for t in edges if t <= times[-1])

    def held(values, before, t):
        i = int(np.searchsorted(times, t, side="right")) - 1
        return before if i < 0 else values[i]

    y = np.array([v0, 0.0, 0.0, 0.0, p0, 0.0, p0, 0.0, p0, 0.0, p0, 0.0, 1.0])
    rig.began = y[0]
    width, loop, last = rig.get("sensor_hysteresis", "width"), -np.ones(3), p0
    rows = [(start, 0.0, 0.0)]
    for a, b in pairwise(edges):
        if b - a < 1e-12:
            continue
        middle = (a + b) / 2
        told = middle * (1 - skew) - behind
        wanted = held(asked, 0.0, told - late)
        asks = held(u_out, 1.0, told)
        opened = asks and held(u_out, 0.0, told - late_out)
        opened = opened or (not asks and late_shut and held(u_out, 1.0, told - late_shut))
        if opened and rig.opening:
            rig.opened_at = max(opens[opens < middle])
        fine = {"t_eval": np.linspace(a, b, 41)} if width else {}
        found = solve_ivp(
            rig.slope, (a, b), y, "LSODA", rtol=1e-8, atol=1e-10, args=(wanted, opened), **fine
        )
        y = found.y[:, -1]
        rig.stops, rig.began = rig.stops_at(y[0]), y[0]
        for t, each in zip(found.t, found.y.T, strict=True) if width else ():
            _, _, flow, _, p, _, _ = rig.balance(t, each, wanted, opened)
            last, change = rig.reading(each, flow, p), rig.reading(each, flow, p) - last
            loop = np.clip(loop + change / RADII, -1.0, 1.0)
        if np.any(np.abs(times - b) < 1e-12):
            _, _, flow, _, p, _, _ = rig.balance(b, y, wanted, opened)
            reading = rig.reading(y, flow, p) - width * (1 + np.mean(loop)) / 2
            rows.append((shown(reading), 1000 * flow, 1000 * (y[0] - v0)))
    return np.array(rows).T
