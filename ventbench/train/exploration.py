"""Breaths to learn a simulator from: a safe PID with the paper's disturbances, on any ventilator.

Paper, section 4.2 and its table. A *boundary* disturbance falls linearly to zero from the start of
the breath. A *triangular* one rises linearly from zero at a first time and falls back to zero at a
second one. Where the paper's text ends at "t_min", t_max is meant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.base.files import data_beside
from ventbench.controllers.pid import TIME_CONSTANT
from ventbench.recordings import Breaths, make_breaths
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics.score import safety_limit

Range = tuple[float, float]


@dataclass(frozen=True)
class ExplorationRanges:
    """Exploration of one lung."""

    gains: tuple[float, float, float]  #: P, I, D of the PID, %/cmH2O.
    boundary_u: Range  #: what is added at the start of a breath, %.
    boundary_s: Range  #: time in which the boundary disturbance falls to zero, s.
    triangular_u: Range  #: the largest of what is added, %.
    triangular_s: Range = (0.1, 0.5)  #: start and end of the triangular disturbance, s.
    boundary_share: float = 0.25  #: share of breaths with the boundary disturbance.


#: The paper's table, by lung id.
RANGES = msgspec.convert(data_beside(__file__, "exploration.toml"), dict[str, ExplorationRanges])


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Disturbances of n breaths; every array has shape ``(n,)``."""

    boundary: Bools  #: whether it is a boundary disturbance; else a triangular one.
    u: Floats  #: the largest of what is added, %.
    begin: Floats  #: start of the disturbance, s; 0 for a boundary.
    end: Floats  #: end of the disturbance, s.

    def at(self, time: float) -> Floats:
        """Disturbance at a time of the breath, s, added to the PID's command, %, ``(n,)``."""
        width = self.end - self.begin
        falling = (self.end - time) / width
        rising = (time - self.begin) / width
        tent = 2.0 * np.minimum(rising, falling)
        return self.u * np.clip(np.where(self.boundary, falling, tent), 0.0, 1.0)


def draw_disturbances(
    random: np.random.Generator, ranges: ExplorationRanges, n: int
) -> Disturbance:
    """Draw n disturbances; a triangular one lies between two times drawn from its range."""
    boundary = random.random(n) < ranges.boundary_share
    u = np.where(
        boundary, random.uniform(*ranges.boundary_u, n), random.uniform(*ranges.triangular_u, n)
    )
    ends = np.sort(random.uniform(*ranges.triangular_s, (n, 2)), axis=1)
    ends[:, 1] = np.maximum(ends[:, 1], ends[:, 0] + 1e-3)  # never of no width
    fall = random.uniform(*ranges.boundary_s, n)
    return Disturbance(
        boundary, u, np.where(boundary, 0.0, ends[:, 0]), np.where(boundary, fall, ends[:, 1])
    )


#: Pressure above which the expiratory valve opens for the rest of the inspiration, as it does where
#: a pressure is not a number, cmH2O; and breaths that ended so, after which exploring stops.
_VENT, _VENTED_BREATHS = protocol.SAFETY_PRESSURE, 3


class VentilatorInterface(Protocol):
    """A ventilator, real or simulated, or several side by side."""

    width: int  #: number of lungs side by side; 1 for a real ventilator.
    dt: float  #: control step, s.

    def start(self, peep: float) -> Floats:
        """Bring the lungs to rest at PEEP, cmH2O; returns measured pressures, ``(width,)``."""
        ...

    def step(self, u_in: Floats, u_out: Floats) -> Floats:
        """Hold commands, % and 0/1, for a step; returns the pressures then, ``(width,)``."""
        ...


class SimulatedVentilator:
    """A plant as a ventilator.

    Args:
        plant: plant of one lung.
        width: breaths side by side.
        noise: standard deviation of the sensor's noise, cmH2O.
        seed: seed of the noise.
    """

    def __init__(self, plant: Plant, width: int, *, noise: float = 0.0, seed: int = 0) -> None:
        self.width, self.dt = width, protocol.DT
        self._plant, self._noise = plant, noise
        self._random = np.random.default_rng(seed)
        self._step = jax.jit(lambda plant, *rest: plant.step(*rest))
        self._state: Any = None

    def start(self, peep: float) -> Floats:
        """Lungs at rest."""
        pressure = jnp.full(self.width, peep)
        self._state, signals = self._plant.init(pressure)
        return self._measured(signals.reading)

    def step(self, u_in: Floats, u_out: Floats) -> Floats:
        """One control step."""
        commands = (jnp.asarray(u_in, jnp.float32), jnp.asarray(u_out, jnp.float32))
        dt = jnp.full(self.width, self.dt)
        self._state, signals = self._step(self._plant, self._state, *commands, dt)
        return self._measured(signals.reading)

    def _measured(self, pressure: Any) -> Floats:
        return np.asarray(pressure, float) + self._noise * self._random.standard_normal(self.width)


