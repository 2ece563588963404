"""Recordings of the third generator: a lung behind a valve, with its faults, and its log.

The pressure of the circuit and the volume of the lung are integrated in sixteen implicit steps
between two samples; flows of leaks and outlets are linearised at the step before. The history of
the pressure is kept, so that the log may have another clock than the valve.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import Case, Effect
from proofs.challenge.faults.effects import PARTIAL, FaultsCase, affected
from proofs.challenge.questions import coloured_noise, held_levels, logged, parameter
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.recordings.breaths import Breaths

#: Takes the number of a sample and the sensor's pressure, ``(n,)``; returns the commands, %.
Command = Callable[[int, Floats], Floats]

#: Integration steps between two samples.
_STEPS = 16

#: Time from one breath to the next, s, by which oscillations go on between breaths.
_PERIOD = 3.0

#: Pressure above which the ventilator shuts its valve, cmH2O.
_RELIEF = 50.0

#: Conductance of an open tube, mL/s at 1 cmH2O, and least pressure at which a flow is linearised.
_OPEN_TUBE, _LEAST = 500.0, 0.3

#: Flow at which water in a tube swings fully, L/s; rattle of secretions, Hz, and its depth.
_SWINGS, _RATTLE, _DEPTH = 0.15, 11.0, 0.5


class _Faults:
    """Faults of n breaths, resolved to one number or course for each breath."""

    def __init__(self, case: FaultsCase, number: Ints) -> None:
        self.case, self.number = case, number
        self.effects = {effect.name: effect for effect in case.effects}
        self.position = number / max(case.breaths - 1, 1)
        # One row of random numbers for each breath of the session, however many are asked for.
        size = max(case.breaths, int(number.max()) + 1)
        self.random = np.random.default_rng((case.choice, 1)).uniform(size=(size, 4))[number]
        self.chosen = {
            name: affected(case, self.effects[name], number)
            for name in PARTIAL
            if name in self.effects and name != "relief_leak"
        }

    def value(self, name: str, key: str) -> float:
        return parameter(self.effects, name, key)

    def course(self, quantity: str, key: str = "change") -> Floats:
        """Change of a quantity in each breath: a step, a line, or an exponential warm-up."""
        change = np.zeros(len(self.number))
        if (step := self.effects.get(f"{quantity}_step")) is not None:
            change += step.parameters["change"] * (self.number + 1 >= step.parameters["breath"])
        name = "sensor_drift" if quantity == "zero" else f"{quantity}_drift"
        if (drift := self.effects.get(name)) is not None:
            warm = -np.expm1(-4.0 * self.position) / -np.expm1(-4.0)
            shape = warm if drift.form == "warm-up" else self.position
            change += drift.parameters["drift" if quantity == "zero" else "change"] * shape
        return change

    def within(self, name: str, time: Floats) -> Bools:
        """Where a fault of some breaths acts, at times of the breath, ``(n,)`` or ``(n, T)``."""
        if name not in self.chosen:
            return np.zeros(time.shape, bool)
        extra = (slice(None),) + (None,) * (time.ndim - 1)
        chosen = self.chosen[name][extra]
        late, length = self.random[:, 0][extra], self.random[:, 1][extra]
        if name == "disconnection":
            begins = 0.2 + 0.5 * late * self.case.inspiration
            return chosen & (time >= begins) & (time <= begins + 0.25 + 0.3 * length)
        if name == "cough":
            begins = 0.3 + 1.2 * late
            return chosen & (time >= begins) & (time <= begins + 0.15 + 0.15 * length)
        return np.broadcast_to(chosen, time.shape)


def record(case: Case, rng: np.random.Generator, *, share: float = 1.0) -> Breaths:
    """Record a case: volume-controlled, pressure-controlled and explored breaths.

    Args:
        case: a case of this generator.
        rng: source of everything that varies.
        share: scales pressures above PEEP and flows.
    """
    assert isinstance(case, FaultsCase)
    assert case.base is not None
    n, samples, base = case.breaths, case.samples, case.base
    ticks = case.interval + case.jitter * rng.standard_normal((n, samples - 1))
    time = np.concatenate([np.zeros((n, 1)), np.cumsum(np.maximum(ticks, 0.005), axis=1)], axis=1)
    time = np.round(time, 6)
    u_out = (time >= case.inspiration).astype(np.int8)
    mode = rng.choice(3, n, p=(0.35, 0.4, 0.25))
    above = share * rng.uniform(8.0, 27.0, n)
    # Volume control: the flow that fills the lung by its pressure within the inspiration.
    flow = above / (base.R + case.inspiration / (1e-3 * base.C))
    falls = rng.uniform(0.0, 1.0, n)
    gain, integral = np.exp(rng.uniform(np.log(0.3), np.log(4.0), n)), rng.uniform(3.0, 15.0, n)
    rise = rng.uniform(0.02, 0.25, n)
    level = held_levels(time, case.inspiration, rng, 0.2, 1.6)
    summed, noise = np.zeros(n), coloured_noise(case, 0.7, rng, time.shape)

    def command(k: int, pressure: Floats) -> Floats:
        nonlocal summed
        now = time[:, k]
        seen = pressure + noise[:, k]
        target = base.peep + above * np.clip(now / rise, 0.0, 1.0)
        ahead = np.clip(summed + integral * case.interval * (target - seen), 0.0, 100.0)
        asked = gain * (target - seen) + ahead
        summed = np.where((asked > 0.0) & (asked < 100.0), ahead, summed)
        steady = 1e3 * flow / base.gain
        falling = steady * (1.0 + falls * (0.5 - now / case.inspiration))
        u = np.select([mode == 0, mode == 1], [falling, asked], steady * level[:, k])
        u = np.where((seen > _RELIEF) | (u_out[:, k] == 1), 0.0, np.clip(u, 0.0, 100.0))
        return np.round(np.round(u / case.log_step) * case.log_step, 6)

    rest = base.peep + 0.2 * rng.standard_normal(n)
    u_in, readings = _run(case, time, u_out, command, np.arange(n), rest)
    pressure = readings + noise
    if case.step:
        pressure = case.step * np.round(pressure / case.step)
    return logged(case, np.arange(n), time, u_in, u_out, _saturated(case, pressure))


def replay(case: Case, breaths: Breaths, start: Floats, seed: int) -> Floats:
    """Readings without noise under recorded commands, cmH2O, ``(n, T)``.

    Args:
        case: a case of this generator with its base.
        breaths: commands and times.
        start: airway pressure at rest, ``(n,)``.
        seed: not used; which breaths are affected belongs to the case.
    """
    assert isinstance(case, FaultsCase)
    _, readings = _run(
        case,
        breaths.time,
        breaths.u_out,
        lambda k, pressure: breaths.u_in[:, k],
        breaths.breath_id - 1,
        start,
    )
    return np.round(_saturated(case, readings), 6)


def _saturated(case: FaultsCase, pressure: Floats) -> Floats:
    effects = {effect.name: effect for effect in case.effects}
    return np.minimum(pressure, parameter(effects, "saturation", "level", np.inf))


def active(case: Case, breaths: Breaths) -> Bools | None:
    """Samples in which faults act that act in part of the recording, ``(n, T)``; None if none do.

    A leak above a pressure acts where the pressure, as recorded, is above it.
    """
    assert isinstance(case, FaultsCase)
    names = [effect.name for effect in case.effects]
    if not names or any(name not in PARTIAL for name in names):
        return None  # a fault acts everywhere
    faults, found = _Faults(case, breaths.breath_id - 1), np.zeros(breaths.time.shape, bool)
    for name in names:
        if name == "relief_leak":
            found |= np.nan_to_num(breaths.pressure) > faults.value(name, "opening")
        else:
            found |= faults.within(name, breaths.time)
    return found if found.any() else None


def _run(
    case: FaultsCase,
    time: Floats,
    u_out: NDArray[np.int8],
    command: Command,
    number: Ints,
    rest: Floats,
) -> tuple[Floats, Floats]:
    """Simulate breaths side by side from rest at ``rest``, cmH2O; commands and readings."""
    assert case.base is not None
    (n, samples), base, faults = time.shape, case.base, _Faults(case, number)
    R = base.R * (1.0 + faults.course("resistance"))
    C = 1e-3 * base.C * (1.0 + faults.course("compliance"))
    gain = 1e-3 * base.gain * (1.0 + faults.course("gain"))
    p = rest.astype(float).copy()
    trapped = faults.value("trapped_gas", "pressure") * (0.7 + 0.6 * faults.random[:, 2])
    volume = (rest + trapped) * C
    u_in, history, clock = np.zeros((n, samples)), [p.copy()], [np.zeros(n)]
    arrives = np.full((n, samples), -1)
    acting, newest = np.zeros(n), np.full(n, -1)
    size = (max(case.breaths, int(number.max()) + 1), samples)
    fate = np.random.default_rng((case.choice, 2)).uniform(size=size)[number]
    for k in range(samples):
        u_in[:, k] = command(k, history[-1])
        slow = fate[:, k] < faults.value("late_commands", "share")
        late = np.where(slow, faults.value("late_commands", "delay"), 0.0)
        arrives[:, k] = k * _STEPS + np.round(late / case.interval * _STEPS).astype(int)
        arrives[fate[:, k] < faults.value("lost_commands", "share"), k] = -1
        if k == samples - 1:
            break
        h = (time[:, k + 1] - time[:, k]) / _STEPS
        for s in range(_STEPS):
            for j in range(max(0, k - 6), k + 1):
                come = (arrives[:, j] == k * _STEPS + s) & (j > newest)
                acting, newest = np.where(come, u_in[:, j], acting), np.where(come, j, newest)
            now = time[:, k] + (s + 1) * h
            p, volume = _step(
                faults, p, volume, h, now, gain * _moved(faults, acting), u_out[:, k], R, C
            )
            history.append(p + _swing(faults, (p - volume / C) / R, now))
            clock.append(now)
    return u_in, _log(faults, np.array(clock).T, np.array(history).T, time)


def _moved(faults: _Faults, u: Floats) -> Floats:
    """Position of a valve that moves in whole steps, %."""
    rounding: Effect | None = faults.effects.get("command_rounding")
    if rounding is None:
        return u
    steps = u / rounding.parameters["step"]
    whole = np.floor(steps + 1e-9) if rounding.form == "truncation" else np.round(steps)
    return whole * rounding.parameters["step"]


def _phase(faults: _Faults, name: str, now: Floats) -> Floats:
    """Angle of an oscillation that goes on between breaths."""
    rate = 2.0 * np.pi * faults.value(name, "frequency")
    return rate * (now + _PERIOD * faults.number + 0.3 * faults.random[:, 3])


def _swing(faults: _Faults, flow: Floats, now: Floats) -> Floats | float:
    """Pressure of water that swings in the tube while gas flows, cmH2O."""
    if "circuit_water" not in faults.effects:
        return 0.0
    size = faults.value("circuit_water", "amplitude") * np.tanh(np.abs(flow) / _SWINGS)
    return size * np.sin(_phase(faults, "circuit_water", now))


def _step(
    faults: _Faults,
    p: Floats,
    volume: Floats,
    h: Floats,
    now: Floats,
    q: Floats,
    out: NDArray[np.int8],
    R: Floats,
    C: Floats,
) -> tuple[Floats, Floats]:
    """Pressure of the circuit and volume of the lung after an implicit step of ``h``, s."""
    base, tubing = faults.case.base, 1e-3 * faults.case.tubing
    assert base is not None
    if "supply_ripple" in faults.effects:
        angle = _phase(faults, "supply_ripple", now)
        q = q * (1.0 + faults.value("supply_ripple", "amplitude") * np.sin(angle))
    if "secretions" in faults.chosen:
        rattle = 1.0 + _DEPTH * np.sign(np.sin(2.0 * np.pi * _RATTLE * now))
        more = faults.value("secretions", "increase") * rattle
        R = R * np.where(faults.within("secretions", now), 1.0 + more, 1.0)
    push: Floats | float = 0.0
    if "cough" in faults.chosen:
        begins = 0.3 + 1.2 * faults.random[:, 0]
        x = np.clip((now - begins) / (0.15 + 0.15 * faults.random[:, 1]), 0.0, 1.0)
        shape = np.where(x < 0.3, x / 0.3, (1.0 - x) / 0.7)
        push = faults.value("cough", "pressure") * shape * faults.within("cough", now)
    size = faults.value("intermittent_leak", "conductance")
    orifice = size * faults.within("intermittent_leak", now)
    orifice = orifice + _OPEN_TUBE * faults.within("disconnection", now)
    # Conductances at the pressure before: a leak to the room, an outlet to PEEP, a relief valve.
    leak = 1e-3 * orifice / np.sqrt(np.maximum(np.abs(p), _LEAST))
    outlet = np.where((out == 1) & (p > base.peep), 1.0 / base.R_ex, 0.0)
    opening = faults.value("relief_leak", "opening")
    relief = 1e-3 * faults.value("relief_leak", "conductance") * (p > opening)
    inner = 1.0 / (R + h / C)
    inside = volume / C + push
    total = tubing / h + inner + leak + outlet + relief
    source = tubing / h * p + q + inner * inside + outlet * base.peep + relief * opening
    after = source / total
    return after, volume + h * inner * (after - inside)


def _log(faults: _Faults, clock: Floats, history: Floats, time: Floats) -> Floats:
    """Readings at the times of the log, whose clock may be another one, cmH2O."""
    at = time - faults.value("clock_offset", "offset")
    at = at / (1.0 + faults.value("clock_skew", "skew"))
    seen = np.array([np.interp(t, c, p) for t, c, p in zip(at, clock, history, strict=True)])
    return seen + faults.course("zero")[:, None]
