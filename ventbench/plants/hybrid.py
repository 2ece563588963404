"""Lung, circuit and valves of the real rig: physics whose unknown shapes are learned.

What is physics: a lung with flow-dependent resistance and an elastic curve, filled through a valve
with dead time and lag, beside the compliance of the circuit, emptied through the expiratory valve,
read by a sensor with lag. What is learned, pooled over all lung settings: the monotone curve of the
valve, the elastic curve, what a change of direction of the command adds (the valve's driver
switches between an opening and a closing table), and what differs from rig to rig.

A rig is also a vector of unconstrained numbers, so that whatever is drawn from the population of a
lung is a rig: resistances, elastance, delays, lags and slopes are positive, the valve's curve is
monotone, the elastic curve rises, and the plays' weights add up to less than one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.task.draws import uniforms
from ventbench.task.interfaces import Signals

#: Knots of the valve's piecewise linear curve, %; the last segment ends at infinity.
VALVE_KNOTS = (0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 10.0, 14.0, 19.0, 26.0, 36.0, 50.0, 70.0)

#: Knots of the elastic curve, cmH2O of a linear lung, above which its slope may change.
ELASTIC_KNOTS = (10.0, 16.0, 22.0, 28.0, 36.0)

#: Half-widths of the plays that remember the direction of the command, %.
PLAYS = (0.7, 3.0, 10.0)

#: Change of the command at which the sensor's answer to a direction saturates, %.
DIRECTION_WIDTH = 0.4

#: The relief opens here and holds the pressure below the sum, cmH2O. No recording goes above 61.4.
RELIEF, RELIEF_ROOM = 60.0, 10.0

#: Conductance of the relief valve in the reference physics of a rig, mL/s per cmH2O: the fully open
#: valve ends within the room that a rig's own relief leaves.
RELIEF_CONDUCTANCE = 200.0

#: Command at which the basis term ``valve_shape`` holds the valve's gain, %, and those at which it
#: has a coefficient.
_VALVE_AT, _VALVE_SHAPE = 20.0, (1.0, 3.0, 6.0, 12.0, 35.0, 60.0, 100.0)

#: Recoils at which the elastic curve of a rig is compared with that of the library, cmH2O.
_RECOILS = np.linspace(2.0, 40.0, 39)

#: Samples whose commands are remembered; at 10 ms they reach back as far as the longest dead time.
MEMORY = 6

#: Substeps of one sample.
SUBSTEPS = 4


@flax.struct.dataclass
class HybridState:
    """State between two samples; every array has shape ``(...)`` unless it says otherwise."""

    elastic: Array  #: lung volume over linear compliance, ``V / C``, cmH2O.
    drop: Array  #: airway pressure minus elastic recoil, cmH2O.
    sensor: Array  #: pressure that the sensor shows, cmH2O.
    flow: Array  #: flow out of the inspiratory valve, L/s.
    #: flows that the last 7 commands ask for, the latest first, L/s, one array each.
    commanded: tuple[Array, ...]
    #: expiratory valve during the last 7 samples, the latest first, 0/1, one array each.
    opened: tuple[Array, ...]
    #: durations of the last 6 samples, the latest first, s, one array each.
    past: tuple[Array, ...]
    plays: tuple[Array, ...]  #: position of each play, %, one array a play.
    u_in: Array  #: last command, %.
    peep: Array  #: end-expiratory pressure, cmH2O.
    outlet: Array  #: opening of the expiratory valve, 0..1.


@flax.struct.dataclass
class Hybrid:
    """One lung on one rig; every array has shape ``()`` or ``(...)`` unless it says otherwise."""

    R: Array  #: laminar part of the resistance, cmH2O/(L/s).
    K2: Array  #: quadratic part, cmH2O s2/L2: the drop over the airway is ``R Q + K2 Q |Q|``.
    E: Array  #: elastance at low volume, cmH2O/L.
    stiffening: Array  #: change of relative slope of the elastic curve at each knot, ``(..., 5)``.
    offset: Array  #: elastic recoil minus airway pressure at rest, cmH2O.
    slopes: Array  #: slopes of the valve's curve between knots, L/s per %, ``(..., 13)``.
    direction: Array  #: weight of each play in the effective command, ``(..., 3)``.
    valve_delay: Array  #: dead time of the inspiratory valve, s.
    valve_lag: Array  #: time constant of the inspiratory valve, s.
    circuit_compliance: Array  #: compliance of tubing and bellows' dead space, L/cmH2O.
    sensor_lag: Array  #: time constant of the sensor, s.
    rising: Array  #: shift that is added to the reading while the command rises, cmH2O.
    falling: Array  #: shift that is subtracted from the reading while the command falls, cmH2O.
    conductance: Array  #: conductance of the open expiratory valve, L/s per cmH2O.
    #: conductance of the expiratory valve while it closes, L/s per cmH2O.
    closing_conductance: Array
    opening_delay: Array  #: delay of the expiratory valve when it opens, s.
    closing_delay: Array  #: delay of the expiratory valve when it closes, s.
    rest: Array  #: command that held the flow before the first sample, %.
    closing_lag: Array  #: time constant with which the expiratory valve closes after its delay, s.

    def valve(self, u_in: Array) -> Array:
        """Flow that a steady command gives, L/s: monotone in ``u_in``, %."""
        flow = jnp.zeros_like(u_in)
        for index, (knot, after) in enumerate(pairwise((*VALVE_KNOTS, math.inf))):
            covered = jnp.clip(u_in - knot, 0.0, after - knot)
            flow = flow + self.slopes[..., index] * covered
        return flow

    def recoil(self, elastic: Array) -> tuple[Array, Array]:
        """Elastic recoil, cmH2O, and its relative slope, of ``V / C``, cmH2O."""
        pressure, slope = elastic, jnp.ones_like(elastic)
        for index, knot in enumerate(ELASTIC_KNOTS):
            change = self.stiffening[..., index]
            pressure = pressure + change * jnp.maximum(elastic - knot, 0.0)
            slope = slope + change * (elastic > knot)
        return pressure, slope

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[HybridState, Signals]:
        """Lung at the end of an expiration; see :class:`~ventbench.task.interfaces.Plant`.

        The expiratory valve is open and the resting command holds the pressure, as before every
        inspiration on the rig.
        """
        pressure = jnp.asarray(pressure)
        zero = jnp.zeros_like(pressure)
        rest = self.rest + zero
        flow = self.valve(rest)
        state = HybridState(
            elastic=pressure + self.offset,
            drop=zero - self.offset,
            sensor=pressure,
            flow=flow,
            commanded=(flow,) * (MEMORY + 1),
            opened=(zero + 1.0,) * (MEMORY + 1),
            past=(zero + 0.03,) * MEMORY,
            plays=tuple(rest for _ in PLAYS),
            u_in=rest,
            peep=pressure if peep is None else peep + zero,
            outlet=zero + 1.0,
        )
        return state, self._signals(state, pressure)

    def step(
        self, state: HybridState, u_in: Array, u_out: Array, dt: Array
    ) -> tuple[HybridState, Signals]:
        """Hold one command; see :class:`~ventbench.task.interfaces.Plant`.

        Each substep is an exponential step of the drop over the airway, with the airway's
        resistance and the elastic slope of its start.

        What happened before lies in one array a sample, not along an axis of one array: then every
        operation runs over the batch alone, and the compiler makes vector code of it.
        """
        plays = tuple(
            jnp.clip(play, u_in - half, u_in + half)
            for play, half in zip(state.plays, PLAYS, strict=True)
        )
        effective = u_in + sum(
            self.direction[..., i] * (play - u_in) for i, play in enumerate(plays)
        )
        commanded = (self.valve(jnp.maximum(effective, 0.0)), *state.commanded)
        opened = (u_out + jnp.zeros_like(state.u_in), *state.opened)
        # Behind the expiratory valve stands what makes the resting flow hold PEEP.
        conductance = u_out * self.conductance + (1.0 - u_out) * self.closing_conductance
        behind = state.peep - self.valve(self.rest) / conductance
        elastic, drop, sensor, flow = state.elastic, state.drop, state.sensor, state.flow
        opening = state.outlet
        h = dt / SUBSTEPS
        lag, smooth = jnp.exp(-h / self.valve_lag), jnp.exp(-h / self.sensor_lag)
        open_or_close = u_out * self.opening_delay + (1.0 - u_out) * self.closing_delay
        targets = _delayed(commanded, state.past, self.valve_delay, h)
        wides = _delayed(opened, state.past, open_or_close, h)
        for target, wide in zip(targets, wides, strict=True):
            inflow = target + (flow - target) * self.valve_lag / h * (1.0 - lag)  # mean over h
            flow = target + (flow - target) * lag
            # It opens with a spring and closes against the pressure.
            opening = jnp.maximum(wide, opening * jnp.exp(-h / self.closing_lag))
            outlet = conductance * opening
            elastic, drop, pressure = self._fill(elastic, drop, inflow, outlet, behind, h)
            sensor = pressure + (sensor - pressure) * smooth
        change = (u_in - state.u_in) / DIRECTION_WIDTH
        reading = sensor + (1.0 - u_out) * (
            self.rising * jnp.tanh(jnp.maximum(change, 0.0))
            + self.falling * jnp.tanh(jnp.minimum(change, 0.0))
        )
        after = HybridState(
            elastic,
            drop,
            sensor,
            flow,
            commanded[:-1],
            opened[:-1],
            (dt + 0.0 * drop, *state.past[:-1]),
            plays,
            u_in,
            state.peep,
            opening,
        )
        return after, self._signals(after, reading)

    def _signals(self, state: HybridState, reading: Array) -> Signals:
        """Signals of a state; the reading lags, and shifts while the command changes direction."""
        resistance = 0.5 * (self.R + jnp.sqrt(self.R**2 + 4.0 * self.K2 * jnp.abs(state.drop)))
        airway = self.recoil(state.elastic)[0] + state.drop
        flow, volume = 1000.0 * state.drop / resistance, 1000.0 * state.elastic / self.E
        return Signals(reading, airway, flow, volume)

    def _fill(
        self, elastic: Array, drop: Array, inflow: Array, outlet: Array, behind: Array, h: Array
    ) -> tuple[Array, Array, Array]:
        """One substep of circuit and lung; returns elastic, drop and airway pressure."""
        recoil, slope = self.recoil(elastic)
        # Q from drop = R Q + K2 Q |Q|; 1e-6 keeps the derivative finite at rest.
        resistance = 0.5 * (self.R + jnp.sqrt(self.R**2 + 4.0 * self.K2 * (jnp.abs(drop) + 1e-6)))
        rate = (1.0 / self.circuit_compliance + self.E * slope) / resistance
        rate = rate + outlet / self.circuit_compliance
        goal = (inflow - outlet * (recoil - behind)) / self.circuit_compliance / rate
        decay = jnp.exp(-rate * h)
        mean = goal + (drop - goal) * (1.0 - decay) / (rate * h)
        elastic = elastic + self.E * mean / resistance * h
        recoil, _ = self.recoil(elastic)
        pressure = recoil + goal + (drop - goal) * decay
        excess = jnp.maximum(pressure - RELIEF, 0.0)
        pressure = pressure - excess + RELIEF_ROOM * (1.0 - jnp.exp(-excess / RELIEF_ROOM))
        return elastic, pressure - recoil, pressure

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Hybrid:
        """Return the same rig with another resistance and compliance, and gain of the valve."""
        return self.replace(  # type: ignore[attr-defined]
            R=self.R * r_scale,
            K2=self.K2 * r_scale,
            E=self.E / c_scale,
            slopes=self.slopes * jnp.asarray(gain)[..., None],
        )

    def parameters(self) -> dict[str, Array]:
        """Read off the rig; the valve's curve is exact at the knots of the basis term."""
        knots = np.asarray(VALVE_KNOTS)

        def valve(u_in: float) -> Array:
            return self.slopes @ np.clip(u_in - knots, 0.0, np.append(np.diff(knots), np.inf))

        gain = valve(_VALVE_AT) / _VALVE_AT
        # Least squares of the recoil's departure from a line by the first term of its series.
        above = np.maximum(_RECOILS[:, None] - np.asarray(ELASTIC_KNOTS), 0.0)
        departure = self.stiffening @ above.T
        squares = 0.5 * _RECOILS**2
        ones = 1.0 + 0.0 * self.R
        return {
            "R": self.R,
            "C": 1e3 / self.E,
            "gain": 1e3 * gain,
            "R_ex": 1.0 / self.closing_conductance,
            "rest": self.rest,
            "offset": self.offset,
            "turbulent_resistance.quadratic": self.K2,
            "nonlinear_compliance.stiffening": departure @ squares / (squares @ squares),
            "valve_delay.delay": self.valve_delay,
            "valve_lag.tau": self.valve_lag,
            "circuit_compliance.compliance": 1e3 * self.circuit_compliance,
            "sensor_lag.tau": self.sensor_lag,
            "exhalation_valve_closing.closing": self.closing_delay,
            "relief_valve.conductance": RELIEF_CONDUCTANCE * ones,
            "relief_valve.opening": RELIEF * ones,
            **{f"valve_shape.c{k}": valve(u) / gain - u for k, u in enumerate(_VALVE_SHAPE, 1)},
        }


