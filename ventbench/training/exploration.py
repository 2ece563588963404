"""Breaths to learn a simulator from: a safe PID, disturbed as in the paper, on any plant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import protocol
from ventbench.controllers import expiratory
from ventbench.controllers.pid import TIME_CONSTANT
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.lungs import lung as parse_lung
from ventbench.metrics.safety import limit
from ventbench.recordings import Breaths, make_breaths
from ventbench.training.disturbances import RANGES, Disturbance, Ranges, draw

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """When exploring gives way.

    Attributes:
        ease: the valve closes while the measured pressure is above ``min(60, PIP + 15)`` cmH2O or
            this, cmH2O.
        vent: above this, or where a pressure is not a number, the expiratory valve opens for the
            rest of the inspiration, cmH2O.
        vented: breaths that ended so, after which exploring stops.
    """

    ease: float = protocol.SAFETY_PRESSURE
    vent: float = protocol.SAFETY_PRESSURE
    vented: int = 3


class Bench(Protocol):
    """What can be explored, ``width`` lungs side by side; a ventilator has one.

    Attributes:
        width: how many.
        dt: control step, s.
    """

    width: int
    dt: float

    def start(self, peep: float) -> Floats:
        """Bring the lungs to rest at PEEP, cmH2O; returns measured pressures, ``(width,)``."""
        ...

    def step(self, u_in: Floats, u_out: Floats) -> Floats:
        """Hold commands, % and 0/1, for a step; returns the pressures then, ``(width,)``."""
        ...


class PlantBench:
    """A plant as a bench.

    Args:
        plant: one lung.
        width: breaths side by side.
        noise: standard deviation of the sensor's noise, cmH2O.
        seed: of the noise.
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
        self._state = self._plant.init(pressure)
        return self._measured(pressure)

    def step(self, u_in: Floats, u_out: Floats) -> Floats:
        """One control step."""
        commands = (jnp.asarray(u_in, jnp.float32), jnp.asarray(u_out, jnp.float32))
        dt = jnp.full(self.width, self.dt)
        self._state, pressure = self._step(self._plant, self._state, *commands, dt)
        return self._measured(pressure)

    def _measured(self, pressure: Any) -> Floats:
        return np.asarray(pressure, float) + self._noise * self._random.standard_normal(self.width)


def explore(
    bench: Bench,
    lung_id: str,
    breaths: int,
    *,
    seed: int = 0,
    ranges: Ranges | None = None,
    limits: Limits | None = None,
    pips: tuple[float, ...] = protocol.PIPS,
    peep: float = protocol.PEEP,
) -> Breaths:
    """Explore a bench; the PIPs take turns.

    Args:
        bench: see :class:`Bench`.
        lung_id: the setting of its lung, written with the breaths.
        breaths: how many.
        seed: of all disturbances; the same ones for the same seed and width.
        ranges: the paper's for that lung if not given.
        limits: see :class:`Limits`.
        pips: cmH2O.
        peep: cmH2O.

    Returns:
        Whole breaths; fewer than asked for, with a note, where the limits ended it.

    Raises:
        InputError: if there are no ranges for the lung, or not one breath was asked for.
    """
    if ranges is None and lung_id not in RANGES:
        raise InputError(f"no ranges to explore {lung_id} in; they exist for {', '.join(RANGES)}")
    if breaths < 1:
        raise InputError(f"{breaths} breaths to explore: ask for one at least")
    setting, ranges, limits = parse_lung(lung_id), ranges or RANGES[lung_id], limits or Limits()
    random = np.random.default_rng(seed)
    columns: list[tuple[Floats, Floats, Floats]] = []
    done = vented = 0
    while done < breaths and vented < limits.vented:
        pip = np.array([pips[(done + k) % len(pips)] for k in range(bench.width)])
        added = draw(random, ranges, bench.width)
        found = _breaths(bench, pip, peep, ranges, limits, added)
        columns.append(found)
        done += bench.width
        vented += int(np.sum(found[1][:, : protocol.INSPIRATION_STEPS].any(axis=1)))
    together = zip(*columns, strict=True)
    u_in, u_out, pressure = (np.concatenate(column)[:breaths] for column in together)
    n = len(u_in)
    time = np.tile(bench.dt * np.arange(protocol.BREATH_STEPS), (n, 1))
    made = make_breaths(
        np.arange(n) + 1, np.full(n, setting.R), np.full(n, setting.C), time, u_in, u_out, pressure
    )
    if vented < limits.vented:
        return made
    note = f"exploring stopped: {vented} breaths were vented, above {limits.vent:g} cmH2O"
    return replace(made, notes=(note,))


def _breaths(
    bench: Bench, pip: Floats, peep: float, ranges: Ranges, limits: Limits, added: Disturbance
) -> tuple[Floats, Floats, Floats]:
    """One breath on each lung of the bench: u_in, u_out and pressure, ``(width, steps)``."""
    ease = np.minimum(limit(pip), limits.ease)
    vented = np.zeros(bench.width, bool)
    before = integral = derivative = np.zeros(bench.width)
    a = bench.dt / (bench.dt + TIME_CONSTANT)
    P, I, D = ranges.gains  # noqa: E741
    pressure, rows = bench.start(peep), []
    for step in range(protocol.BREATH_STEPS):
        if step < protocol.INSPIRATION_STEPS:
            # A sensor that gives no number must not poison the averages; it vents, see below.
            error = pip - np.where(np.isfinite(pressure), pressure, pip)
            integral = integral + a * (error - integral)
            derivative = derivative + a * (error - before - derivative)
            before = error
            wanted = P * error + I * integral + D * derivative + added.at(step * bench.dt)
            # "Not below" instead of "above", so that a sensor that gives no number is unsafe.
            vented |= ~(pressure <= limits.vent)
            closed = vented | ~(pressure <= ease)
            u_in = np.where(closed, 0.0, np.clip(wanted, 0.0, protocol.U_MAX))
            u_out = vented.astype(float)
        else:
            u_in = np.full(bench.width, float(expiratory.u_in(step)))
            u_out = np.ones(bench.width)
        rows.append((u_in, u_out, pressure))
        pressure = bench.step(u_in, u_out)
    u_in, u_out, pressure = (np.stack(column, axis=1) for column in zip(*rows, strict=True))
    return u_in, u_out, pressure
