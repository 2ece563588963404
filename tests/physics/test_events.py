"""Events: off they change nothing, on they do what formulas and the oracle say."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.physics.catalogue import events, intermittent, library
from ventbench.physics.model import Physics, physics
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import open_loop

from . import oracle

STEPS = 40


def _pressure(plant: Physics, command: float) -> np.ndarray:
    with compilation.float64():
        u_in = jnp.full((1, STEPS), command)
        dt = jnp.full((1, STEPS), 0.03)
        return np.asarray(open_loop(plant, jnp.array([5.0]), u_in, 0.0 * u_in, dt))[0]


@pytest.fixture(scope="module")
def plain() -> np.ndarray:
    return _pressure(_with(), 12.0)


def _with(**values: float) -> Physics:
    """One structure for all tests, so that it is compiled once."""
    off = {
        f"{name}.{p.name}": p.neutral
        for name, event in events().items()
        for p in event.description.parameters
    }
    with compilation.float64():
        return physics(Lung(20.0, 20.0)).having(**off).having(**values)


def test_events_are_no_mechanisms_of_the_library() -> None:
    assert set(intermittent()) == {"cough", "disconnection", "intermittent_leak", "secretions"}
    assert set(intermittent()) < set(events())
    assert not set(events()) & set(library())


@pytest.mark.parametrize(
    ("values", "same"),
    [
        ({"secretions.increase": 0.5}, {"R": 30.0}),
        ({"intermittent_leak.conductance": 9.0}, {"m": {"leak": {"conductance": 9.0}}}),
        (  # a jet out of an open end
            {
                "disconnection.conductance": 90.0,
                "disconnection.exponent": 0.5,
                "disconnection.onset": -1.0,
                "disconnection.duration": 9.0,
            },
            {"m": {"leak": {"conductance": 90.0}}},
        ),
        (
            {"cough.pressure": 6.0, "cough.onset": 0.3, "cough.duration": 0.4},
            {"m": {"patient_effort": {"amplitude": -6.0, "onset": 0.3, "duration": 0.4}}},
        ),
    ],
)
def test_what_acts_in_some_breaths_is_a_leak_a_resistance_or_a_push(
    values: dict[str, float], same: dict[str, Any]
) -> None:
    """By the oracle, which solves each breath with SciPy."""
    told = {"R": 20.0, "m": {}} | same
    expected = oracle.breath(
        told["R"], 20.0, np.full(STEPS, 12.0), np.zeros(STEPS), np.full(STEPS, 0.03), 5.0, told["m"]
    )[0]
    np.testing.assert_allclose(_pressure(_with(**values), 12.0), expected, rtol=0, atol=0.02)


def test_a_ripple_and_water_swing_as_formulas_say() -> None:
    """At a constant command, the lung integrates a ripple; water adds a sine to the pressure."""
    time, flow, rate = 0.03 * np.arange(1, STEPS), 12.0 * 22.8e-3, 2.0 * np.pi * 4.0
    plain = 5.0 + flow * (20.0 + time / 0.02)
    ripple = {"amplitude": 0.2, "frequency": 4.0, "phase": 0.25}
    seen = _pressure(_with(**{f"supply_ripple.{k}": v for k, v in ripple.items()}), 12.0)[1:]
    swing = 20.0 * np.cos(rate * time) + np.sin(rate * time) / (0.02 * rate)
    np.testing.assert_allclose(seen, plain + 0.2 * flow * swing, rtol=0, atol=0.02)
    water = {"amplitude": 1.5, "frequency": 4.0, "phase": 0.0}
    seen = _pressure(_with(**{f"circuit_water.{k}": v for k, v in water.items()}), 12.0)[1:]
    swing = 1.5 * flow / (flow + 0.1) * np.sin(rate * time)
    np.testing.assert_allclose(seen, plain + swing, rtol=0, atol=0.02)


def test_off_they_change_nothing(plain: np.ndarray) -> None:
    with compilation.float64():
        without = physics(Lung(20.0, 20.0))
    np.testing.assert_allclose(plain, _pressure(without, 12.0), rtol=0, atol=1e-9)


def test_an_open_tube_falls_to_the_room_and_rises_again(plain: np.ndarray) -> None:
    opened = _with(**{"disconnection.conductance": 1000.0, "disconnection.onset": 0.3})
    pressure = _pressure(opened, 12.0)
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
