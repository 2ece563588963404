"""The compiled grid against the scorer's rollout, one PID after the other."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench import precision, protocol, rollouts
from ventbench.controllers.pid import PID
from ventbench.lungs import LUNGS
from ventbench.metrics.waveform import run_error
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack, take
from ventbench.scenario import nominal
from ventbench.training import pid_grid


def test_the_papers_values():
    gains = pid_grid.gains()
    assert gains.shape == (8000, 3)
    for column in gains.T:
        expected = [*np.arange(10) / 10, *range(1, 11)]
        np.testing.assert_allclose(np.unique(column), expected, atol=1e-12)
    assert len(np.unique(gains, axis=0)) == 8000


def test_an_error_is_that_of_the_scored_run():
    with precision.float64():
        plants = stack([single_compartment(lung) for lung in LUNGS[:2]])
        gains = np.array([(0.0, 0.0, 0.0), (6.0, 6.0, 0.3), (10.0, 10.0, 10.0)])
        cells = nominal(np.array(protocol.PIPS))
        expected = [
            [
                run_error(
                    rollouts.closed_loop(take(plants, lung), PID(*gain), cells)[0].pressure,
                    np.asarray(cells.pip)[:, None, None],
                )
                for gain in gains
            ]
            for lung in range(2)
        ]
    found = pid_grid.errors(plants, gains)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


def test_the_last_batch_may_be_short(monkeypatch):
    plants = stack([single_compartment(LUNGS[0])])
    gains = np.array([(p, 1.0, 0.0) for p in range(5)], float)
    whole, told = pid_grid.errors(plants, gains), []
    monkeypatch.setattr(pid_grid, "BATCH", 2)
    np.testing.assert_allclose(pid_grid.errors(plants, gains, progress=told.append), whole, 1e-6)
    assert told == [12, 24, 30]


def test_best_is_the_least_mean():
    error = np.array([[[1.0, 5.0], [2.0, 2.0]], [[1.0, 1.0], [1.5, 1.5]]])
    assert pid_grid.best(error) == 1
    assert pid_grid.best(error[1:]) == 0


@pytest.mark.slow
def test_the_best_single_set_on_the_frozen_simulators_is_that_of_the_submission():
    from ventbench.plants import frozen

    gains = pid_grid.gains()
    error = pid_grid.errors(frozen.load().plants, gains)
    assert gains[pid_grid.best(error)].tolist() == [6.0, 6.0, 0.3]
