"""Is the effect of the command's direction physics, or pressure read from the commands?

In the public recordings a PI controller computed the commands from the measured pressure. A model
could reconstruct the pressure from the commands; its open-loop error would then be better than its
physics. The benchmark fits the hybrid with and without the effect of the command's direction,
evaluates it on held-out breaths, and does so twice: for the real recordings, and for breaths
simulated *without* the effect under the same kind of PI controller, with sensor noise and valve
gains that differ from breath to breath. If the effect only reconstructed the pressure, the fit
would also find it in the simulated breaths. Usage:

    python benchmarks/direction_leak.py [--recordings DIR] [--folds 5] [--json FILE]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import precision
from ventbench.files import write_json
from ventbench.plants import frozen
from ventbench.plants.sessions import Sessions
from ventbench.recordings import Breaths, recordings_dir
from ventbench.training.hybrid.data import inspirations
from ventbench.training.hybrid.fit import HybridConfig, fit, mean_absolute_errors, training_set
from ventbench.training.hybrid.parameters import direction
from ventbench.training.simulator import TrainingRecordings, load_recordings

#: Simulated breaths: sensor noise, cmH2O; relative spread of the valve gain; constants of the PI.
NOISE, SPREAD = 0.22, 0.1
KP, KI, TARGETS, TIME_CONSTANT = (0.5, 10.0), (0.5, 20.0), (10.0, 35.0), 0.5


def simulated(breaths: Breaths, simulators: frozen.Frozen, seed: int) -> Breaths:
    """Return breaths with the same clocks, from plants without effects of direction, under a PI."""
    rng = np.random.default_rng(seed)
    n, samples = breaths.u_in.shape
    plants = simulators.for_breaths(breaths)
    gain = np.exp(SPREAD * rng.standard_normal((n, 1)))
    plants = replace(
        plants,
        slopes=plants.slopes * gain,
        direction=0.0 * plants.direction,
        rising=0.0 * plants.rising,
        falling=0.0 * plants.falling,
    )
    kp, ki = rng.uniform(*KP, n), rng.uniform(*KI, n)
    target = rng.choice(np.arange(TARGETS[0], TARGETS[1] + 1, 5.0), n)
    noise = NOISE * rng.standard_normal((n, samples))
    start = rng.normal(6.2, 0.3, n)

    def step(carry: Any, now: Any) -> Any:
        state, true, integral = carry
        noisy, u_out, dt = now
        measured = true + noisy
        error = target - measured
        integral = integral + dt / (dt + TIME_CONSTANT) * (error - integral)
        u_in = jnp.clip(kp * error + ki * integral, 0.0, 100.0) * (1.0 - u_out) + 5.0 * u_out
        state, signals = plants.step(state, u_in, u_out, dt)
        return (state, signals.reading, integral), (measured, u_in)

    inputs = [jnp.asarray(x, float).T for x in (noise, breaths.u_out, breaths.dt)]
    begin = jnp.asarray(start)
    carry = (plants.init(begin)[0], begin, jnp.zeros(n))
    _, (pressure, u_in) = jax.jit(lambda c, x: jax.lax.scan(step, c, x))(carry, inputs)
    return replace(
        breaths,
        pressure=np.where(np.isnan(breaths.pressure), np.nan, np.asarray(pressure).T),
        u_in=np.asarray(u_in).T.copy(),
    )


def held_out(data: TrainingRecordings, table: Sessions, directed: bool, folds: int) -> Any:
    """Return held-out errors of the measured breaths, cmH2O, and the mean sum of play weights."""
    config = HybridConfig(directed=directed)
    arranged = training_set(data.measured, data.reconstructed, data.fold, table, config)
    measured = inspirations(data.measured, table)
    error = np.full(len(data.measured), np.nan)
    weights = []
    for fold in range(folds):
        weight = jnp.where(arranged.fold == fold, 0.0, arranged.weight)
        pooled, _ = fit(arranged.inspirations, weight, config)
        found = np.asarray(mean_absolute_errors(pooled, measured, config))
        new = (data.fold == fold) & np.isfinite(data.measured.pressure[:, 0])
        error[new] = found[new]
        weights.append(np.asarray(direction(pooled)).sum(axis=-1).mean())
    return error, float(np.mean(weights))


def summary(error: NDArray[np.float64]) -> tuple[float, float]:
    return float(np.nanmean(error)), float(np.nanmedian(error))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--recordings", type=Path, default=recordings_dir())
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.recordings is None:
        parser.error("give --recordings DIR, the folder of the public recordings")
    real = load_recordings(options.recordings)
    simulators = frozen.load()
    table = simulators.sessions
    with precision.float64():
        fake = replace(
            real,
            measured=simulated(real.measured, simulators, 1),
            reconstructed=simulated(real.reconstructed, simulators, 2),
        )
        result: dict[str, Any] = {}
        print(f"{'breaths':10} {'direction':>10} {'mean':>6} {'median':>7}   weights' sum")
        for name, data in (("real", real), ("simulated", fake)):
            for directed in (False, True):
                error, weight = held_out(data, table, directed, options.folds)
                mean, median = summary(error)
                shown = f"{weight:.2f}" if directed else "-"
                kind = "with" if directed else "without"
                print(f"{name:10} {kind:>10} {mean:6.3f} {median:7.3f}   {shown}", flush=True)
                result[f"{name}_{kind}"] = {"mae": mean, "median_mae": median, "weights": weight}
                ids = data.measured.by_lung_index
                lungs = {lung: summary(error[index]) for lung, index in ids.items()}
                result[f"{name}_{kind}"]["lungs"] = lungs
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    main()
