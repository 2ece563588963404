"""Stressed plants: nothing without a stressor, and what the physics says with one."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

from ventbench.base import precision
from ventbench.plants import frozen
from ventbench.plants.corrected import Corrected
from ventbench.plants.hybrid import VALVE_KNOTS
from ventbench.stress.plants import reference_physics, stressed_plants
from ventbench.stress.run import StressDraws
from ventbench.stress.score import StressScore
from ventbench.stress.stressors import Condition, conditions
from ventbench.task.lungs import LUNGS
from ventbench.task.metrics.score import run_error


def _of(score: StressScore, name: str) -> int:
    return [condition.id for condition in score.conditions].index(name)


def test_reference_physics_has_the_rigs_own_parameters() -> None:
    rigs = frozen.load().plants
    reference = reference_physics(rigs, LUNGS)
    np.testing.assert_allclose(reference["C"], 1e3 / np.asarray(rigs.E))
    # The valve at 12 %, by the slopes between its knots.
    width = np.clip(12.0 - np.array(VALVE_KNOTS), 0.0, np.append(np.diff(VALVE_KNOTS), np.inf))
    flow = np.asarray(rigs.slopes) @ width
    effective = 12.0 + reference["valve_shape.c4"]
    np.testing.assert_allclose(1e-3 * reference["gain"] * effective, flow)


def test_a_condition_changes_its_parameters_in_its_breaths_only() -> None:
    rigs = jax.tree.map(lambda leaf: leaf[:, None], frozen.load().plants)
    every = conditions()
    stressed = stressed_plants(rigs, LUNGS, every).physics
    names = stressed.names

    def change(path: str, name: str) -> np.ndarray:
        at, k = names.index(path), [c.id for c in every].index(name)
        values = np.asarray(stressed.values[at]).reshape(len(every), 6, 3, 2)[k]
        after, before = values[..., 0].T, values[..., 1].T
        return after / before if path in ("R", "C") else after - before

    np.testing.assert_allclose(change("leak.conductance", "leak:mild"), 20.0)
    np.testing.assert_allclose(change("leak.conductance", "none"), 0.0)
    np.testing.assert_allclose(change("R", "secretions:strong")[:, 2], [1.0, 3.0, 3.0**0.5])
    np.testing.assert_allclose(change("C", "low_compliance:strong")[0], [0.8, 0.4, 0.16] * 2)
    both = "leak+high_resistance:mild"
    np.testing.assert_allclose(change("leak.conductance", both), 20.0)
    np.testing.assert_allclose(change("R", both)[0], [7.0] * 3 + [1.75] * 3)


def test_nothing_is_changed_without_a_stressor(
    score: StressScore, draws: StressDraws, chosen: tuple[Condition, ...]
) -> None:
    """The same commands on the scored rig alone give the same pressures."""
    from ventbench.controllers.script import Script
    from ventbench.task import environment, rollouts

    with precision.float64():
        plant, cells = jax.tree.map(
            lambda leaf: jax.numpy.asarray(leaf, float), (draws.plants, draws.scenario)
        )
        commands = score.requested[0].reshape(6, 1, -1)
        varied: Any = environment.vary(plant, cells)
        assert float(varied.R[0, 0]) != np.asarray(jax.tree.leaves(draws.plants)[0])[0, 0]
        alone, _ = rollouts.closed_loop(plant, Script(commands), cells)
    pressure = np.asarray(alone.pressure)
    np.testing.assert_allclose(score.peak[0], pressure.max(axis=(-2, -1)), rtol=0, atol=1e-9)
    error = run_error(pressure, np.asarray(cells.pip)[..., None, None])
    np.testing.assert_allclose(score.error[0], error, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_it_is_the_rule_of_the_corrected_simulator(
    draws: StressDraws, chosen: tuple[Condition, ...]
) -> None:
    """Without a sensor's error, a stressed plant is scored plant + (with - without)."""
    from ventbench.stress.run import flat

    leaks = [k for k, condition in enumerate(chosen) if "sensor_low" not in condition.stressors]
    with precision.float64():
        plants, cells = flat(draws, [chosen[k] for k in leaks])
        # Of breath 2, in which the tube comes off.
        own = jax.tree.map(lambda leaf: leaf[:, 1], plants)
        own = jax.vmap(lambda plant, r, c: plant.vary(r, c))(own, cells.r_scale, cells.c_scale)
        parts = (jax.tree.map(lambda leaf, k=k: leaf[:, k], own.physics) for k in (0, 1))
        corrected = Corrected(own.simulator, *parts)

        def shown(plant: Any, cell: Any) -> Any:
            state, _ = plant.init(cell.start, cell.peep)
            readings = []
            for u_in in (40.0, 20.0):
                held = jax.numpy.full_like(cell.start, u_in)
                state, signals = plant.step(state, held, 0.0 * held, cell.dt)
                readings.append(signals.reading)
            return readings

        stressed, expected = (jax.vmap(shown)(plant, cells) for plant in (own, corrected))
        np.testing.assert_allclose(stressed, expected, rtol=0, atol=1e-9)


def test_stressors_act_as_a_person_expects(score: StressScore) -> None:
    error = score.error.mean(axis=(1, 2))
    assert error[_of(score, "leak:strong")] > error[_of(score, "leak:mild")] > error[0]
    # A sensor that shows 3 cmH2O too little lets the controller deliver more.
    plus = score.volume_ratio[_of(score, "sensor_low:strong")]
    assert np.all(plus > 1.02)
    # A tube that is off cannot hold a pressure, and the lung empties.
    off = _of(score, "disconnection:strong")
    assert error[off] > 1.5 * error[0]
    assert np.median(score.volume_ratio[off]) < 0.7


@pytest.mark.parametrize("name", ["R", "C", "gain"])
def test_other_plants_are_compared_with_their_label(name: str) -> None:
    from ventbench.plants.single_compartment import single_compartment
    from ventbench.plants.stacking import stack

    reference = reference_physics(stack([single_compartment(lung) for lung in LUNGS]), LUNGS)
    expected = {"R": [5, 5, 5, 20, 20, 20], "C": [10, 20, 50] * 2}.get(name)
    if expected is None:
        assert name not in reference
    else:
        np.testing.assert_array_equal(reference[name], expected)
