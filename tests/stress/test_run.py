"""Cells and loop: paired draws, hidden stress, and one score by two ways."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import precision
from ventbench.controllers.pid import PID
from ventbench.plants import frozen
from ventbench.plants.rigs import load_rigs, rigs_of
from ventbench.stress.run import StressDraws, draw_cells, flat
from ventbench.stress.score import StressScore
from ventbench.stress.stressors import Condition
from ventbench.task import protocol, rollouts
from ventbench.task.metrics.score import run_error


def scanned(plants: Any, gains: PID, scenario: Any) -> Any:
    """Inspirations of all cells in one compiled scan."""

    def run(plant: Any, cell: Any) -> Any:
        return rollouts.closed_loop(plant, gains, cell, changing=True)[0]

    return jax.vmap(run)(plants, scenario)


def test_draws_cover_every_pip_on_every_lung_and_are_those_of_the_protocol() -> None:
    official = frozen.load()
    rigs = rigs_of(official)
    six, two = draw_cells(rigs, 6), draw_cells(rigs, 2)
    for pips in six.nominal_pip:
        assert sorted(pips) == list(protocol.PIPS)
    assert all(len(set(column)) == 6 for column in six.nominal_pip.T)
    np.testing.assert_array_equal(six.scenario.noise[:, :2], two.scenario.noise)
    drawn = rigs.draws(6)
    at = protocol.PIPS.index(six.nominal_pip[4, 3])
    assert six.scenario.r_scale[4, 3] == drawn.cells.r_scale[4, 3, at]
    expected = official.sessions_plants.R[drawn.member[4, 3], drawn.rig[4, 3]]
    plants: Any = six.plants
    assert plants.R[4, 3] == expected


@pytest.mark.slow
def test_the_scan_and_the_steps_give_the_same_score(
    score: StressScore, draws: StressDraws, chosen: tuple[Condition, ...]
) -> None:
    with precision.float64():
        plants, scenario = flat(draws, chosen)
        gains = PID(jnp.asarray(2.0), jnp.asarray(4.0), jnp.asarray(0.0))
        run = scanned(plants, gains, scenario)
        pressure, requested = run.pressure, run.requested
    pip = np.asarray(scenario.pip)[:, None, None]
    error = run_error(np.asarray(pressure), pip).reshape(score.error.shape)
    np.testing.assert_allclose(error, score.error, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        np.asarray(requested).reshape(score.requested.shape), score.requested, rtol=0, atol=1e-7
    )


@pytest.mark.slow
def test_every_condition_is_finite_and_differs_from_none() -> None:
    from ventbench.stress.stressors import conditions

    every, draws = conditions(), draw_cells(load_rigs(), 1)
    with precision.float64():
        plants, scenario = flat(draws, every)
        gains = PID(*(jnp.asarray(gain) for gain in (6.0, 6.0, 0.3)))
        run = scanned(plants, gains, scenario)
        pressure, volume = run.pressure, run.volume
    pressure, volume = (np.asarray(x).reshape(len(every), -1) for x in (pressure, volume))
    assert np.isfinite(pressure).all()
    assert np.isfinite(volume).all()
    assert pressure.min() > -20.0
    assert pressure.max() < 90.0
    for condition, own in zip(every[1:], pressure[1:], strict=True):
        assert np.abs(own - pressure[0]).max() > 1e-3, condition.id
