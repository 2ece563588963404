"""Simulators in plain Python and NumPy: functions, classes, objects, messages."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.plants.catalog import load_simulators
from ventbench.plants.python_simulators import is_jax_plant
from ventbench.task.interfaces import Signals

SETTINGS = ["R20C50", "R5C10"]


@pytest.fixture
def breaths(make_recording):
    return make_recording(SETTINGS)


def by_names(u_in, u_out, dt, *, R, C, initial_pressure):
    return initial_pressure + R * u_in / 100.0 + C * dt


def short(u_in):
    return 5.0 + u_in


def of_time_and_flow(time, u_in, flow=None):
    return 5.0 + time + (0.0 if flow is None else flow)


class WithState:
    """A plant in NumPy: `init` and `step`, made with the label."""

    def __init__(self, R, C):
        self.R, self.C = R, C

    def init(self, pressure):
        return np.array([pressure, 0.0])

    def step(self, state, u_in, u_out, dt):
        volume = state[1] + 22.8 * u_in * dt
        return np.array([state[0], volume]), state[0] + volume / self.C + self.R * 22.8e-3 * u_in


class KeepsState:
    def reset(self, initial_pressure):
        self.pressure = initial_pressure

    def step(self, u_in, u_out, dt):
        self.pressure += dt
        return self.pressure


class Fresh:
    """No `reset`: made anew for each breath."""

    def __init__(self):
        self.calls = 0

    def step(self, u_in, u_out, dt):
        self.calls += 1
        return float(self.calls)


def test_functions_get_what_they_ask_for(breaths):
    start = breaths.pressure[:, :1]
    R, C = breaths.R[:, None], breaths.C[:, None]
    np.testing.assert_allclose(
        load_simulators(by_names).pressures(breaths),
        start + R * breaths.u_in / 100.0 + C * breaths.dt,
    )
    np.testing.assert_allclose(load_simulators(short).pressures(breaths), 5.0 + breaths.u_in)
    np.testing.assert_allclose(
        load_simulators(of_time_and_flow).pressures(breaths), 5.0 + breaths.time, atol=1e-12
    )
    flow = np.ones_like(breaths.pressure)
    with_flow = dataclasses.replace(breaths, flow=flow)
    answers = load_simulators(of_time_and_flow).pressures(with_flow)
    np.testing.assert_allclose(answers, 6.0 + breaths.time, atol=1e-12)


def test_classes_and_objects_run_sample_by_sample(breaths):
    answers = load_simulators(WithState).pressures(breaths)
    volume = 22.8 * np.cumsum(breaths.u_in * breaths.dt, axis=1)[:, :-1]
    expected = breaths.pressure[:, :1] + volume / breaths.C[:, None]
    expected += breaths.R[:, None] * 22.8e-3 * breaths.u_in[:, :-1]
    np.testing.assert_allclose(answers[:, 1:], expected)
    np.testing.assert_array_equal(answers[:, 0], breaths.pressure[:, 0])
    one = load_simulators(WithState(20.0, 50.0)).pressures(breaths)
    np.testing.assert_allclose(one[0], answers[0])
    for given in (KeepsState, KeepsState()):
        kept = load_simulators(given).pressures(breaths)
        np.testing.assert_allclose(kept, breaths.pressure[:, :1] + breaths.time)
    counted = load_simulators(Fresh).pressures(breaths)
    np.testing.assert_array_equal(counted[1, 1:], np.arange(1, breaths.time.shape[1]))


def test_by_lung(breaths):
    given = {"R20C50": short, "R5C10": KeepsState}
    answers = load_simulators(given).pressures(breaths)
    np.testing.assert_allclose(answers[0], 5.0 + breaths.u_in[0])
    np.testing.assert_allclose(answers[1], breaths.pressure[1, 0] + breaths.time[1])
    with pytest.raises(InputError, match=r"no such lung; they have R20C50"):
        load_simulators({"R20C50": short}).pressures(breaths)


def test_a_short_breath_is_simulated_without_its_padding(breaths):
    valid = breaths.valid.copy()
    valid[0, -10:] = False
    seen = []

    def counts(u_in, u_out, dt):
        seen.append(len(u_in))
        return 5.0 + u_in

    answers = load_simulators(counts).pressures(dataclasses.replace(breaths, valid=valid))
    assert seen == [breaths.time.shape[1] - 10, breaths.time.shape[1]]
    assert np.all(answers[0, -10:] == answers[0, -11])


class NoStep:
    pass


class OddStep:
    def step(self, u_in):
        return 0.0


class ForgetsReset:
    def step(self, u_in, u_out, dt):
        return 0.0


class TwoPressures:
    def init(self, pressure):
        return 0

    def step(self, state, u_in, u_out, dt):
        return 0, [1.0, 2.0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda u_in, dt, valve: u_in, "needs valve, which no simulator is given"),
        (lambda u, v, h: u, r"needs u, v, h, .* called as f\(u_in, u_out, dt"),
        (NoStep, "is a class without `step`"),
        (OddStep, r"step takes 1 arguments; step\(u_in, u_out, dt\) is wanted"),
        (ForgetsReset(), "from breath to breath; give it reset"),
        (TwoPressures, r"pressure of shape \(2,\); one number is wanted"),
        (lambda flow, u_in: u_in, "asks for flow, which the recording does not have"),
    ],
)
def test_messages(breaths, given, message):
    with pytest.raises(InputError, match=message):
        load_simulators(given).pressures(breaths)


@flax.struct.dataclass
class Untraceable:
    """Registered as a pytree, but written in NumPy."""

    R: float

    def init(self, pressure, peep=None):
        return pressure, Signals(pressure)

    def step(self, state, u_in, u_out, dt):
        return state, Signals(float(u_in) * self.R)

    def vary(self, r_scale, c_scale, gain=1.0):
        return self

    def parameters(self):
        return None


def test_a_registered_class_in_numpy_is_told_apart(breaths):
    plant: Any = Untraceable(R=2.0).replace(R=jnp.asarray(2.0))  # type: ignore[attr-defined]
    assert is_jax_plant(plant)
    assert not is_jax_plant(WithState(1.0, 1.0))
    assert not is_jax_plant(WithState)
    with pytest.raises(InputError, match="JAX cannot trace this plant"):
        load_simulators(plant).pressures(breaths)
