"""The closed form against a numerical solution of the differential equation."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ventbench.base import compilation
from ventbench.plants.single_compartment import single_compartment
from ventbench.task.lungs import LUNGS, Lung


def airway(lung, alveolar, u_in, u_out, peep, r_ex=5.0, gain=22.8):
    """Pressure where valve, lung and expiratory path meet: flows in and out balance."""
    flow = gain * u_in / 1000
    if not u_out:
        return alveolar + lung.R * flow
    conductance = 1 / lung.R + 1 / r_ex
    return (flow + alveolar / lung.R + peep / r_ex) / conductance


def solved(lung, u_in, u_out, dt, start, peep):
    alveolar, pressures = start, []
    for u, out, h in zip(u_in, u_out, dt, strict=True):

        def slope(_, a, u=u, out=out):
            return (airway(lung, a, u, out, peep) - a) / lung.R / (lung.C / 1000)

        found = solve_ivp(slope, (0, h), [alveolar], method="LSODA", rtol=1e-10, atol=1e-10)
        alveolar = found.y[0, -1]
        pressures.append(airway(lung, alveolar, u, out, peep))
    return np.array(pressures)


@pytest.mark.parametrize("lung", LUNGS, ids=str)
def test_against_solve_ivp(lung):
    rng = np.random.default_rng(0)
    u_in = rng.uniform(0, 20, size=60)
    u_out = (np.arange(60) % 20 >= 12).astype(float)
    dt = rng.uniform(0.02, 0.05, size=60)
    with compilation.float64():
        plant = single_compartment(lung)
        (state, _), found = plant.init(jnp.asarray(6.0), jnp.asarray(5.0)), []
        for command in zip(u_in, u_out, dt, strict=True):
            state, signals = plant.step(state, *map(jnp.asarray, command))
            found.append(float(signals.reading))
    np.testing.assert_allclose(found, solved(lung, u_in, u_out, dt, 6.0, 5.0), rtol=1e-6)


def test_two_half_steps_are_a_whole_one():
    with compilation.float64():
        plant = single_compartment(Lung(20, 50))
        for u_out in (0.0, 1.0):
            (start, _), u, out = plant.init(jnp.asarray(9.0)), jnp.asarray(7.0), jnp.asarray(u_out)
            _, whole = plant.step(start, u, out, jnp.asarray(0.06))
            half, _ = plant.step(start, u, out, jnp.asarray(0.03))
            _, twice = plant.step(half, u, out, jnp.asarray(0.03))
            assert twice.reading == pytest.approx(float(whole.reading), rel=1e-12)


def test_expiration_returns_to_peep():
    with compilation.float64():
        plant = single_compartment(Lung(20, 50))
        state, _ = plant.init(jnp.asarray(40.0), jnp.asarray(5.0))
        for _ in range(1000):
            state, signals = plant.step(
                state, jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray(0.03)
            )
    assert signals.reading == pytest.approx(5.0, abs=1e-6)


def test_vary_and_gradient():
    plant = single_compartment(Lung(20, 50)).vary(jnp.asarray(1.1), jnp.asarray(0.9))
    np.testing.assert_allclose([plant.R, plant.C], [22.0, 45.0], rtol=1e-6)
    command = tuple(jnp.asarray(x) for x in (10.0, 0.0, 0.03))

    def final(c):
        varied = replace(plant, C=c)
        return varied.step(varied.init(jnp.asarray(5.0))[0], *command)[1].reading

    # p = p0 + R q + q dt / C, so dp/dC = - q dt / C^2 (C in mL: 1000 times)
    expected = -0.228 * 0.03 * 1000 / 45.0**2
    assert jax.grad(final)(45.0) == pytest.approx(expected, rel=1e-4)