def _delayed(
    held: tuple[Array, ...], past: tuple[Array, ...], delay: Array, h: Array
) -> list[Array]:
    """Means of a command, delayed by so many s, over each of the substeps ``h`` s of a sample.

    ``held`` are the commands of this sample and of those before, the latest first, of which the
    last holds for all earlier time; ``past`` the durations of the samples before, s.
    """
    # From each change of the command to the start of the sample, delayed, in substeps.
    changes, before = [later - sooner for sooner, later in pairwise(held)], delay
    ends = [before / h]
    for duration in past:
        before = before - duration
        ends.append(before / h)
    means = []
    for k in range(SUBSTEPS):
        mean = held[0]
        for change, end in zip(changes, ends, strict=True):
            mean = mean + change * jnp.clip(end - k, 0.0, 1.0)
        means.append(mean)
    return means


#: Command at which the flow of a valve is its size, %.
SIZE_AT = 20.0

#: Flow at which a resistance is compared, L/s.
FLOW = 0.5

#: The plays' weights add up to less than this.
DIRECTION_SUM = 0.98

#: Significant digits of a drawn rig: fewer than those in which mathematical libraries differ.
DIGITS = 6

_LOGARITHMS = (
    "valve_delay",
    "valve_lag",
    "circuit_compliance",
    "sensor_lag",
    "rising",
    "falling",
    "conductance",
    "closing_conductance",
    "opening_delay",
    "closing_delay",
    "closing_lag",
    "rest",
)

