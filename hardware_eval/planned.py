"""A controller that a simulator plans: feedforward commands, and feedback where the lung departs.

A simulator says which commands bring the pressure to its target and keep it there, and which
pressures they give. The controller sends these commands, and a PI controller answers the difference
between measured and planned pressure (two degrees of freedom: Horowitz, *Synthesis of Feedback
Systems*, 1963). It is as good as its simulator: commands planned without a leak are too small for a
lung that leaks, and feedback corrects that late. So it shows what a better simulator is worth. A
PID tuned on it hardly does, as its gains serve many lungs.

**Feedforward.** Commands of least error, by sequential linear programming
(:mod:`ventbench.task.attainable`). What is planned is the reading of the sensor, which is all
that a bench measures and scores. And it is planned for the second breath of a run and those after
it, which a bench scores: a slow lung has not emptied since the breath before.

**Feedback.** The gains of least mean error over lungs whose resistance or compliance departs from
the simulator, and a valve a step late, with the commands planned for the simulator.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from hardware_eval.emulation.simulated import breath_begun
from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.controllers.pid import TIME_CONSTANT
from ventbench.entries.scaffold import contents
from ventbench.task import attainable as bound
from ventbench.task import environment as env
from ventbench.task import protocol, rollouts
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Observation, Plant, Signals

#: Steps that the starts of the search open the valve for: a short and a long rise.
STARTS = (2, 8)

#: Breaths before the one that is planned: by then the breaths of the slowest lung (R20C50, 1.25 s)
#: differ by less than a twentieth of what is left in it.
BREATHS = 2

#: Proportional and integral gains among which feedback is chosen, %/cmH2O.
P_GAINS, I_GAINS = (0.0, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0), (0.0, 1.0, 2.0, 5.0, 10.0)

#: What feedback must cope with: factors of resistance and compliance, delay of the command, steps.
#: A simulator fitted to a recording of the lung is nearer than these.
DEPARTURES = (
    (1.0, 1.0, 0.0),
    (0.8, 1.0, 0.0),
    (1.25, 1.0, 0.0),
    (1.0, 0.8, 0.0),
    (1.0, 1.25, 0.0),
    (1.0, 1.0, 1.0),
)

#: The controller of an entry, before its numbers.
_CONTROLLER = '''"""Commands planned on a simulator, and feedback where the lung departs from it."""

STEP = {step}  # s
TIME_CONSTANT = {time_constant}  # s, of the averaged difference
GAINS = {gains}  # P and I, %/cmH2O

# Each row: PIP, cmH2O; planned commands, %; pressures that they should give, cmH2O.
PLAN = (
{rows}
)


def between(pip, column, step):
    """Value of the plan at a PIP: linear between two rows, that of the nearest beyond."""
    below = max((row for row in PLAN if row[0] <= pip), default=PLAN[0])
    above = min((row for row in PLAN if row[0] >= pip), default=PLAN[-1])
    share = 0.0 if below is above else (pip - below[0]) / (above[0] - below[0])
    return (1.0 - share) * below[column][step] + share * above[column][step]


class Controller:
    """One for each run of three breaths."""

    def reset(self, task):
        """Nothing to prepare."""

    def act(self, observation):
        """Return u_in, %, for the next step."""
        if observation.time == 0:  # a new breath
            self.integral = 0.0
        step = min(round(observation.time / STEP), len(PLAN[0][1]) - 1)
        missing = between(observation.target, 2, step) - observation.pressure
        a = observation.dt / (observation.dt + TIME_CONSTANT)
        self.integral += a * (missing - self.integral)
        p, i = GAINS
        return between(observation.target, 1, step) + p * missing + i * self.integral
'''


@dataclass(frozen=True, eq=False)
class PlannedController:
    """Feedforward of N PIPs over the T steps of an inspiration, and gains of the feedback."""

    pips: tuple[float, ...]  #: cmH2O, rising, N of them.
    commands: Floats  #: planned, %, shape ``(N, T)``.
    #: that the simulator gives under them, one before each command, cmH2O, shape ``(N, T)``.
    pressures: Floats
    gains: tuple[float, float]  #: P and I of the feedback, %/cmH2O.
    error: float  #: mean ``|pressure - PIP|`` on the simulator, cmH2O.

    def write(self, folder: Path, name: str) -> Path:
        """Write it as a submission ``folder/name``; returns that folder."""
        rows = [
            f"    ({pip}, {_numbers(commands)},\n     {_numbers(pressures)}),"
            for pip, commands, pressures in zip(
                self.pips, self.commands, self.pressures, strict=True
            )
        ]
        controller = _CONTROLLER.format(
            step=protocol.DT, time_constant=TIME_CONSTANT, gains=self.gains, rows="\n".join(rows)
        )
        made = contents(name, "other") | {"controller.py": controller.encode()}
        (folder / name).mkdir(parents=True, exist_ok=True)
        for file, content in made.items():
            (folder / name / file).write_bytes(content)
        return folder / name


def _numbers(values: Floats) -> str:
    return f"({', '.join(f'{value:.3f}' for value in values)})"


@flax.struct.dataclass
class _Breathing:
    """A plant at the end of an expiration, whose airway pressure is the reading of its sensor."""

    plant: Any  #: the plant.
    state: Any  #: of the plant when an inspiration begins, with the batch axes of the plant.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[Any, Signals]:
        return self.state, Signals(pressure)

    def step(self, state: Any, u_in: Array, u_out: Array, dt: Array) -> tuple[Any, Signals]:
        state, signals = self.plant.step(state, u_in, u_out, dt)
        return state, Signals(signals.reading)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> _Breathing:
        return _Breathing(self.plant.vary(r_scale, c_scale, gain), self.state)

    def parameters(self) -> Any:
        return self.plant.parameters()


def plan_controller(plant: Plant, pips: tuple[float, ...]) -> PlannedController:
    """Plan a controller on a simulator.

    Args:
        plant: the simulator of a lung, without a batch shape.
        pips: cmH2O, rising; commands of a PIP between two are interpolated.

    Raises:
        ValueError: if the PIPs do not rise.
    """
    if not pips or any(b <= a for a, b in itertools.pairwise(pips)):
        raise ValueError(f"PIPs {pips} cmH2O must rise")
    n = len(pips)
    with compilation.float64():
        cells = env.nominal_scenario(np.asarray(pips))
        cells = cells.replace(noise=np.zeros((n, 1, 1)))  # type: ignore[attr-defined]
        wide = jax.tree.map(lambda leaf: np.asarray(leaf, float), plant)
        stacked = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (n, *np.shape(leaf))), wide)
        state, _ = jax.vmap(type(plant).init)(stacked, cells.start, cells.peep)
        for turn in range(1 + BREATHS):
            breathing = _Breathing(stacked, state)
            best = bound.attainable(breathing, cells, starts=STARTS)
            after = bound.pressures(breathing, cells, best.commands)
            # The last command of an inspiration acts on no scored pressure: it stays.
            commands = np.concatenate([best.commands, best.commands[:, -1:]], axis=1)
            pressures = np.concatenate([np.asarray(cells.start)[:, None], after], axis=1)
            if turn < BREATHS:
                state, start = _breath_after(breathing, cells, commands)
                cells = cells.replace(start=start)  # type: ignore[attr-defined]
        gains = np.array(list(itertools.product(P_GAINS, I_GAINS)))
        departing = _departing(pips, np.asarray(cells.start), np.array(DEPARTURES))
        error = np.asarray(_errors(wide, state, departing, commands, pressures, gains))
    # An error that is not finite is that of a loop that has blown up.
    mean = np.where(np.isfinite(error), error, np.inf).mean(axis=(1, 2))
    chosen = int(np.argmin(mean))
    P, I = (float(gain) for gain in gains[chosen])  # noqa: E741 - the field's names
    return PlannedController(pips, commands, pressures, (P, I), float(error[chosen, 0].mean()))


@jax.jit
@jax.vmap
def _breath_after(plant: _Breathing, cell: Scenario, commands: Array) -> tuple[Any, Array]:
    """State and reading after a breath, when the next inspiration begins."""
    loop, _, _ = rollouts.inspiration(plant, cell, rollouts.commanded, inputs=commands)
    loop, _ = rollouts.expiration(plant, cell, loop)
    return breath_begun(loop.plant, jnp.ones(())), loop.signals.reading


def _departing(pips: tuple[float, ...], start: Floats, departures: Floats) -> Scenario:
    """Cells of each departure and PIP, shape ``(len(departures), len(pips))``."""
    shape = (len(departures), len(pips))
    cells = env.nominal_scenario(np.broadcast_to(np.asarray(pips), shape))
    r_scale, c_scale, delay = (
        jnp.asarray(np.broadcast_to(column[:, None], shape)) for column in departures.T
    )
    return cells.replace(  # type: ignore[attr-defined]
        start=jnp.broadcast_to(start, shape), r_scale=r_scale, c_scale=c_scale, delay=delay
    )


@jax.jit
def _errors(
    plant: Any, state: Any, cells: Scenario, commands: Array, pressures: Array, gains: Array
) -> Array:
    """Errors of an inspiration, cmH2O, shape ``(gains, departures, pips)``."""
    share = protocol.DT / (protocol.DT + TIME_CONSTANT)

    def error(gain: Array, cell: Scenario, state: Any, commands: Array, pressures: Array) -> Array:
        varied = env.vary(_Breathing(plant, state), cell, 0)

        def feedback(integral: Array, seen: Observation, planned: Any) -> tuple[Array, Array]:
            command, pressure = planned
            missing = pressure - seen.pressure
            integral = integral + share * (missing - integral)
            return integral, command + gain[0] * missing + gain[1] * integral

        _, _, off = rollouts.inspiration(
            varied, cell, feedback, jnp.zeros_like(cell.start), inputs=(commands, pressures),
            record=lambda before, *_: jnp.abs(before.signals.reading - cell.pip),
        )  # fmt: skip
        return off.mean(axis=0)

    of_pips = jax.vmap(error, (None, 0, 0, 0, 0))
    of_departures = jax.vmap(of_pips, (None, 0, None, None, None))
    return jax.vmap(of_departures, (0, None, None, None, None))(
        gains, cells, state, commands, pressures
    )
