"""A case on its rig, recorded as a laboratory would: commands, sampling, integration, simulation.

The commands of a breath are closed loop or exploration, with the ventilator's bias flow in
expiration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import NOMINAL_GAIN, Base, Case, draw_base
from proofs.challenge.first.circuit import READING, Circuit, Disturbances
from proofs.challenge.first.instruments import Sensor, Valve
from proofs.challenge.questions import logged, parameter
from ventbench.base.arrays import Floats, Ints
from ventbench.recordings.breaths import Breaths

#: Takes the number of a sample and its reading, cmH2O, ``(n,)``; returns commands, %, not clipped.
Command = Callable[[int, Floats], Floats]

#: Means of the sampling interval that a breath may have, s.
INTERVALS = (0.0319, 0.0340)

#: Integration steps between two samples: about half a millisecond each, with half steps.
STEPS = 64

#: Integration steps where gas has mass, whose pressure responds within milliseconds.
FINE = 160

#: Shortest integration step, s.
_SHORTEST_STEP = 1e-6

#: From one breath's first sample to the next one's, s.
_PERIOD = 3.0


@dataclass(frozen=True)
class StepGrid:
    """Integration steps of n breaths."""

    nodes: Floats  #: ends of the steps, s, ``(n, steps + 1)``.
    #: index of the command that the valve follows in a step, -1 before the first, ``(n, steps)``.
    command: Ints
    opened: Floats  #: 1 in the steps with an open expiratory valve, ``(n, steps)``.


def sampling_times(n: int, samples: int, jitter: float, rng: np.random.Generator) -> Floats:
    """Draw sampling times, s, ``(n, samples)``: a mean interval for each breath, and jitter."""
    mean = rng.choice(np.array(INTERVALS), n)[:, None]
    dt = np.clip(mean + jitter * rng.standard_normal((n, samples - 1)), 0.5 * mean, 1.5 * mean)
    time = np.concatenate([np.zeros((n, 1)), np.cumsum(dt, axis=1)], axis=1)
    return np.round(time, 6)


def step_grid(
    time: Floats, u_out: NDArray[np.int8], delay: float, opening_delay: float, steps: int
) -> StepGrid:
    """Divide the time between samples into steps whose ends include the delayed commands.

    Args:
        time: times of the samples, s, ``(n, T)``.
        u_out: command of the expiratory valve, ``(n, T)``.
        delay: dead time of the inspiratory valve, s.
        opening_delay: dead time of the expiratory valve's opening, s.
        steps: number of steps between two samples.
    """
    n = len(time)
    share = np.arange(steps) / steps
    inner = time[:, :-1, None] + share * np.diff(time, axis=1)[:, :, None]
    nodes = np.concatenate([inner.reshape(n, -1), time[:, -1:]], axis=1)
    command = np.empty((n, nodes.shape[1] - 1), np.int64)
    opened = np.empty(command.shape)
    for i in range(n):
        delays = np.array([d for d in (delay, opening_delay) if d])
        _move_onto_edges(nodes[i], np.sort((time[i] + delays[:, None]).ravel()), steps)
        middle = 0.5 * (nodes[i, 1:] + nodes[i, :-1])
        command[i] = np.searchsorted(time[i] + delay, middle) - 1
        now = np.searchsorted(time[i], middle) - 1
        then = np.searchsorted(time[i] + opening_delay, middle) - 1
        opened[i] = u_out[i, now] & np.where(then < 0, 0, u_out[i, then])
    return StepGrid(nodes, command, opened)


def _move_onto_edges(nodes: Floats, edges: Floats, steps: int) -> None:
    """Move an end of a step onto each edge, in order; the samples keep their times."""
    free = 1
    for edge in edges[edges < nodes[-1] - 1e-5]:
        above = int(np.searchsorted(nodes, edge))
        nearest = above - 1 if edge - nodes[above - 1] < nodes[above] - edge else above
        if nearest % steps == 0:
            nearest += 1 if edge >= nodes[nearest] else -1
        nearest = max(nearest, free)
        nearest += nearest % steps == 0  # pushed on by the edge before
        if nearest >= len(nodes) - 1:
            break  # no step is left before the last sample
        nodes[nearest] = np.clip(
            edge, nodes[nearest - 1] + _SHORTEST_STEP, nodes[nearest + 1] - _SHORTEST_STEP
        )
        free = nearest + 1


def record(
    case: Case, rng: np.random.Generator, *, steps: int | None = None, share: float = 1.0
) -> Breaths:
    """Record a case, closed loop and explored; the labels are the lung setting's.

    Args:
        case: what is in it.
        rng: source of times, gains, noise and efforts, and of the rig if the case has none.
        steps: integration steps between two samples; as many as the effects need if None.
        share: scales pressures above PEEP and commands; 1 for the usual ones.
    """
    base = case.base or draw_base(case.lung_R, case.lung_C, rng)
    time = sampling_times(case.breaths, case.samples, case.jitter, rng)
    command = recording_controller(case, time, rng, share)
    u_out = (time >= INSPIRATION).astype(np.int8)
    return _run(case, base, time, u_out, command, np.arange(len(time)), rng, steps)


def replay(case: Case, breaths: Breaths, start: Floats, seed: int, steps: int = 8) -> Floats:
    """Pressures without noise or converter under recorded commands, cmH2O, ``(n, T)``.

    Args:
        case: case with its base.
        breaths: commands and times.
        start: airway pressure at rest, ``(n,)``.
        seed: seed of efforts and phases.
        steps: integration steps between two samples.
    """
    assert case.base is not None
    clean = replace(case, noise=0.0, step=0.0, samples=breaths.time.shape[1])
    return _run(
        clean,
        case.base,
        breaths.time,
        breaths.u_out,
        lambda k, p: breaths.u_in[:, k],
        breaths.breath_id - 1,
        np.random.default_rng(seed),
        steps,
        start,
    ).pressure


def _run(
    case: Case,
    base: Base,
    time: Floats,
    u_out: NDArray[np.int8],
    command: Command,
    number: Ints,
    rng: np.random.Generator,
    steps: int | None = None,
    start: Floats | None = None,
) -> Breaths:
    """Simulate breaths side by side; ``number``: place of each in the recording, from 0."""
    n, samples = time.shape
    effects = {effect.name: effect for effect in case.effects}
    steps = steps or (FINE if "inertance" in effects else STEPS)
    alike, which = np.unique(number, return_inverse=True)
    began = _PERIOD * number + rng.uniform(-0.05, 0.05, len(alike))[which]
    circuit = Circuit(effects, base, Disturbances(effects, began, rng))
    valve = Valve(effects, base.gain, n)
    sensor = Sensor(case, effects, number / max(case.breaths - 1, 1), rng)
    delay = parameter(effects, "valve_delay", "delay")
    opening_delay = parameter(effects, "exhalation_valve_delay", "opening")
    grid = step_grid(time, u_out, delay, opening_delay, steps)
    spread = 0.3 * rng.standard_normal(n)
    state = circuit.start(base.peep + spread if start is None else start)
    asked = np.zeros((n, samples + 1))  # the last column: the valve is closed before the breath
    u_in, pressure = np.zeros((n, samples)), np.zeros((n, samples))
    rows = np.arange(n)
    lengths = np.diff(grid.nodes, axis=1)
    for k in range(samples):
        pressure[:, k] = sensor.read(k, state[READING])
        wanted = np.clip(command(k, pressure[:, k]), 0.0, 100.0)
        u_in[:, k] = np.round(np.round(wanted / case.log_step) * case.log_step, 6)
        asked[:, k] = valve.flow(u_in[:, k])
        if k == samples - 1:
            break
        for s in range(k * steps, (k + 1) * steps):
            flow = asked[rows, grid.command[:, s]]
            state = circuit.step(state, lengths[:, s], flow, grid.opened[:, s], grid.nodes[:, s])
    return logged(case, number, time, u_in, u_out, pressure)


#: The paper's grid of gains.
_GRID = np.concatenate([np.arange(1, 10) / 10.0, np.arange(1, 11)])

#: Largest loop gain, cmH2O at the next sample per cmH2O of error; a higher one rings.
_LARGEST_LOOP_GAIN = 1.3

#: The valve closes above this pressure, cmH2O.
_HIGHEST = 45.0

#: Typical PEEP of a rig, cmH2O.
_PEEP = 5.0

#: Share of the error that enters the integral at each sample: 32 ms of a memory of 0.5 s.
_INTEGRAL_SHARE = 0.06

#: End of inspiration, s.
INSPIRATION = 1.0


def recording_controller(
    case: Case, time: Floats, rng: np.random.Generator, share: float = 1.0
) -> Command:
    """PI control to a target; some breaths add a disturbance, others follow a programme.

    Args:
        case: case whose breaths are recorded.
        time: times of the samples, s, ``(n, T)``.
        rng: source of gains, targets and programmes.
        share: scales pressures above PEEP and commands; 1 for the usual ones.
    """
    n = len(time)
    # cmH2O at the next sample per %: by resistance, and by the volume of 32 ms of flow.
    jump = 1e-3 * NOMINAL_GAIN * (case.lung_R + 32.0 / case.lung_C)
    highest = max(_LARGEST_LOOP_GAIN / jump, 0.5)
    proportional = rng.choice(_GRID[np.less_equal(_GRID, highest)], n)
    integral = rng.choice(_GRID, n)
    target = share * rng.uniform(10.0, 35.0, n) + (1.0 - share) * _PEEP
    summed = np.zeros(n)
    explores = (rng.uniform(size=n) < 0.5) & (case.style == "mixed")
    programmed = explores & (rng.uniform(size=n) < 0.5)
    added = share * _disturbance(case, time, rng)
    added = np.where((explores & ~programmed)[:, None], added, 0.0)
    programme = np.where(programmed[:, None], share * _programme(case, time, rng), np.nan)
    kind = rng.integers(0, 3, n)
    bias = np.where(explores, np.where(kind == 0, 0.0, rng.uniform(0.0, 6.0, n)), 5.0)

    def command(k: int, measured: Floats) -> Floats:
        nonlocal summed
        t = time[:, k]
        error = target - measured
        summed = summed + _INTEGRAL_SHARE * (error - summed)
        closed = proportional * error + integral * summed + added[:, k]
        inspired = np.where(np.isnan(programme[:, k]), closed, programme[:, k])
        inspired = np.where(measured > _HIGHEST, 0.0, inspired)
        risen = -np.expm1(-np.maximum(t - 1.5, 0.0) * 5.0)
        return np.where(t < INSPIRATION, inspired, bias * np.where(explores, 1.0, risen))

    return command


def _steady_command(case: Case, pressure: float | Floats) -> float | Floats:
    """Constant command, %, that raises the airway by ``pressure``, cmH2O, within inspiration."""
    return pressure / (0.0228 * case.lung_R + 22.8 / case.lung_C)


def _disturbance(case: Case, time: Floats, rng: np.random.Generator) -> Floats:
    """Additions to the command, %, ``(n, T)``: a falling ramp from the start, or a triangle."""
    n = len(time)
    size = 2.0 * _steady_command(case, rng.uniform(5.0, 25.0, (n, 1)))
    length = rng.uniform(0.3, 0.8, n)[:, None]
    ramp = size * np.maximum(1.0 - time / length, 0.0)
    first, last = rng.uniform(0.1, 0.4, n)[:, None], rng.uniform(0.5, 0.9, n)[:, None]
    up = np.maximum(1.0 - np.abs(2.0 * (time - first) / (last - first) - 1.0), 0.0)
    sign = np.where(rng.uniform(size=n) < 0.3, -0.5, 1.0)[:, None]
    return np.where(rng.uniform(size=(n, 1)) < 0.4, ramp, sign * size * up)


def _programme(case: Case, time: Floats, rng: np.random.Generator) -> Floats:
    """Commands without a loop, %, ``(n, T)``: pieces of 2 to 8 samples, level or sloping."""
    rows = []
    for t in time:
        mean = _steady_command(case, rng.uniform(8.0, 28.0))
        at = np.cumsum(np.concatenate([[0], rng.integers(2, 9, 40)]))
        levels = mean * rng.uniform(0.0, 2.0, len(at)) * (rng.uniform(size=len(at)) < 0.85)
        k = np.arange(len(t))
        steps = levels[np.searchsorted(at, k, side="right") - 1]
        rows.append(np.interp(k, at, levels) if rng.uniform() < 0.4 else steps)
    return np.array(rows)
