"""A made-up diagnosis of breaths whose valve answers late, without any fit: plain numpy."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np

from ventbench.base import compilation
from ventbench.diagnosis.findings import (
    BreathRequest,
    MissingMechanism,
    NonparametricTerm,
    OpenLoopComparison,
    OpenLoopError,
    Traces,
)
from ventbench.diagnosis.residual_analysis import locate
from ventbench.diagnosis.result import Diagnosis
from ventbench.mechanics.labels import Estimate, LungMatch
from ventbench.physics import physics
from ventbench.recordings.breaths import Breaths
from ventbench.task.lungs import lung

NOISE, GAIN, R_EX, PEEP, FINE = 0.2, 22.8, 5.0, 5.0, 32


def commands(n: int, samples: int, seed: int) -> tuple[np.ndarray, ...]:
    """Valves and times of breaths of 1 s inspiration; ``(n, T)`` each."""
    rng = np.random.default_rng(seed)
    dt = 0.032 + rng.uniform(-0.0005, 0.0015, (n, samples))
    time = np.concatenate([np.zeros((n, 1)), np.cumsum(dt[:, :-1], axis=1)], axis=1)
    dt[:, -1] = dt[:, -2]
    u_out = (time > 1.0).astype(np.int8)
    peak, hold = rng.uniform(25.0, 60.0, (n, 1)), rng.uniform(2.0, 9.0, (n, 1))
    start = rng.integers(0, 8, (n, 1))  # samples until the valve opens
    since = np.maximum(np.arange(samples) - start, 0)
    u_in = np.where(since > 0, hold + (peak - hold) * np.exp(-since / 6.0), 0.0)
    return np.where(u_out == 1, 0.0, u_in), u_out, time, dt


def answer(
    u_in: np.ndarray, u_out: np.ndarray, dt: np.ndarray, R: float, C: float, delay: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pressure, flow (mL/s) and volume (mL) of an R-C lung whose inspiratory valve is late."""
    n, samples = u_in.shape
    h = dt[:, :, None] / FINE * np.ones(FINE)
    at = (np.cumsum(h.reshape(n, -1), axis=1) - 0.5 * h.reshape(n, -1)).reshape(h.shape)
    edges = np.concatenate([np.zeros((n, 1)), np.cumsum(dt, axis=1)], axis=1)
    which = np.array([np.searchsorted(edges[b], at[b] - delay, side="right") - 1 for b in range(n)])
    delayed = u_in[np.arange(n)[:, None, None], np.maximum(which, 0)]
    inflows = GAIN * np.where(which < 0, 0.0, delayed) / 1000.0  # L/s
    pressure, flow = np.full((n, samples), PEEP), np.zeros((n, samples))
    volume, now = np.zeros((n, samples)), np.zeros(n)
    for i in range(samples - 1):
        p, q = pressure[:, i], flow[:, i]
        for k in range(FINE):
            inflow = inflows[:, i, k]
            recoil = PEEP + now / C
            shut = u_out[:, i] == 0
            # The expiratory valve lies between the airway and PEEP.
            opened = (recoil / R + PEEP / R_EX + inflow) / (1.0 / R + 1.0 / R_EX)
            p = np.where(shut, recoil + R * inflow, opened)
            q = 1000.0 * (p - recoil) / R
            now = now + q * h[:, i, k]
        pressure[:, i + 1], flow[:, i + 1], volume[:, i + 1] = p, q, now
    return pressure, flow, volume


@cache
def breaths(
    label: str = "R20C50", n: int = 40, delay: float = 0.04, seed: int = 0, samples: int = 70
) -> Breaths:
    """Recorded breaths of a lung a little off its label, with noise."""
    about, rng = lung(label), np.random.default_rng(seed + 1)
    u_in, u_out, time, dt = commands(n, samples, seed)
    pressure = answer(u_in, u_out, dt, 1.1 * about.R, 0.95 * about.C, delay)[0]
    pressure = pressure + NOISE * rng.standard_normal(pressure.shape)
    valid = np.ones(u_in.shape, bool)
    R, C = np.full(n, about.R), np.full(n, about.C)
    return Breaths(
        np.arange(1, n + 1), R, C, time, dt, u_in, u_out, pressure, valid, np.zeros(n, bool)
    )


@cache
def diagnosis(n: int = 40) -> Diagnosis:
    """What a diagnosis of :func:`breaths` could be."""
    recorded = breaths(n=n)
    about = lung("R20C50")
    inputs = (recorded.u_in, np.asarray(recorded.u_out), recorded.dt)
    before = answer(*inputs, about.R, about.C)[0]
    refit, flow, volume = answer(*inputs, 1.04 * about.R, 0.97 * about.C)
    after = answer(*inputs, 1.1 * about.R, 0.95 * about.C, 0.04)[0]
    held = np.arange(n) % 3 == 2

    def distance(simulated: np.ndarray, part: np.ndarray | bool = True) -> OpenLoopError:
        inside = recorded.inspiratory & held[:, None] & part
        error = (recorded.pressure - simulated)[inside]
        return OpenLoopError(float(np.abs(error).mean()), float(np.sqrt(np.mean(error**2))))

    def stages(part: np.ndarray | bool) -> dict[str, OpenLoopError]:
        kinds = {"before": before, "refit": refit, "after": after}
        return {name: distance(simulated, part) for name, simulated in kinds.items()}

    with compilation.float64():
        plant = physics(about, {"valve_delay": {"delay": 0.041}}).having(R=22.1, C=47.4)
    u_in, u_out, _, dt = commands(3, 70, 5)
    return Diagnosis(
        verdict="named",
        mechanisms=(
            MissingMechanism(
                name="valve_delay",
                parameters={"delay": Estimate(0.041, "s", (0.038, 0.044))},
                confidence=0.97,
                alternatives=("valve_lag",),
                nats=212.0,
            ),
        ),
        nonparametric=None,
        location=locate(recorded, refit, NOISE, flow, volume),
        open_loop=OpenLoopComparison(
            tuple(recorded.breath_id[held].tolist()),
            *(stages(True)[stage] for stage in ("before", "refit", "after")),
            noise_floor=NOISE,
            groups={
                "first 0.2 s": stages(recorded.time < 0.2),
                "the rest": stages(recorded.time >= 0.2),
            },
        ),
        lungs=(LungMatch("R20C50", 22.1, 47.4, (21.8, 22.4), (47.0, 47.8), False, "pressure"),),
        request=BreathRequest(
            "3 breaths of random pulses of the valve",
            ("valve_delay", "valve_lag"),
            64.0,
            u_in,
            u_out.astype(float),
            dt,
        ),
        traces=Traces(recorded, held, before, refit, after, flow, volume),
        plants={"R20C50": plant},
        simulator="physics",
        noise=(NOISE, 0.1),
        notes=("2 breaths have no pressure and were left out.",),
        seconds=21.4,
    )


def unnamed(n: int = 40) -> Diagnosis:
    """The same, but with a slot instead of a name."""
    x = np.linspace(0.0, 900.0, 25)
    y = 2.0 * np.sin(x / 300.0)
    term = NonparametricTerm(
        "R(V)", "resistance of the airway", 0.83, 41.0, x, "volume, mL", y, "R, cmH2O/(L/s)"
    )
    return dataclasses.replace(
        diagnosis(n), verdict="unnamed", mechanisms=(), nonparametric=term, request=None
    )


def nothing(n: int = 40) -> Diagnosis:
    """The same, but with nothing found."""
    return dataclasses.replace(
        diagnosis(n), verdict="nothing_missing", mechanisms=(), location=(), request=None
    )
