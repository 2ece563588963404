"""A sensor behind a simulator that nobody can describe."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from proofs.real.parts import lagged
from ventbench.base import compilation
from ventbench.diagnosis.corrected import behind_sensor
from ventbench.diagnosis.sensor_behind import SensorBehind, find_sensor
from ventbench.physics import physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.sensed import readings, sensor
from ventbench.plants.single_compartment import single_compartment
from ventbench.system_id import make_data
from ventbench.system_id.data import Data
from ventbench.task.lungs import lung
from ventbench.task.rollouts import open_loop

from . import small

TAU = 0.05
BREATHS = small.made(noise=0.0)
#: Slow errors of each breath, which no mechanism of the library makes.
ODD = np.cumsum(np.random.default_rng(3).normal(0.0, 0.1, BREATHS.pressure.shape), axis=1)


def looked_for(
    recorded: np.ndarray, response: np.ndarray, *rivals: np.ndarray
) -> SensorBehind | None:
    data: Data = make_data(BREATHS).with_pressure(recorded)
    return find_sensor(
        data, small.HELD, np.ones(small.BREATHS, bool), response, rivals, small.SETTINGS
    )


def lag_of(pressure: np.ndarray, seed: int = 0) -> np.ndarray:
    """Pressures through a lag that shares no code with the library, with noise."""
    slow = np.stack([lagged(t, p, TAU) for t, p in zip(BREATHS.time, pressure, strict=True)])
    return slow + np.random.default_rng(seed).normal(0.0, 0.1, slow.shape)


def test_a_lag_behind_any_simulator_is_named_with_its_size():
    response = BREATHS.pressure
    found = looked_for(lag_of(response) + ODD, response, response)
    assert found is not None
    assert found.name == "sensor_lag"
    low, high = found.missing((found.error, 0.0)).parameters["tau"].ci95
    assert low < TAU < high < 1.4 * TAU
    assert found.confidence > 0.9
    shown = found.readings(response, BREATHS.dt)
    assert np.mean((shown - lag_of(response)) ** 2) < 0.1 * np.mean(
        (response - lag_of(response)) ** 2
    )


def test_a_simulator_that_is_right_has_no_sensor_behind():
    rng = np.random.default_rng(1)
    recorded = BREATHS.pressure + ODD + rng.normal(0.0, 0.1, ODD.shape)
    assert looked_for(recorded, BREATHS.pressure, BREATHS.pressure) is None


def test_what_explains_the_recording_as_well_is_preferred():
    recorded = lag_of(BREATHS.pressure)
    rival = recorded + np.random.default_rng(2).normal(0.0, 0.1, recorded.shape)
    assert looked_for(recorded, BREATHS.pressure, rival) is None


def test_a_trifle_beside_larger_errors_is_no_finding_though_all_rivals_are_worse():
    """A lag of 6 ms passes the test of likelihood beside 2 cmH2O, and hardly changes them."""
    rng, response = np.random.default_rng(4), BREATHS.pressure
    slow = np.stack([lagged(t, p, 0.006) for t, p in zip(BREATHS.time, response, strict=True)])
    recorded = slow + 4.0 * ODD + rng.normal(0.0, 0.02, slow.shape)
    assert looked_for(recorded, response, response + 9.0) is None


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_another_lung_is_no_sensor(factor):
    """The pressures of a lung with another compliance, of which a refit knows."""
    start = BREATHS.pressure[:, :1]
    recorded = start + factor * (BREATHS.pressure - start)
    assert looked_for(recorded, BREATHS.pressure, recorded + 0.3) is None


def test_plants_of_all_stages_run_together_and_answer_as_they_should():
    label = lung("R20C50")
    beside = {"supply_droop": {"drop": 0.2}}
    with compilation.float64():
        plant = Corrected(single_compartment(label), physics(label, beside), physics(label, beside))
        lungs = (physics(label), physics(lung("R5C50")))
        behind = sensor({"sensor_lag.tau": 0.06})
        stages = {
            stage: behind_sensor(plant, behind, stage, lungs)
            for stage in ("before", "refit", "after")
        }
        commands = (jnp.full((1, 30), x) for x in (20.0, 0.0, 0.03))
        u_in, u_out, dt = commands
        answers = {
            name: np.asarray(open_loop(one, jnp.full((1,), 5.0), u_in, u_out, dt))
            for name, one in (stages | {"given": plant.simulator, "other": lungs[1]}).items()
        }
        shown = np.asarray(readings(behind, answers["given"], dt))
    assert len({jax.tree.structure(one) for one in stages.values()}) == 1
    np.testing.assert_allclose(answers["before"], answers["given"], atol=1e-6)
    np.testing.assert_allclose(answers["after"], shown, atol=1e-6)
    np.testing.assert_allclose(answers["refit"], answers["other"], atol=0.2)
