"""Stressed plants: nothing without a stressor, and what the physics says with one."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ventbench.plants import frozen
from ventbench.plants.corrected import reference_physics, stressed_plants
from ventbench.plants.hybrid import VALVE_KNOTS
from ventbench.task.lungs import LUNGS
from ventbench.task.stressors import conditions


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
    rigs = jax.tree.map(lambda leaf: leaf[None, :, None], frozen.load().plants)
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


@pytest.mark.parametrize("name", ["R", "C", "gain"])
def test_other_plants_say_their_own(name: str) -> None:
    from ventbench.plants.single_compartment import VALVE_GAIN, single_compartment
    from ventbench.plants.stacking import stack

    reference = reference_physics(stack([single_compartment(lung) for lung in LUNGS]), LUNGS)
    expected = {"R": [5, 5, 5, 20, 20, 20], "C": [10, 20, 50] * 2, "gain": [VALVE_GAIN] * 6}
    np.testing.assert_allclose(reference[name], expected[name])