#: What the lung decides: resistance at :data:`FLOW`, share of its quadratic part, elastance, offset
#: and elastic curve. All other numbers are the ventilator's.
LUNG = (
    *("resistance", "turbulence", "elastance", "offset"),
    *(f"stiffening_{k}" for k in range(len(ELASTIC_KNOTS))),
)

#: Names of the numbers of a rig, in order.
NAMES = (
    *LUNG,
    "valve_size",
    *(f"valve_bend_{k}" for k in range(1, len(VALVE_KNOTS))),
    *(f"direction_{k}" for k in range(len(PLAYS))),
    *_LOGARITHMS,
)

_KNOTS, _PLAYS, _BENDS = len(ELASTIC_KNOTS), len(PLAYS), len(VALVE_KNOTS) - 1
_WIDTHS = np.clip(SIZE_AT - np.array(VALVE_KNOTS), 0.0, np.diff(np.append(VALVE_KNOTS, np.inf)))


def to_vector(plant: Hybrid) -> Floats:
    """Numbers of rigs.

    Args:
        plant: leaves ``(...)``.

    Returns:
        Shape ``(..., len(NAMES))``, in the order of :data:`NAMES`: logarithms, but for the offset
        (cmH2O), the change of the logarithmic slope at each elastic knot and from each segment of
        the valve's curve to the next, and the logarithmic odds of the plays' weights.
    """
    leaf = {name: np.asarray(value, float) for name, value in vars(plant).items()}
    slope = 1.0 + np.cumsum(leaf["stiffening"], axis=-1)
    weight = -leaf["direction"]
    odds = weight / (DIRECTION_SUM - weight.sum(axis=-1, keepdims=True))
    columns = [
        np.log(leaf["R"] + FLOW * leaf["K2"]),
        np.log(FLOW * leaf["K2"] / leaf["R"]),
        np.log(leaf["E"]),
        leaf["offset"],
        *np.moveaxis(np.diff(np.log(slope), axis=-1, prepend=0.0), -1, 0),
        np.log(leaf["slopes"] @ _WIDTHS),
        *np.moveaxis(np.diff(np.log(leaf["slopes"]), axis=-1), -1, 0),
        *np.moveaxis(np.log(odds), -1, 0),
        *(np.log(leaf[name]) for name in _LOGARITHMS),
    ]
    return np.stack(columns, axis=-1)


