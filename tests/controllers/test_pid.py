import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.controllers.pid import PID
from ventbench.task.interfaces import Controller, Observation
from ventbench.task.rollouts import Script


def plain(p, i, d, pressures, target, dt):
    """The definition, one float at a time."""
    out = []
    for breath in pressures:
        before = integral = derivative = 0.0
        for pressure in breath:
            error = target - pressure
            a = dt / (dt + 0.5)
            integral += a * (error - integral)
            derivative += a * (error - before - derivative)
            before = error
            out.append(p * error + i * integral + d * derivative)
    return np.array(out)


def stepped(controller, pressures, target, dt, shape=()):
    state, out = controller.init(shape), []
    for breath in pressures:
        for step, pressure in enumerate(breath):
            now = jnp.broadcast_to(jnp.asarray(pressure), shape)
            ahead = jnp.full((*shape, 10), target)
            observation = Observation(step * dt, dt, now, target, ahead, jnp.zeros(shape))
            state, u_in = controller.step(state, observation)
            out.append(u_in)
    return np.array(out)


@pytest.mark.parametrize("gains", [(2.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 4.0), (2, 3, 4)])
def test_against_plain_loop(gains):
    pressures = np.random.default_rng(0).uniform(5, 25, size=(3, 34))
    with compilation.float64():
        found = stepped(PID(*gains), pressures, 20.0, 0.03)
    p, i, d = gains
    expected = plain(p, i, d, pressures, 20.0, 0.03)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_constant_error_in_closed_form():
    a = 0.03 / 0.53
    with compilation.float64():
        integral = stepped(PID(0.0, 1.0, 0.0), np.full((1, 34), 10.0), 20.0, 0.03)
    np.testing.assert_allclose(integral, 10 * (1 - (1 - a) ** np.arange(1, 35)), rtol=1e-12)


def test_batched_gains():
    pressures = np.random.default_rng(1).uniform(5, 25, size=(2, 5))
    gains = np.random.default_rng(2).uniform(0, 5, size=(3, 4))
    with compilation.float64():
        found = stepped(PID(*jnp.asarray(gains)), pressures, 20.0, 0.03, (4,))
        for k in range(4):
            single = stepped(PID(*gains[:, k]), pressures, 20.0, 0.03)
            np.testing.assert_allclose(found[:, k], single, atol=1e-12)


def test_is_a_controller_whose_gains_are_leaves():
    assert isinstance(PID(1.0, 2.0), Controller)
    assert isinstance(Script(jnp.zeros(3)), Controller)
    assert jax.tree.leaves(PID(1.0, 2.0, 3.0)) == [1.0, 2.0, 3.0]


def test_script_says_its_lines():
    lines = jnp.arange(12.0).reshape(2, 6)
    found = stepped(Script(lines), np.zeros((2, 3)), 20.0, 0.03, (2,))
    np.testing.assert_array_equal(found.T, lines)
