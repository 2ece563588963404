"""Recordings of the second generator: controller, clock, sensor, and what a laboratory spoils."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import Case
from proofs.challenge.questions import coloured_noise, held_levels, logged, parameter
from proofs.challenge.stranger.effects import StrangerCase
from proofs.challenge.stranger.rig import Rig
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.recordings.breaths import Breaths

#: Takes the number of a sample, what the sensors show and which breaths are due, ``(n,)``; returns
#: their readings and commands.
Command = Callable[[int, Floats, Bools], tuple[Floats, Floats]]

#: Step of the integration of recordings and of noise-free replays, s.
STEP, REPLAY_STEP = 1e-4, 1e-3

#: Pressure at which the ventilator shuts its valve, cmH2O.
_RELIEF = 55.0

#: Pressure that the resistance of the airway may take at the ventilator's largest command, cmH2O.
_FLOW_LIMIT = 45.0

#: Size of an outlier, in standard deviations of the noise.
_OUTLIER = (8.0, 40.0)

#: Share of breaths in which a patient tries to breathe, and the scatter of these efforts.
_EFFORTS, _EFFORT_SCATTER = 0.8, 0.3


def record(
    case: Case, rng: np.random.Generator, *, steps: int | None = None, share: float = 1.0
) -> Breaths:
    """Record a case.

    Args:
        case: a case of this generator.
        rng: source of everything that varies.
        steps: integration steps between two samples; as many as make up :data:`STEP` if None.
        share: scales target pressures above PEEP and explored commands.
    """
    assert isinstance(case, StrangerCase)
    assert case.base is not None
    n, samples, peep = case.breaths, case.samples, case.base.peep
    ticks = case.interval * np.arange(samples) + np.concatenate(
        [np.zeros((n, 1)), case.jitter * rng.standard_normal((n, samples - 1))], axis=1
    )
    time = np.maximum.accumulate(ticks + 1e-7 * np.arange(samples), axis=1)
    u_out = (time >= case.inspiration).astype(np.int8)
    explores = rng.uniform(size=n) < case.explored
    target = peep + share * rng.uniform(8.0, 28.0, n)
    rise = rng.uniform(0.0, 0.25, n)
    proportional = np.exp(rng.uniform(np.log(0.2), np.log(case.proportional), n))
    integral = np.exp(rng.uniform(np.log(2.0), np.log(20.0), n))
    pulses = _explored(case, rng, time, share)
    noise = coloured_noise(case, case.correlation, rng, (n, samples))
    summed = np.zeros(n)
    most = min(100.0, _FLOW_LIMIT / (case.base.R * case.base.gain * 1e-3))

    def command(k: int, shown: Floats, due: Bools) -> tuple[Floats, Floats]:
        """Reading and command at sample k, for the breaths that are due."""
        nonlocal summed
        measured = shown + noise[:, k]
        if case.step > 0:
            measured = case.step * np.round(measured / case.step)
        now = time[:, k]
        wanted = peep + (target - peep) * np.clip((now + 0.03) / (rise + 0.03), 0.0, 1.0)
        error = wanted - measured
        ahead = np.clip(summed + integral * case.interval * error, 0.0, 100.0)
        asked = proportional * error + ahead
        # No winding up while the command is at an end.
        summed = np.where(due & (asked > 0.0) & (asked < 100.0), ahead, summed)
        u = np.where(explores, pulses[:, k], asked)
        u = np.where((measured > _RELIEF) | (u_out[:, k] == 1), 0.0, u)
        return measured, np.clip(
            np.round(np.minimum(u, most) / case.log_step) * case.log_step, 0, 100
        )

    step = STEP if steps is None else case.interval / steps
    pressure, u_in = _run(case, rng, time, u_out, command, np.arange(n), step)
    wrong = rng.uniform(size=pressure.shape) < case.outliers
    size = case.noise * rng.uniform(*_OUTLIER, pressure.shape)
    sign = rng.choice(np.array([-1.0, 1.0]), pressure.shape)
    pressure = np.where(wrong, pressure + sign * size, pressure)
    blank = rng.uniform(size=pressure.shape) < case.missing
    blank[:, 0] = False
    pressure = np.where(blank, np.nan, pressure)
    clock = time
    if case.clock_step > 0:
        clock = np.round(time / case.clock_step) * case.clock_step
    return logged(case, np.arange(n), np.round(clock, 6), np.round(u_in, 6), u_out, pressure)


def replay(case: Case, breaths: Breaths, start: Floats, seed: int) -> Floats:
    """Pressures without noise under recorded commands, cmH2O, ``(n, T)``.

    Args:
        case: a case of this generator with its base.
        breaths: commands and times.
        start: airway pressure at rest, ``(n,)``.
        seed: seed of efforts and phases.
    """
    assert isinstance(case, StrangerCase)
    quiet = replace(case, gain_scatter=0.0)
    return _run(
        quiet,
        np.random.default_rng(seed),
        breaths.time,
        breaths.u_out,
        lambda k, shown, due: (shown, breaths.u_in[:, k]),
        breaths.breath_id - 1,
        REPLAY_STEP,
        start,
    )[0]


def _run(
    case: StrangerCase,
    rng: np.random.Generator,
    time: Floats,
    u_out: NDArray[np.int8],
    command: Command,
    number: Ints,
    step: float,
    start: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Simulate breaths side by side; returns what ``command`` returns at each sample, ``(n, T)``.

    The breaths have clocks of their own: at each step of the integration, every breath whose next
    sample has come is sampled.
    """
    assert case.base is not None
    n, samples = time.shape
    effects = {effect.name: effect for effect in case.effects}
    # The same breath has the same random numbers, however often it is asked for.
    alike, which = np.unique(number, return_inverse=True)
    m = len(alike)
    onset, size = rng.uniform(0.0, 0.5, m), np.zeros(m)
    if "patient_effort" in effects:
        acts = rng.uniform(size=m) < _EFFORTS
        scatter = np.clip(1.0 + _EFFORT_SCATTER * rng.standard_normal(m), 0.3, 1.8)
        size = np.where(acts, parameter(effects, "patient_effort", "amplitude") * scatter, 0.0)
    rig = Rig(
        case.base,
        effects,
        number / max(case.breaths - 1, 1),
        case.dead_space,
        rng.uniform(0.0, 2.0 * np.pi, m)[which],
        np.stack([size, onset])[:, which],
    )
    gains = 1.0 + case.gain_scatter * rng.standard_normal(m)[which]
    spread = 0.2 * rng.standard_normal(m)[which]
    rig.start(case.base.peep + spread if start is None else start)
    delay = parameter(effects, "valve_delay", "delay")
    late = effects.get("exhalation_valve_delay")
    opening = late.parameters["opening"] if late is not None and late.form != "slow opening" else 0
    pressure, u_in = np.zeros((n, samples)), np.zeros((n, samples))
    asked = np.zeros((n, samples))
    # Steps at which samples are taken and at which commands reach the valves.
    sampled = np.round(time / step).astype(int)
    reaches = np.round((time + delay) / step).astype(int)
    late_opening = np.round((time + opening) / step).astype(int)
    count = int(sampled.max())
    at_sample = _events(sampled, count)
    at_valve, at_opening = _events(reaches, count), _events(late_opening, count)
    acting, out_now, out_before = np.zeros(n), np.zeros(n), np.zeros(n)
    for i in range(count + 1):
        for column, breaths in at_sample.get(i, ()):
            due = np.zeros(n, bool)
            due[breaths] = True
            seen, wanted = command(column, rig.shown(), due)
            pressure[due, column], u_in[due, column] = seen[due], wanted[due]
            asked[due, column] = rig.steady_command(wanted, due)[due]
            out_now[due] = u_out[due, column]
        for column, breaths in at_valve.get(i, ()):
            acting[breaths] = gains[breaths] * asked[breaths, column]
        for column, breaths in at_opening.get(i, ()):
            out_before[breaths] = u_out[breaths, column]
        rig.advance(acting, out_now * out_before, (i + 1) * step, step)
    return pressure, u_in


def _events(at: Ints, count: int) -> dict[int, list[tuple[int, Ints]]]:
    """Samples by the step at which they take place, each with its breaths; ``at`` is ``(n, T)``."""
    events: dict[int, list[tuple[int, Ints]]] = {}
    for column in range(at.shape[1]):
        for step in np.unique(at[:, column]):
            if step <= count:
                breaths = np.flatnonzero(at[:, column] == step)
                events.setdefault(int(step), []).append((column, breaths))
    return events


def _explored(case: StrangerCase, rng: np.random.Generator, time: Floats, share: float) -> Floats:
    """Commands of exploring breaths: levels of random lengths around what the lung takes, %."""
    assert case.base is not None
    # At this flow the lung fills by 20 cmH2O in the time, and its resistance takes 20 at most.
    base = case.base
    flow = min(20.0 * base.C * 1e-3 / case.inspiration, 20.0 / base.R) / (base.gain * 1e-3)
    levels = held_levels(time, case.inspiration, rng, 0.25, 2.0)
    return np.clip(share * flow * levels, 0.0, 100.0)
