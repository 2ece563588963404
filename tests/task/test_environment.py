from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.task import environment as env
from ventbench.task import protocol, waveform
from ventbench.task.lungs import Lung


@pytest.fixture(autouse=True)
def _float64():
    with compilation.float64():
        yield


@pytest.fixture
def plant():
    return single_compartment(Lung(5, 20))


def cell(**changes):
    arrays = {name: jnp.broadcast_to(jnp.asarray(x), (2,)) for name, x in changes.items()}
    return replace(env.nominal_scenario(np.array([10.0, 35.0])), **arrays)


def test_nominal_scenario():
    cells = env.nominal_scenario(np.array([10.0, 35.0]))
    np.testing.assert_array_equal(cells.start, [5.0, 5.0])
    np.testing.assert_array_equal(cells.dt, [0.03, 0.03])
    assert cells.noise.shape == (2, 3, 34)
    with pytest.raises(ValueError, match="must exceed PEEP"):
        env.nominal_scenario([10.0, 5.0])


def test_start_of_a_breath(plant):
    bench = env.start_breath(plant, cell(start=6.0, peep=4.5))
    np.testing.assert_array_equal(bench.signals.reading, 6.0)
    np.testing.assert_allclose(bench.previous, 5.0 * (1.0 - np.exp(-5.0 * (99 * 0.03 - 1.5))))
    np.testing.assert_array_equal(bench.plant.peep, 4.5)


def test_observation(plant):
    cells = cell(dt=0.031, peep=4.0)
    bench = replace(env.start_breath(plant, cells), previous=jnp.array([3.0, 4.0]))
    seen = env.observe(cells, bench, 1, 27)
    np.testing.assert_allclose(seen.time, 27 * 0.031)
    np.testing.assert_array_equal(seen.dt, 0.031)
    np.testing.assert_array_equal(seen.pressure, 5.0)
    np.testing.assert_array_equal(seen.target, [10.0, 35.0])
    np.testing.assert_allclose(
        seen.targets_ahead, waveform.targets_ahead(27, np.array([10.0, 35.0]), 4.0)
    )
    np.testing.assert_array_equal(seen.previous_u_in, [3.0, 4.0])


def test_sensor(plant):
    noise = np.random.default_rng(0).normal(0, 0.2, size=(2, 3, 34))
    cells = replace(cell(quantum=0.0703), noise=jnp.asarray(noise))
    seen = env.observe(cells, env.start_breath(plant, cells), 2, 5).pressure
    counts = np.asarray(seen) / 0.0703
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.all(np.abs(seen - (5.0 + noise[:, 2, 5])) <= 0.0703 / 2 + 1e-12)
    exact = env.observe(replace(cells, quantum=jnp.zeros(2)), env.start_breath(plant, cells), 2, 5)
    np.testing.assert_allclose(exact.pressure, 5.0 + noise[:, 2, 5], rtol=1e-15)


@pytest.mark.parametrize(("asked", "applied"), [(-3.0, 0.0), (50.0, 50.0), (1e300, 100.0)])
def test_commands_are_clipped(plant, asked, applied):
    cells = cell()
    after, u_in = env.inspire(plant, cells, env.start_breath(plant, cells), jnp.full(2, asked))
    np.testing.assert_array_equal(u_in, applied)
    np.testing.assert_array_equal(after.previous, applied)


def test_delay_mixes_with_the_command_before(plant):
    cells = cell(delay=0.3)
    bench = replace(env.start_breath(plant, cells), previous=jnp.full(2, 20.0))
    after, _ = env.inspire(plant, cells, bench, jnp.full(2, 10.0))
    flow = 22.8e-3 * (0.7 * 10 + 0.3 * 20)
    np.testing.assert_allclose(after.signals.reading, 5 + 5 * flow + flow * 0.03 / 0.02)


def test_expiration_uses_the_hard_coded_controller(plant):
    cells = cell()
    after, u_in = env.expire(plant, cells, env.start_breath(plant, cells), 60)
    np.testing.assert_allclose(u_in, 5 * (1 - np.exp(-5 * 0.3)))
    assert np.all(after.signals.reading > 5.0)


def test_vary(plant):
    gain = np.array([[1.0, 1.2, 0.8], [1.0, 0.9, 1.1]])
    varied = env.vary(plant, replace(cell(r_scale=1.1, c_scale=0.9), gain=jnp.asarray(gain)), 1)
    assert isinstance(varied, SingleCompartment)
    np.testing.assert_allclose(varied.R, 5.5)
    np.testing.assert_allclose(varied.gain, [1.2 * 22.8, 0.9 * 22.8])
    np.testing.assert_allclose(varied.C, 18.0)


def test_target_is_the_waveform():
    for step in (0, 33, 40, 99):
        np.testing.assert_allclose(
            env.target(cell(), step), waveform.target(step, np.array([10.0, 35.0]))
        )
    assert protocol.INSPIRATION_STEPS + protocol.TARGETS_AHEAD < 2 * protocol.BREATH_STEPS
