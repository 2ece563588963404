"""The bound where it is known in closed form, and against a second optimiser where it is not."""

import jax
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.task import attainable
from ventbench.task.attainable import second_optimum
from ventbench.task.environment import nominal_scenario
from ventbench.task.lungs import LUNGS

PIPS = (10.0, 20.0, 35.0)


def lungs_and_cells(delay=0.0):
    """The six textbook lungs at three PIPs, as 18 cells."""
    with compilation.float64():
        plants = stack([single_compartment(lung) for lung in LUNGS for _ in PIPS])
        cells = nominal_scenario(np.tile(PIPS, len(LUNGS)))
        delays = np.full(len(LUNGS) * len(PIPS), delay)
        cells = cells.replace(delay=delays)  # type: ignore[attr-defined]
        return jax.tree.map(np.asarray, (plants, cells))


@pytest.fixture(scope="module")
def exact():
    plants, cells = lungs_and_cells()
    return plants, cells, attainable.attainable(plants, cells, starts=(1,))


def test_without_dead_time_the_rise_is_all_that_is_lost(exact):
    # A command sets the next pressure of this lung at will, up to the valve's end: open it fully
    # until PIP is in reach, then hold PIP exactly.
    _, _, found = exact
    np.testing.assert_allclose(found.error, found.lower, atol=1e-9)
    assert found.lower.max() > 0.3


def test_the_rise_by_hand(exact):
    plants, cells, found = exact
    flow = 22.8 * 100.0 / 1000.0
    for k in (0, 10, 17):
        alveolar, error = 5.0, 0.0
        for _ in range(attainable.COMMANDS):
            alveolar += flow * 0.03 / (float(plants.C[k]) / 1000.0)
            error += max(float(cells.pip[k]) - alveolar - float(plants.R[k]) * flow, 0.0)
        assert found.lower[k] == pytest.approx(error / attainable.COMMANDS, abs=1e-9)


def test_commands_attain_the_error_and_stay_in_range(exact):
    plants, cells, found = exact
    assert np.all((found.commands >= 0.0) & (found.commands <= 100.0))
    with compilation.float64():
        pressure = attainable.pressures(plants, cells, found.commands)
    error = np.abs(pressure - cells.pip[:, None]).mean(axis=1)
    np.testing.assert_allclose(error, found.error, atol=1e-12)
    np.testing.assert_allclose(found.stationarity, 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_second_optimiser_finds_nothing_better():
    plants, cells = lungs_and_cells(delay=0.5)
    found = attainable.attainable(plants, cells)
    second = second_optimum(plants, cells)
    assert np.all(found.error < second + 1e-3)
    assert np.mean(second - found.error) < 0.1  # and it is no straw man
    assert np.all(found.error > found.lower - 1e-9)