def from_vector(vector: Any, xp: Any = jnp) -> Hybrid:
    """Rigs of numbers: the inverse of :func:`to_vector`.

    Args:
        vector: shape ``(..., len(NAMES))``.
        xp: ``jax.numpy``, which can be differentiated, or ``numpy``.
    """
    resistance, turbulence, elastance, offset = (vector[..., k] for k in range(4))
    at = 4
    slope = xp.exp(xp.cumsum(vector[..., at : at + _KNOTS], axis=-1))
    at += _KNOTS
    size, bends = vector[..., at], vector[..., at + 1 : at + 1 + _BENDS]
    at += 1 + _BENDS
    shape = xp.exp(
        xp.concatenate([xp.zeros_like(bends[..., :1]), xp.cumsum(bends, axis=-1)], axis=-1)
    )
    odds = xp.exp(vector[..., at : at + _PLAYS])
    at += _PLAYS
    laminar = xp.exp(resistance) / (1.0 + xp.exp(turbulence))
    return Hybrid(
        R=laminar,
        K2=laminar * xp.exp(turbulence) / FLOW,
        E=xp.exp(elastance),
        stiffening=xp.diff(slope, axis=-1, prepend=xp.ones_like(slope[..., :1])),
        offset=offset,
        slopes=shape * (xp.exp(size) / (shape * _WIDTHS).sum(axis=-1))[..., None],
        direction=-DIRECTION_SUM * odds / (1.0 + odds.sum(axis=-1, keepdims=True)),
        **{name: xp.exp(vector[..., at + k]) for k, name in enumerate(_LOGARITHMS)},
    )


