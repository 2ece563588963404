from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.controllers.pid import PID
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack, take
from ventbench.task import draws, protocol, rollouts
from ventbench.task import environment as env
from ventbench.task.interfaces import Observation
from ventbench.task.lungs import LUNGS
from ventbench.task.rollouts import Script


@pytest.fixture
def plants():
    with compilation.float64():
        return stack([single_compartment(lung) for lung in LUNGS])


@pytest.fixture
def nominal():
    with compilation.float64():
        return env.nominal_scenario(np.array(protocol.PIPS))


def looped(plant, controller, cells):
    """The same run, step by step in Python, nothing compiled."""
    nominal = plant
    state = controller.init(cells.pip.shape)
    out = []
    for breath in range(3):
        plant = env.vary(nominal, cells, breath)
        bench, rows = env.start_breath(plant, cells), []
        for step in range(100):
            pressure = bench.signals.reading
            if step < 34:
                state, u_in = controller.step(state, env.observe(cells, bench, breath, step))
                bench, applied = env.inspire(plant, cells, bench, u_in)
            else:
                u_in = np.nan
                bench, applied = env.expire(plant, cells, bench, step)
            rows.append((pressure, np.broadcast_to(u_in, pressure.shape), applied))
        out.append(rows)
    # (breath, step, quantity, ...) -> (quantity, ..., breath, step)
    return np.moveaxis(np.array(out), (0, 1), (-2, -1))


def test_closed_loop_against_python_loop(plants):
    controller = PID(0.5, 5.0, 1.0)
    with compilation.float64():
        drawn = draws.build([[0]], 1, n=2, pips=(10.0, 35.0))
        cells = jax.tree.map(lambda x: jnp.asarray(x[0]), drawn.cells)
        for k in (0, 5):
            inspired, expired = rollouts.closed_loop(take(plants, k), controller, cells, whole=True)
            pressure, requested, applied = looped(take(plants, k), controller, cells)
            assert inspired.pressure.shape == (2, 2, 3, 34)
            for found, expected in (
                (inspired.pressure, pressure[..., :34]),
                (inspired.requested, requested[..., :34]),
                (inspired.u_in, applied[..., :34]),
                (expired.pressure, pressure[..., 34:]),
                (expired.u_in, applied[..., 34:]),
            ):
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_without_expirations(plants, nominal):
    with compilation.float64():
        plant = take(plants, 0)
        short, none = rollouts.closed_loop(plant, PID(1.0, 5.0), nominal)
        whole, _ = rollouts.closed_loop(plant, PID(1.0, 5.0), nominal, whole=True)
    assert none is None
    np.testing.assert_allclose(short.pressure, whole.pressure, rtol=0, atol=1e-10)


def test_controller_state_lives_through_the_breaths(plants, nominal):
    with compilation.float64():
        lines = jnp.broadcast_to(jnp.arange(102.0), (6, 102))
        found, _ = rollouts.closed_loop(take(plants, 0), Script(lines), nominal)
    np.testing.assert_array_equal(found.requested.reshape(6, 102), lines)
    np.testing.assert_array_equal(found.u_in.reshape(6, 102), np.minimum(lines, 100))
    np.testing.assert_array_equal(found.pressure[:, :, 0], 5.0)


def test_vmap_over_lungs_is_each_lung(plants, nominal):
    with compilation.float64():
        together, _ = jax.vmap(lambda p: rollouts.closed_loop(p, PID(1.0, 5.0), nominal))(plants)
        for k in range(6):
            alone, _ = rollouts.closed_loop(take(plants, k), PID(1.0, 5.0), nominal)
            np.testing.assert_allclose(together.pressure[k], alone.pressure, rtol=0, atol=1e-9)


def test_gradient_with_respect_to_gains(plants, nominal):
    def loss(gains):
        found, _ = rollouts.closed_loop(take(plants, 5), PID(*gains), nominal)
        return jnp.mean((found.pressure - nominal.pip[:, None, None]) ** 2)

    with compilation.float64():
        gains = jnp.array([0.5, 3.0, 0.2])
        found = jax.grad(loss)(gains)
        for k in range(3):
            step = jnp.zeros(3).at[k].set(1e-5)
            expected = (loss(gains + step) - loss(gains - step)) / 2e-5
            assert found[k] == pytest.approx(float(expected), rel=1e-5)


def test_single_precision_is_close(plants, nominal):
    with compilation.float64():
        double, _ = rollouts.closed_loop(take(plants, 4), PID(0.5, 5.0), nominal)
    to_single = jax.tree.map(lambda x: np.asarray(x, np.float32), (take(plants, 4), nominal))
    single, _ = rollouts.closed_loop(to_single[0], PID(0.5, 5.0), to_single[1])
    assert single.pressure.dtype == jnp.float32
    np.testing.assert_allclose(single.pressure, double.pressure, atol=1e-3)


def test_compiles_once(plants, nominal):
    function: Any = rollouts.closed_loop
    function.clear_cache()
    with compilation.float64():
        for k in range(3):
            function(take(plants, k), PID(jnp.asarray(float(k)), 5.0, 0.0), nominal)
    assert function._cache_size() == 1


def test_open_loop_against_python_loop(plants):
    rng = np.random.default_rng(0)
    u_in = rng.uniform(0, 20, size=(4, 50))
    u_out = (np.arange(50) > 30) * np.ones((4, 1))
    dt = rng.uniform(0.02, 0.05, size=(4, 50))
    start = rng.uniform(4, 8, size=4)
    with compilation.float64():
        plant = take(plants, 3)
        found = rollouts.open_loop(plant, *map(jnp.asarray, (start, u_in, u_out, dt)))
        (state, _), expected = plant.init(jnp.asarray(start)), [start]
        for t in range(49):
            state, signals = plant.step(state, *(jnp.asarray(x[:, t]) for x in (u_in, u_out, dt)))
            expected.append(signals.reading)
    np.testing.assert_allclose(found, np.stack(expected, axis=1), rtol=0, atol=1e-10)


def test_open_loop_ignores_the_last_command(plants):
    with compilation.float64():
        commands = jnp.ones((1, 5)), jnp.zeros((1, 5)), jnp.full((1, 5), 0.03)
        changed = (commands[0].at[0, -1].set(99.0), *commands[1:])
        plant, start = take(plants, 0), jnp.array([5.0])
        np.testing.assert_array_equal(
            rollouts.open_loop(plant, start, *commands), rollouts.open_loop(plant, start, *changed)
        )


def test_pure_controllers_see_what_submissions_see(plants, nominal):
    class Spy(PID):
        def step(self, state, observation):
            assert isinstance(observation, Observation)
            assert observation.targets_ahead.shape == (6, 10)
            assert observation.time.shape == observation.pressure.shape == (6,)
            return super().step(state, observation)

    with compilation.float64():
        looped(take(plants, 0), Spy(1.0, 5.0), nominal)
