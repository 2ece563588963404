from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.plants.two_balloon import BALLOON_PRESSURE, PEAK, SUPPLY_PRESSURE, two_balloon
from ventbench.task.lungs import lung


@pytest.mark.parametrize("pressure", [-5.0, 0.0, 5.0, 35.0, 59.0])
def test_starts_at_the_pressure_asked_for(pressure):
    with float64():
        plant = two_balloon(lung("R5C10"))
        state, _ = plant.init(jnp.asarray(pressure))
        assert float(plant.alveolar(state.volume)) == pytest.approx(pressure, abs=1e-9)


def test_compliance_at_rest_is_the_labels():
    plant = two_balloon(lung("R5C20"))
    volume = 2 * BALLOON_PRESSURE * 20.0  # mL
    slope = jax.grad(plant.alveolar)(jnp.asarray(1.0)) / volume
    assert float(1 / slope) == pytest.approx(20.0, rel=1e-5)


def test_peak_is_where_the_paper_has_it():
    plant = two_balloon(lung("R5C20"))
    x = jnp.linspace(1.0, 8.0, 20001)
    p = np.asarray(plant.alveolar(x))
    assert p.max() == pytest.approx(PEAK * BALLOON_PRESSURE, rel=1e-5)
    assert float(x[p.argmax()]) == pytest.approx(7**0.5, abs=0.02)


def test_saturates_at_the_supply():
    plant = two_balloon(lung("R20C10"))
    state, _ = plant.init(jnp.asarray(5.0))
    step = jax.jit(lambda s: plant.step(s, jnp.asarray(100.0), jnp.asarray(0.0), jnp.asarray(0.03)))
    for _ in range(3000):
        state, signals = step(state)
    assert float(signals.reading) == pytest.approx(60.0, abs=0.1)


def test_the_supply_ends_on_the_rising_branch_of_the_balloon():
    assert SUPPLY_PRESSURE < 0.95 * PEAK * BALLOON_PRESSURE
