"""Events of a circuit: off they change nothing, on they do what an open tube and a relief do."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import precision
from ventbench.physics.catalogue import events, library
from ventbench.physics.model import Physics, physics
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import open_loop

STEPS = 40


def _pressure(plant: Physics, command: float) -> np.ndarray:
    with precision.float64():
        u_in = jnp.full((1, STEPS), command)
        dt = jnp.full((1, STEPS), 0.03)
        return np.asarray(open_loop(plant, jnp.array([5.0]), u_in, 0.0 * u_in, dt))[0]


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    return _pressure(_with(), 12.0)


def _with(**values: float) -> Physics:
    """One structure for all tests, so that it is compiled once."""
    off = {
        "disconnection.conductance": 0.0,
        "disconnection.onset": 0.3,
        "disconnection.duration": 0.3,
        "relief_valve.conductance": 0.0,
        "relief_valve.opening": 60.0,
    }
    with precision.float64():
        return physics(Lung(20.0, 20.0)).having(**off, **{}).having(**values)


def test_events_are_no_mechanisms_of_the_library() -> None:
    assert set(events()) == {"disconnection", "relief_valve"}
    assert not set(events()) & set(library())


def test_off_they_change_nothing(plain: np.ndarray) -> None:
    with precision.float64():
        without = physics(Lung(20.0, 20.0))
    np.testing.assert_allclose(plain, _pressure(without, 12.0), rtol=0, atol=1e-9)


def test_an_open_tube_falls_to_the_room_and_rises_again(plain: np.ndarray) -> None:
    pressure = _pressure(_with(**{"disconnection.conductance": 1000.0}), 12.0)
    time = 0.03 * np.arange(STEPS)
    np.testing.assert_array_equal(pressure[time < 0.29], plain[time < 0.29])
    open_for = (time > 0.34) & (time < 0.59)
    # The flow of the valve over 1 L/s per cmH2O, and what the lung still gives.
    assert np.all((pressure[open_for] > 0.1) & (pressure[open_for] < 1.5))
    assert pressure[-1] > 8.0
    assert pressure[-1] < plain[-1] - 5.0  # the lung has emptied


def test_a_relief_valve_holds_the_pressure(plain: np.ndarray) -> None:
    opened = _with(**{"relief_valve.conductance": 400.0, "relief_valve.opening": 15.0})
    pressure = _pressure(opened, 12.0)
    below = np.cumsum(plain > 14.9) == 0
    np.testing.assert_allclose(pressure[below], plain[below], rtol=0, atol=1e-9)
    assert plain[-1] > 20.0
    # All flow, 12 * 22.8 mL/s, goes through the relief at 15 + 274 / 400 cmH2O at most.
    assert 14.9 < pressure[-1] < 15.8
