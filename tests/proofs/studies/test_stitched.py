"""The paper's stitched network: its windows, its boundary networks, and what it learns."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from proofs.studies.stitched import (
    Architecture,
    Network,
    Scales,
    Training,
    fit,
    horizon,
    inspirations,
    simulate,
    untrained,
)
from ventbench.plants.single_compartment import single_compartment
from ventbench.recordings import Breaths, make_breaths
from ventbench.task.lungs import lung
from ventbench.task.rollouts import open_loop

SHAPE = Architecture(pressures=3, controls=4, width=24, depth=3, boundary_width=8)
SMALL = Architecture(pressures=3, controls=4, width=16, depth=3, boundaries=2, boundary_width=8)
SCALES = Scales(16.0, 9.0, 13.0, 16.0, 2.0)
#: Shared, so that it is compiled once.
LONG = Training(steps=600)
T = 31


def recordings(count: int, intervals=(0.0319, 0.0340), seed=0) -> Breaths:
    """Breaths of a textbook lung under random held commands."""
    rng = np.random.default_rng(seed)
    dt = rng.choice(intervals, (count, 1)) * (1 + 0.005 * rng.standard_normal((count, T)))
    u_in = np.repeat(18 * rng.uniform(size=(count, T)) ** 2, 4, axis=1)[:, :T]
    start, closed = 5 + rng.uniform(-1, 2, count), np.zeros((count, T))
    pressure = open_loop(single_compartment(lung("R20C20")), start, u_in, closed, dt)
    time = np.cumsum(dt, axis=1) - dt
    label = np.full(count, 20.0)
    return make_breaths(
        np.arange(count), label, label, time, u_in, closed, np.array(pressure, float)
    )


def trained(breaths: Breaths, config: Training = LONG, seed: int = 0) -> Network:
    return fit(breaths, np.ones(len(breaths)), SHAPE, config, seed)


def error(network: Network, breaths: Breaths) -> float:
    found = simulate(network, breaths.pressure[:, 0], breaths.u_in, breaths.dt)
    return float(np.abs(found - breaths.pressure).mean())


def test_learns_a_textbook_lung_at_every_interval():
    network = trained(recordings(60))
    for interval in (0.0319, 0.034, 0.030):
        assert error(network, recordings(30, (interval,), seed=1)) < 0.3


def test_missing_pressures_are_masked():
    breaths = recordings(60)
    holes = breaths.pressure.copy()
    holes[np.random.default_rng(5).uniform(size=holes.shape) < 0.3] = np.nan
    network = trained(replace(breaths, pressure=holes))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(network))
    assert error(network, recordings(30, seed=1)) < 0.7


def test_is_reproducible_and_seeds_differ():
    breaths, config = recordings(10), Training(steps=20, batch=8)
    one, again, other = (jax.tree.leaves(trained(breaths, config, seed)) for seed in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_windows_hold_the_start_then_the_samples():
    breaths = recordings(2)
    u_out, pressure = breaths.u_out.copy(), breaths.pressure.copy()
    u_out[:, 20:] = 1.0
    pressure[0, 3] = np.nan
    data = inspirations(replace(breaths, u_out=u_out, pressure=pressure), np.ones(2), window=3)
    assert data.u_in.shape == (128, 32)
    p = np.asarray(pressure[0], np.float32)
    np.testing.assert_array_equal(data.window[0, 0], [p[0]] * 3)
    np.testing.assert_array_equal(data.window[0, 2], p[:3])
    np.testing.assert_array_equal(data.window[0, 4], [p[2], 0.0, p[4]])
    np.testing.assert_array_equal(data.known[0, 4], [True, False, True])
    np.testing.assert_array_equal(data.weight[0, 1:4], [1, 0, 1])  # after sample 2 comes a blank
    np.testing.assert_array_equal(data.weight[1, :22], [1] * 20 + [0] * 2)
    assert float(data.weight[2:].sum()) == 0.0


def test_a_blank_first_pressure_takes_the_next_one():
    breaths = recordings(1)
    pressure = breaths.pressure.copy()
    pressure[0, 0] = np.nan
    data = inspirations(replace(breaths, pressure=pressure), np.ones(1), window=2)
    assert float(data.start[0]) == np.float32(pressure[0, 1])


def test_horizons_grow_from_one_step_to_the_whole_inspiration():
    config = Training(one_step=0.2, whole=0.4)
    shares = (0.0, 0.19, 0.4, 0.59, 0.61, 1.0)
    found = [int(horizon(config, jnp.asarray(x), 32)) for x in shares]
    assert found[:2] == [1, 1]
    assert 1 < found[2] < found[3] <= 32
    assert found[4:] == [33, 33]


def test_depth_counts_matrices_as_the_paper_does():
    network = untrained(jax.random.key(0), Architecture(), SCALES)
    shapes = [weights.shape for weights, _ in network.general]
    assert shapes == [(15, 150), *[(150, 150)] * 7, (150, 2)]


@pytest.mark.parametrize("boundaries", [0, 2])
def test_each_boundary_step_has_its_own_network_then_the_general_one(boundaries):
    shape = replace(SMALL, boundaries=boundaries)
    network = untrained(jax.random.key(0), shape, SCALES)
    general, boundary = jax.tree.map(jnp.zeros_like, (network.general, network.boundary))
    # Biases of the outputs: jump and rate.
    general = (*general[:-1], (general[-1][0], jnp.asarray([0.0, 3.0])))
    if boundaries:
        (hidden, (weights, _)) = boundary
        boundary = (hidden, (weights, jnp.asarray([[0.0, 1.0], [0.0, 2.0]])))
    network = Network(general, boundary, network.scales, network.windows)
    pressure = simulate(network, jnp.full(1, 5.0), jnp.full((1, 6), 7.0), jnp.full((1, 6), 0.033))
    rises = np.diff(pressure[0]) / SCALES.change_scale
    np.testing.assert_allclose(rises, [1, 2, 3, 3, 3] if boundaries else [3] * 5, atol=1e-5)


def test_a_step_of_the_command_is_a_jump_whatever_the_interval():
    network = untrained(jax.random.key(0), replace(SMALL, boundaries=0), SCALES)
    general = jax.tree.map(jnp.zeros_like, network.general)
    general = (*general[:-1], (general[-1][0], jnp.asarray([0.5, 0.0])))
    network = Network(general, (), network.scales, network.windows)
    u_in = jnp.asarray([[8.0, 8.0, 24.0, 24.0]])
    for dt in (0.01, 0.05):
        pressure = simulate(network, jnp.full(1, 5.0), u_in, jnp.full((1, 4), dt))
        np.testing.assert_allclose(pressure[0], [5.0, 5.5, 5.5, 6.5], rtol=1e-6)
