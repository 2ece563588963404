"""A plant that is read through a sensor."""

import jax.numpy as jnp
import numpy as np
import pytest

from proofs.real.parts import lagged
from ventbench.base import compilation
from ventbench.plants.sensed import Sensed, readings, sensor
from ventbench.plants.single_compartment import single_compartment
from ventbench.task.lungs import lung
from ventbench.task.rollouts import open_loop

RNG = np.random.default_rng(7)
DT = np.full((3, 60), 0.03)
PRESSURE = 12.0 + np.cumsum(RNG.normal(0.0, 1.5, DT.shape), axis=1)


@pytest.mark.parametrize("tau", [0.02, 0.08, 0.2])
def test_a_lag_is_that_of_its_equation(tau):
    """The oracle is the exact response to straight lines, which shares no code."""
    time = np.concatenate([np.zeros((3, 1)), np.cumsum(DT[:, :-1], axis=1)], axis=1)
    exact = np.stack([lagged(t, p, tau) for t, p in zip(time, PRESSURE, strict=True)])
    with compilation.float64():
        shown = readings(sensor({"sensor_lag.tau": tau}), PRESSURE, DT)
    np.testing.assert_allclose(shown, exact, atol=0.02)


@pytest.mark.parametrize(
    "path", ["sensor_lag.tau", "pressure_line.time", "sensor_curve.bend", "sensor_hysteresis.width"]
)
def test_a_mechanism_that_is_off_changes_nothing(path):
    with compilation.float64():
        shown = readings(sensor({path: 0.0}), PRESSURE, DT)
    np.testing.assert_allclose(shown, PRESSURE, atol=1e-9)


def test_the_plant_reads_what_its_sensor_shows_and_is_scored_by_its_pressure():
    with compilation.float64():
        plant, slow = single_compartment(lung("R20C20")), sensor({"sensor_lag.tau": 0.08})
        u_in, u_out = jnp.full((1, 40), 20.0), jnp.zeros((1, 40))
        dt, start = jnp.full((1, 40), 0.03), jnp.full((1,), 5.0)
        alone = open_loop(plant, start, u_in, u_out, dt)
        shown = open_loop(Sensed(plant, slow), start, u_in, u_out, dt)
        np.testing.assert_allclose(shown, readings(slow, alone, dt), atol=1e-9)
        state, _ = Sensed(plant, slow).init(start)
        _, signals = Sensed(plant, slow).step(state, u_in[:, 0], u_out[:, 0], dt[:, 0])
        np.testing.assert_allclose(signals.scored, alone[:, 1])
    assert float(signals.reading[0]) < float(signals.scored[0])
