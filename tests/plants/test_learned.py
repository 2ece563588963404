from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.plants.learned import HIGHEST, LOWEST, Architecture, Normalisation, learned, mlp
from ventbench.plants.single_compartment import single_compartment
from ventbench.task.lungs import lung
from ventbench.task.rollouts import open_loop

SMALL = Architecture(pressures=3, controls=4, width=16, depth=3, boundaries=2, boundary_width=8)


def run(plant, u_in, dt=0.03, u_out=0.0, start=5.0):
    u_in = jnp.atleast_2d(jnp.asarray(u_in, float))
    full = jnp.ones_like(u_in)
    return np.asarray(open_loop(plant, full[:, 0] * start, u_in, full * u_out, full * dt))


@pytest.mark.slow
def test_depth_counts_matrices_as_the_paper_does():
    plant = learned(jax.random.key(0), Architecture())
    shapes = [w.shape for w in plant.general.weights]
    assert shapes == [(15, 150), *[(150, 150)] * 7, (150, 2)]


def test_each_boundary_step_has_its_own_network_then_the_general_one():
    plant = learned(jax.random.key(0), SMALL)
    still = jax.tree.map(jnp.zeros_like, (plant.general, plant.boundary))
    bias = jnp.asarray([[0.0, 1.0], [0.0, 2.0]])  # rates
    general = replace(still[0], biases=(*still[0].biases[:-1], jnp.asarray([0.0, 3.0])))
    assert still[1] is not None
    plant = replace(plant, general=general, boundary=replace(still[1], output_bias=bias))
    rises = np.diff(run(plant, np.full(6, 7.0), dt=0.033)[0]) / float(plant.rate_scale)
    np.testing.assert_allclose(rises, [1, 2, 3, 3, 3], atol=1e-5)


def test_boundary_uses_only_the_chosen_networks_weights():
    plant = learned(jax.random.key(0), SMALL)
    x = jax.random.normal(jax.random.key(1), (5, 7))
    b = plant.boundary
    assert b is not None
    for index in range(2):
        units = slice(8 * index, 8 * index + 8)
        by_hand = jnp.tanh(x @ b.hidden[:, units]) @ b.output[units]
        np.testing.assert_allclose(b(x, jnp.full(5, index)), by_hand, atol=1e-6)
    np.testing.assert_array_equal(b(x, jnp.full(5, 2)), 0.0)


def test_without_boundary_networks():
    plant = learned(jax.random.key(0), Architecture(width=8, depth=2, boundaries=0))
    assert plant.boundary is None
    assert np.all(np.isfinite(run(plant, np.full(5, 7.0))))


def test_windows_start_anew_after_an_expiration():
    plant = learned(jax.random.key(0), SMALL)
    state, _ = plant.init(jnp.full(2, 6.0), jnp.full(2, 5.0))
    for u, opened in ((30.0, 0.0), (20.0, 0.0), (5.0, 1.0)):
        state, signals = plant.step(
            state, jnp.full(2, u), jnp.asarray([opened, 0.0]), jnp.asarray(0.03)
        )
    np.testing.assert_array_equal(state.count, [0, 3])
    np.testing.assert_array_equal(state.controls[0], 0.0)
    np.testing.assert_array_equal(state.pressures[0], signals.reading[0])
    np.testing.assert_array_equal(state.controls[1], [0.0, 30.0, 20.0, 5.0])


def test_varied_resistance_and_compliance_are_the_exact_symmetries_of_a_linear_lung():
    plant = learned(jax.random.key(2), SMALL)
    varied = plant.vary(jnp.asarray(1.1), jnp.asarray(0.9))
    u = np.random.default_rng(0).uniform(0, 20, 20)
    same = run(plant, 1.1 * u, dt=0.03 / (1.1 * 0.9))
    np.testing.assert_allclose(run(varied, u), same, atol=1e-4)
    # The same holds for the textbook lung, where R and C are known.
    lung_ = single_compartment(lung("R20C20"))
    one, other = lung_.vary(jnp.asarray(1.1), jnp.asarray(0.9)), lung_
    np.testing.assert_allclose(run(one, u), run(other, 1.1 * u, dt=0.03 / (1.1 * 0.9)), rtol=1e-5)


def test_stays_within_its_bounds_under_absurd_outputs():
    plant = replace(learned(jax.random.key(0), SMALL), rate_scale=jnp.asarray(1e6))
    p = run(plant, np.random.default_rng(0).uniform(0, 100, (20, 30)))
    assert p.min() >= LOWEST - 1e-3
    assert p.max() <= HIGHEST + 1e-3


def test_commands_beyond_the_valve_are_clipped():
    plant = learned(jax.random.key(0), SMALL)
    np.testing.assert_array_equal(run(plant, np.full(9, 1e30)), run(plant, np.full(9, 100.0)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pressures": 0}, "pressures = 0"),
        ({"depth": 0}, "depth = 0"),
        ({"boundaries": -1}, "boundaries = -1"),
        ({"activation": "relu6"}, "'relu6'"),
    ],
)
def test_impossible_architectures_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Architecture(**change)


def test_impossible_constants_are_refused():
    with pytest.raises(ValueError, match="tau = 0"):
        Normalisation(tau=0.0)


@pytest.mark.parametrize(
    ("sizes", "name", "message"), [((3,), "tanh", "sizes"), ((3, 1), "sin", "'sin'")]
)
def test_impossible_networks_are_refused(sizes, name, message):
    with pytest.raises(ValueError, match=message):
        mlp(jax.random.key(0), sizes, name)
