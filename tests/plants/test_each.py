"""A stack of plants as one plant gives what each gives by itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.lungs import LUNGS
from ventbench.plants.each import Each
from ventbench.plants.learned import Architecture, learned
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.stack import stack, take
from ventbench.rollouts import open_loop

SMALL = Architecture(pressures=3, controls=4, width=8, depth=2, boundaries=1, boundary_width=4)
N, T = 3, 12


@pytest.mark.parametrize(
    "plants",
    [
        stack([learned(jax.random.key(i), SMALL) for i in range(N)]),
        stack([single_compartment(lung) for lung in LUNGS[:N]]),
    ],
    ids=["networks", "textbook"],
)
def test_each_row_has_its_own_plant(plants):
    rng = np.random.default_rng(0)
    u_in = rng.uniform(0.0, 20.0, (N, T))
    u_out = np.broadcast_to((np.arange(T) >= 8) * 1.0, (N, T))
    dt, start = rng.uniform(0.02, 0.04, (N, T)), np.array([4.0, 5.0, 6.0])
    columns = [jnp.asarray(x, jnp.float32) for x in (start, u_in, u_out, dt)]
    together = open_loop(Each(plants), *columns)
    assert together.shape == (N, T)
    for i in range(N):
        alone = open_loop(take(plants, i), *(x[i : i + 1] for x in columns))
        np.testing.assert_allclose(together[i], alone[0], atol=1e-4)
    assert float(jnp.abs(together[0, 1:] - together[1, 1:]).max()) > 0.01


def test_peep_may_differ_from_the_first_pressure():
    one = single_compartment(LUNGS[0])
    plants: SingleCompartment = stack([one, one])
    start, peep = jnp.asarray([10.0, 10.0]), jnp.asarray([5.0, 8.0])
    closed, opened, dt = jnp.zeros(2), jnp.ones(2), jnp.full(2, 0.03)
    state = Each(plants).init(start, peep)
    for _ in range(200):
        state, pressure = Each(plants).step(state, closed, opened, dt)
    np.testing.assert_allclose(pressure, peep, atol=1e-3)
    state = Each(plants).init(start)  # at rest: nothing moves
    _, pressure = Each(plants).step(state, closed, opened, dt)
    np.testing.assert_allclose(pressure, start, atol=1e-5)