@dataclass(frozen=True, eq=False)
class RigPopulation:
    """Populations of the rigs of L lungs."""

    mean: Floats  #: shape ``(L, p)``.
    factor: Floats  #: lower triangular factor of the covariance of a new rig, shape ``(L, p, p)``.

    def rigs(self, seed: bytes, lung: int, count: int) -> Hybrid:
        """Draw rigs of a lung, by its index and a seed of 32 bytes; the same everywhere.

        Numpy leaves ``(count, ...)`` of :data:`DIGITS` significant digits; more begin alike.
        """
        numbers = uniforms(seed, f"population 1, lung {lung}", (count, len(NAMES)))
        normal = np.round(np.vectorize(NormalDist().inv_cdf, otypes=[float])(numbers), 4)
        vector = self.mean[lung] + (self.factor[lung] @ normal[..., None])[..., 0]
        rigs = from_vector(vector, np)
        return jax.tree.map(_rounded, rigs)


def _rounded(value: Floats) -> Floats:
    """Round to :data:`DIGITS` significant digits."""
    exponent = np.floor(np.log10(np.maximum(np.abs(value), 1e-300))).astype(int)
    scale = 10.0 ** np.abs(DIGITS - 1 - exponent)
    up = exponent <= DIGITS - 1
    return np.where(up, np.round(value * scale) / scale, np.round(value / scale) * scale)


def load_population(path: Path) -> RigPopulation:
    """Read the means and factors of a population, an ``.npz`` that a release wrote.

    Raises:
        InputError: if it is missing or is no population of such rigs.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            population = RigPopulation(arrays["mean"], arrays["factor"])
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a population of rigs: {error}") from error
    if population.mean.shape[1:] != (len(NAMES),):
        raise InputError(
            f"{path} holds rigs of {population.mean.shape[1:]} numbers, not {len(NAMES)}"
        )
    return population