def explore(
    ventilator: VentilatorInterface,
    lung_id: str,
    breaths: int,
    *,
    seed: int = 0,
    ranges: ExplorationRanges | None = None,
    ease: float = protocol.SAFETY_PRESSURE,
    pips: tuple[float, ...] = protocol.PIPS,
    progress: Callable[[int, int], object] = lambda explored, total: None,
) -> Breaths:
    """Explore a ventilator; the PIPs take turns.

    Args:
        ventilator: see :class:`VentilatorInterface`.
        lung_id: the setting of its lung, written with the breaths.
        breaths: number of breaths.
        seed: seed of all disturbances, which are the same for the same seed and width.
        ranges: the paper's for that lung if not given.
        ease: the valve closes while the measured pressure is above ``min(60, PIP + 15)`` or this,
            cmH2O.
        pips: cmH2O.
        progress: called with how many breaths are done, and how many were asked for.

    Returns:
        Whole breaths; fewer than asked for, with a note, where too many were vented.

    Raises:
        InputError: if there are no ranges for the lung, or not one breath was asked for.
    """
    if ranges is None and lung_id not in RANGES:
        raise InputError(f"no ranges to explore {lung_id} in; they exist for {', '.join(RANGES)}")
    if breaths < 1:
        raise InputError(f"{breaths} breaths to explore: ask for one at least")
    setting, ranges = parse_lung(lung_id), ranges or RANGES[lung_id]
    random = np.random.default_rng(seed)
    columns: list[tuple[Floats, Floats, Floats]] = []
    explored = vented = 0
    while explored < breaths and vented < _VENTED_BREATHS:
        pip = np.array([pips[(explored + k) % len(pips)] for k in range(ventilator.width)])
        added = draw_disturbances(random, ranges, ventilator.width)
        recorded = _breaths(ventilator, pip, ranges, ease, added)
        columns.append(recorded)
        explored += ventilator.width
        progress(min(explored, breaths), breaths)
        vented += int(np.sum(recorded[1][:, : protocol.INSPIRATION_STEPS].any(axis=1)))
    together = zip(*columns, strict=True)
    u_in, u_out, pressure = (np.concatenate(column)[:breaths] for column in together)
    n = len(u_in)
    time = np.tile(ventilator.dt * np.arange(protocol.BREATH_STEPS), (n, 1))
    recorded = make_breaths(
        np.arange(n) + 1, np.full(n, setting.R), np.full(n, setting.C), time, u_in, u_out, pressure
    )
    if vented < _VENTED_BREATHS:
        return recorded
    note = f"exploring stopped: {vented} breaths were vented, above {_VENT:g} cmH2O"
    return replace(recorded, notes=(note,))


def _breaths(
    ventilator: VentilatorInterface,
    pip: Floats,
    ranges: ExplorationRanges,
    ease: float,
    added: Disturbance,
) -> tuple[Floats, Floats, Floats]:
    """One breath on each lung of the ventilator: u_in, u_out and pressure, ``(width, steps)``."""
    gate = np.minimum(safety_limit(pip), ease)
    vented = np.zeros(ventilator.width, bool)
    before = integral = derivative = np.zeros(ventilator.width)
    a = ventilator.dt / (ventilator.dt + TIME_CONSTANT)
    P, I, D = ranges.gains  # noqa: E741
    pressure, rows = ventilator.start(protocol.PEEP), []
    for step in range(protocol.BREATH_STEPS):
        if step < protocol.INSPIRATION_STEPS:
            # A sensor that gives no number must not poison the averages; it vents, see below.
            error = pip - np.where(np.isfinite(pressure), pressure, pip)
            integral = integral + a * (error - integral)
            derivative = derivative + a * (error - before - derivative)
            before = error
            requested = P * error + I * integral + D * derivative + added.at(step * ventilator.dt)
            # "Not below" instead of "above", so that a sensor that gives no number is unsafe.
            vented |= ~(pressure <= _VENT)
            closed = vented | ~(pressure <= gate)
            u_in = np.where(closed, 0.0, np.clip(requested, 0.0, protocol.U_MAX))
            u_out = vented.astype(float)
        else:
            u_in = np.full(ventilator.width, float(waveform.expiratory_command(step)))
            u_out = np.ones(ventilator.width)
        rows.append((u_in, u_out, pressure))
        pressure = ventilator.step(u_in, u_out)
    u_in, u_out, pressure = (np.stack(column, axis=1) for column in zip(*rows, strict=True))
    return u_in, u_out, pressure
