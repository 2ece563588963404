"""The prior of the hierarchical fit: centred on labels and the data sheet, and shared as stated."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ventbench.base.compilation import float64
from ventbench.plants.hybrid import Hybrid
from ventbench.task.lungs import Lung
from ventbench.train.rigs.fit import (
    DIRECTION_SUM,
    SHEET_FLOW,
    TAIL,
    Groups,
    Scales,
    centre,
    direction,
    full_flow,
    heavy_tailed,
    penalty,
    plants,
    stiffening,
)

LABELS = (Lung(5.0, 20.0), Lung(20.0, 20.0), Lung(20.0, 50.0))


@pytest.fixture(scope="module")
def around():
    with float64():
        return centre(LABELS, 4)


def plant_of(around, lung: int) -> Hybrid:
    index = jnp.asarray([lung])
    return plants(around.pooled, Groups(index, jnp.asarray([0]), jnp.asarray([0])))


def test_the_centre_is_the_label_and_the_data_sheet(around):
    with float64():
        for number, label in enumerate(LABELS):
            plant = plant_of(around, number)
            # At 1 L/s the two parts of the resistance add up to the label.
            assert float(plant.R[0] + plant.K2[0]) == pytest.approx(label.R)
            assert 1000.0 / float(plant.E[0]) == pytest.approx(label.C)
            assert float(plant.valve(jnp.asarray([100.0]))[0]) == pytest.approx(SHEET_FLOW)
        assert float(jnp.exp(full_flow(around.pooled))) == pytest.approx(SHEET_FLOW)


def test_tails_are_those_of_students_t():
    values = np.array([-4.0, 0.3, 2.0])
    expected = -stats.t.logpdf(values, TAIL) + stats.t.logpdf(0.0, TAIL)
    with float64():
        for value, negative_log in zip(values, expected, strict=True):
            assert float(heavy_tailed(jnp.asarray(value))) == pytest.approx(negative_log)


def test_a_rig_far_from_its_label_costs_less_than_a_lung(around):
    """Heavy tails: it is the rig that moves, not what the rigs of a lung share."""
    with float64():
        scales, least = Scales(), penalty(around.pooled, around, Scales())
        rig = jnp.zeros(4).at[2].set(0.6)
        alone = penalty(replace(around.pooled, session_E=rig), around, scales) - least
        lung = around.pooled.E.at[1].add(0.6)
        together = penalty(replace(around.pooled, E=lung), around, scales) - least
    assert 0.0 < float(alone) < 0.5 * float(together)


def test_lungs_of_one_label_share_their_spring_and_their_resistor(around):
    """Moving both lungs of a label costs less than twice what moving one costs."""
    with float64():
        scales, least = Scales(), penalty(around.pooled, around, Scales())

        def cost(name: str, lungs: list[int]) -> float:
            moved = getattr(around.pooled, name).at[jnp.asarray(lungs)].add(0.2)
            return float(penalty(replace(around.pooled, **{name: moved}), around, scales) - least)

        assert cost("E", [0, 1]) < 1.9 * cost("E", [0])
        assert cost("R", [1, 2]) < 1.9 * cost("R", [1])
        assert cost("E", [0, 2]) == pytest.approx(cost("E", [0]) + cost("E", [2]))


def test_constraints_hold_for_any_parameters(around):
    rng = np.random.default_rng(0)
    with float64():
        for _ in range(5):
            pooled = jax.tree.map(
                lambda x: x + jnp.asarray(rng.normal(size=x.shape) * 3.0), around.pooled
            )
            weights = direction(pooled)
            assert (weights <= 0).all()
            assert (weights.sum(axis=-1) >= -DIRECTION_SUM).all()
            # The elastic curve rises everywhere: its slope stays positive past every knot.
            assert (1.0 + jnp.cumsum(stiffening(pooled), axis=-1) > 0).all()
            least = penalty(around.pooled, around, Scales())
            assert float(penalty(pooled, around, Scales())) > float(least)
