"""Plants side by side give what each gives by itself: stacked, vmapped, at labels."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.physics import physics
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.stacking import (
    VmappedPlant,
    nominal_plants,
    open_loop_breaths,
    stack,
    stack_heterogeneous,
    take,
)
from ventbench.plants.two_balloon import two_balloon
from ventbench.task.lungs import LUNGS, lung
from ventbench.task.rollouts import open_loop

single_compartments = partial(nominal_plants, single_compartment)
two_balloons = partial(nominal_plants, two_balloon)
N, T = 3, 12


@pytest.mark.parametrize(
    "plants",
    [
        stack([two_balloon(lung) for lung in LUNGS[:N]]),
        stack([single_compartment(lung) for lung in LUNGS[:N]]),
    ],
    ids=["balloons", "textbook"],
)
def test_each_row_has_its_own_plant(plants):
    rng = np.random.default_rng(0)
    u_in = rng.uniform(0.0, 20.0, (N, T))
    u_out = np.broadcast_to((np.arange(T) >= 8) * 1.0, (N, T))
    dt, start = rng.uniform(0.02, 0.04, (N, T)), np.array([4.0, 5.0, 6.0])
    columns = [jnp.asarray(x, jnp.float32) for x in (start, u_in, u_out, dt)]
    together = open_loop(VmappedPlant(plants), *columns)
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
    state, _ = VmappedPlant(plants).init(start, peep)
    for _ in range(200):
        state, signals = VmappedPlant(plants).step(state, closed, opened, dt)
    np.testing.assert_allclose(signals.reading, peep, atol=1e-3)
    state, _ = VmappedPlant(plants).init(start)  # at rest: nothing moves
    _, signals = VmappedPlant(plants).step(state, closed, opened, dt)
    np.testing.assert_allclose(signals.reading, start, atol=1e-5)


LABELS = ["R20C50", "R5C10", "R50C20"]


@pytest.mark.parametrize(
    ("plants_for", "one"),
    [(single_compartments, single_compartment), (two_balloons, two_balloon)],
)
def test_each_breath_has_the_plant_of_its_label(make_recording, plants_for, one):
    with float64():
        plants = plants_for(make_recording(LABELS))
        for i, name in enumerate(LABELS):
            assert take(plants, i) == one(lung(name))


def test_the_order_of_breaths_does_not_matter(make_recording):
    breaths = make_recording(LABELS)
    order = [2, 0, 1]
    straight = open_loop_breaths(single_compartments, breaths)
    turned = open_loop_breaths(single_compartments, breaths.select(order))
    np.testing.assert_array_equal(turned, straight[order])
    np.testing.assert_array_equal(straight[:, 0], breaths.pressure[:, 0])


def late(lung_id: str, **base: float):
    with compilation.float64():
        return physics(lung(lung_id), {"valve_delay": {"delay": 1.0 / 24.0}}, **base)


@pytest.mark.parametrize("base", [{}, {"PEEP": 3.0}], ids=["at rest", "own PEEP"])
def test_physics_with_other_mechanisms_are_stacked_and_stay_themselves(base) -> None:
    """One without a PEEP of its own takes the pressure that it starts from, beside one with it."""
    with compilation.float64():
        leaking = physics(lung("R5C10"), {"leak": {"conductance": 8.0}}, **base)
        both = stack_heterogeneous([late("R20C50"), leaking])
        u_in = np.array([[30.0, 20.0, 0.0, 10.0, 0.0, 0.0]])
        u_out, dt = np.array([[0.0, 0.0, 0.0, 0.0, 1.0, 1.0]]), np.full((1, 6), 0.03)
        commands = [jnp.asarray(x) for x in (np.array([5.0]), u_in, u_out, dt)]
        for index, plant in enumerate((late("R20C50"), leaking)):
            answer = open_loop(plant, *commands)
            assert np.ptp(answer) > 5.0
            found = open_loop(take(both, index), *commands)
            np.testing.assert_allclose(found, answer, rtol=1e-9)


def test_plants_that_cannot_be_stacked() -> None:
    with pytest.raises(InputError, match="make a file for each lung"):
        stack_heterogeneous([late("R20C50"), single_compartment(lung("R5C10"))])
