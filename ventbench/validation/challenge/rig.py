"""A case on its rig: what a laboratory would have recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.validation.challenge.cases import Base, Case
from ventbench.validation.challenge.clock import FINE, STEPS, clock, sampling
from ventbench.validation.challenge.control import Controller, expiratory
from ventbench.validation.challenge.network import READING, Network
from ventbench.validation.challenge.sensor import Sensor
from ventbench.validation.challenge.sources import Sources
from ventbench.validation.challenge.valve import Floats, Valve

#: From one breath's first sample to the next one's, s.
_PERIOD = 3.0


def draw_base(lung_R: float, lung_C: float, rng: np.random.Generator) -> Base:
    """Draw a rig around a lung's label: R off by up to 15 %, C by up to 7 %, and the rest."""
    return Base(
        R=float(lung_R * rng.uniform(0.85, 1.15)),
        C=float(lung_C * rng.uniform(0.93, 1.07)),
        R_ex=float(rng.uniform(4.0, 7.0)),
        peep=float(rng.uniform(4.5, 5.5)),
        gain=float(22.8 * rng.uniform(0.9, 1.1)),
    )


def record(
    case: Case, rng: np.random.Generator, *, steps: int | None = None, share: float = 1.0
) -> Breaths:
    """Record a case, closed loop and explored; the labels are the lung setting's.

    Args:
        case: what is in it.
        rng: what times, gains, noise and efforts are drawn from, and the rig if the case has none.
        steps: of the integration between two samples; as many as it needs if None.
        share: of the usual pressures above PEEP and commands.
    """
    base = case.base or draw_base(case.lung_R, case.lung_C, rng)
    time = sampling(case.breaths, case.samples, case.jitter, rng)
    controller = Controller(case, time, rng, share)
    return _run(case, base, time, expiratory(time), controller, np.arange(len(time)), rng, steps)


class _Given:
    """Commands that are known beforehand."""

    def __init__(self, u_in: Floats) -> None:
        self._u_in = u_in

    def command(self, k: int, measured: Floats) -> Floats:
        return self._u_in[:, k]


def record_commands(
    case: Case, time: Floats, u_in: Floats, u_out: NDArray[np.int8],
    rng: np.random.Generator,
) -> Breaths:  # fmt: skip
    """Record given commands on the case's rig, open loop, after the case's own breaths.

    Args:
        case: with its base.
        time: of the samples, s, ``(k, T)``.
        u_in: %, ``(k, T)``.
        u_out: 0/1, ``(k, T)``.
        rng: of noise and efforts.

    Raises:
        InputError: if the case has no base, which would be another rig.
    """
    if case.base is None:
        raise InputError(f"{case.name}: the rig of this case is not known")
    sized = replace(case, samples=time.shape[1])
    return _run(
        sized, case.base, time, u_out, _Given(u_in), case.breaths + np.arange(len(time)), rng
    )


def replay(case: Case, breaths: Breaths, start: Floats, seed: int, steps: int = 8) -> Floats:
    """Pressures without noise or converter under recorded commands, cmH2O, ``(n, T)``.

    Args:
        case: with its base.
        breaths: commands and times.
        start: airway pressure at rest, ``(n,)``.
        seed: of efforts and phases.
        steps: of the integration between two samples.
    """
    assert case.base is not None
    clean = replace(case, noise=0.0, step=0.0, samples=breaths.time.shape[1])
    given, rng = _Given(breaths.u_in), np.random.default_rng(seed)
    made = _run(
        clean,
        case.base,
        breaths.time,
        breaths.u_out,
        given,
        breaths.breath_id - 1,
        rng,
        steps,
        start,
    )
    return made.pressure


def _run(
    case: Case, base: Base, time: Floats, u_out: NDArray[np.int8], controller: Controller | _Given,
    number: NDArray[np.int64], rng: np.random.Generator, steps: int | None = None,
    start: Floats | None = None,
) -> Breaths:  # fmt: skip
    n, samples = time.shape
    effects = {item.name: item for item in case.effects}
    steps = steps or (FINE if "inertance" in effects else STEPS)
    began = _PERIOD * number + rng.uniform(-0.05, 0.05, n)
    network = Network(effects, base, Sources(effects, began, rng))
    valve = Valve(effects, base.gain, n)
    sensor = Sensor(case, effects, number / max(case.breaths - 1, 1), rng)
    delay = effects["valve_delay"].parameters["delay"] if "valve_delay" in effects else 0.0
    late = effects.get("exhalation_valve_delay")
    grid = clock(time, u_out, delay, late.parameters["opening"] if late else 0.0, steps)
    spread = 0.3 * rng.standard_normal(n)
    state = network.start(base.peep + spread if start is None else start)
    asked = np.zeros((n, samples + 1))  # the last column is the closed valve before the breath
    u_in, pressure = np.zeros((n, samples)), np.zeros((n, samples))
    rows = np.arange(n)
    lengths = np.diff(grid.nodes, axis=1)
    for k in range(samples):
        pressure[:, k] = sensor.read(k, state[READING])
        wanted = np.clip(controller.command(k, pressure[:, k]), 0.0, 100.0)
        u_in[:, k] = np.round(np.round(wanted / case.log_step) * case.log_step, 6)
        asked[:, k] = valve.flow(u_in[:, k])
        if k == samples - 1:
            break
        for s in range(k * steps, (k + 1) * steps):
            flow = asked[rows, grid.command[:, s]]
            state = network.step(state, lengths[:, s], flow, grid.opened[:, s], grid.nodes[:, s])
    return Breaths(
        breath_id=number + 1,
        R=np.full(n, case.lung_R), C=np.full(n, case.lung_C),
        time=time, dt=np.diff(time, axis=1, append=2 * time[:, -1:] - time[:, -2:-1]),
        u_in=u_in, u_out=u_out.astype(np.int8), pressure=np.round(pressure, 6),
        valid=np.ones((n, samples), bool), time_inferred=np.zeros(n, bool),
    )  # fmt: skip
