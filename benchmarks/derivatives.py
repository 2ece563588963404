"""Time of the derivatives of a fit, by finite differences and by forward-mode differentiation.

Fits use finite differences. The benchmark differentiates 40 breaths of 80 samples by the first
parameters of the model: with all mechanisms, and with all mechanisms and basis terms. Differences
skip mechanisms that are off; forward mode cannot, because their slopes are not zero. Predictions
are also compiled with XLA's own options, to show what ours are worth. Run it on one core.
Usage:

    taskset -c 0 python benchmarks/derivatives.py [--columns 8] [--repeats 5]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import typer

from ventbench.base.compilation import float64
from ventbench.physics import library, parameter, paths
from ventbench.physics.catalogue import basis_terms
from ventbench.recordings import Breaths
from ventbench.system_id import Predictor, make_data, parameter_values
from ventbench.system_id import predictor as predictor_module

BREATHS, SAMPLES, DT = 40, 80, 0.03


def breaths() -> Breaths:
    """Return breaths with random steps of u_in every 120 ms; their pressures are not used."""
    shape = (BREATHS, SAMPLES)
    steps = np.random.default_rng(0).uniform(0.0, 60.0, (BREATHS, SAMPLES // 4))
    inspired = np.arange(SAMPLES) < SAMPLES // 2
    return Breaths(
        breath_id=np.arange(BREATHS),
        R=np.full(BREATHS, 20.0),
        C=np.full(BREATHS, 20.0),
        time=np.broadcast_to(DT * np.arange(SAMPLES), shape),
        dt=np.full(shape, DT),
        u_in=np.where(inspired, np.repeat(steps, 4, axis=1), 0.0),
        u_out=np.broadcast_to(~inspired, shape).astype(np.int8),
        pressure=np.full(shape, 5.0),
        valid=np.ones(shape, bool),
        time_inferred=np.zeros(BREATHS, bool),
    )


def with_usual_options(predictor: Predictor, values: np.ndarray) -> Callable[[], object]:
    """Return a call that predicts as ``predictor`` does, compiled with XLA's own options."""
    run = jax.jit(predictor_module._run, static_argnames=predictor_module._STATIC)
    steps = predictor._divisions(values[None])[0]

    def call() -> object:
        with float64():
            return np.asarray(run(values, predictor._commands, steps, **predictor._static))

    return call


def exact(predictor: Predictor, values: np.ndarray, columns: int) -> Callable[[], object]:
    """Return a call that differentiates along columns of ``values`` in forward mode."""
    steps = predictor._divisions(values[None])[0]
    basis = np.eye(values.shape[1])[:columns]

    @jax.jit
    def slopes(values: jax.Array, basis: jax.Array) -> jax.Array:
        static = predictor._static | {"skip_idle": False}
        run = partial(
            predictor_module._run, commands=predictor._commands, divisions=steps, **static
        )

        def along(direction: jax.Array) -> jax.Array:
            return jax.jvp(run, (values,), (jnp.broadcast_to(direction, values.shape),))[1]

        return jax.vmap(along)(basis)

    def call() -> object:
        with float64():
            return np.asarray(slopes(jnp.asarray(values), jnp.asarray(basis)))

    return call


def seconds(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the seconds of the first call, which compiles, and of the fastest other call."""
    times = []
    for _ in range(1 + repeats):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return times[0], min(times[1:])


def compare(names: tuple[str, ...], columns: int, repeats: int) -> None:
    """Print the times of both methods and their ratio for a model with the named parameters."""
    predictor = Predictor(make_data(breaths()), names, sizes=(BREATHS,))
    few = {"PEEP": 5.0, "valve_lag.tau": 0.03, "leak.conductance": 5.0}
    mild = {name: parameter(name).mild for name in names if "." in name}
    off = {"command_rounding.amount": 0.0}  # has no slope
    print(f"{BREATHS} breaths, {columns} of {len(names)} parameters, ms")
    print(
        f"  {'':12}{'pressures':>12}{'usual options':>15}{'ratio':>8}{'differences':>14}"
        f"{'forward mode':>14}{'ratio':>8}"
    )
    firsts = []
    for label, given in (("none acts", {}), ("two act", few), ("all act", mild | off)):
        values = parameter_values(make_data(breaths()), names, given)
        ways = (
            partial(predictor.predict, values),
            with_usual_options(predictor, values),
            partial(predictor.derivatives, values, tuple(range(columns))),
            exact(predictor, values, columns),
        )
        found = [seconds(way, repeats) for way in ways]
        alone, usual, differences, forward = (1e3 * least for _, least in found)
        print(
            f"  {label:12}{alone:12.1f}{usual:15.1f}{alone / usual:8.2f}{differences:14.1f}"
            f"{forward:14.1f}{differences / forward:8.2f}"
        )
        firsts.append([first for first, _ in found])
    print("  to compile, s: {:.1f}, {:.1f}, {:.1f}, {:.1f}".format(*firsts[0]))


def main(columns: int = 8, repeats: int = 5) -> None:
    """Time of the derivatives of a fit, by differences and in forward mode."""
    if columns < 1 or repeats < 1:
        raise typer.BadParameter("--columns and --repeats must be at least 1")
    os.environ["VENTBENCH_THREADS"] = "1"
    for names in (paths(), paths((*library(), *basis_terms()))):
        compare(names, columns, repeats)


if __name__ == "__main__":
    typer.run(main)
