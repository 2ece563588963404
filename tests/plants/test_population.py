"""Rigs that are drawn: numbers and plants of one another, constraints, and the seed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.plants.hybrid import (
    DIRECTION_SUM,
    FLOW,
    NAMES,
    from_vector,
    load_population,
    to_vector,
)
from ventbench.plants.rigs import load_rigs
from ventbench.task import draws, protocol
from ventbench.task.lungs import LUNGS
from ventbench.task.rollouts import open_loop

SEED = bytes(range(32))


@pytest.fixture(scope="module")
def official():
    return frozen.load()


def test_numbers_of_a_rig_give_it_back(official):
    for xp in (np, jnp):
        with compilation.float64():
            back = from_vector(to_vector(official.members), xp)
        for name, leaf in vars(official.members).items():
            np.testing.assert_allclose(getattr(back, name), leaf, rtol=1e-9, atol=1e-12)


def test_whatever_is_drawn_is_a_rig():
    numbers = 4.0 * np.random.default_rng(0).standard_normal((2000, len(NAMES)))
    rig = from_vector(numbers, np)
    for name in ("R", "K2", "E", "slopes", "valve_delay", "valve_lag", "sensor_lag", "conductance"):
        assert np.all(getattr(rig, name) > 0.0)
    assert np.all(rig.direction.sum(axis=-1) > -DIRECTION_SUM)
    assert np.all(1.0 + np.cumsum(rig.stiffening, axis=-1) > 0.0)


def test_draws_follow_mean_and_covariance(official):
    fitted = official.population
    rigs = to_vector(fitted.rigs(SEED, 2, 3000))
    z = np.linalg.solve(fitted.factor[2], (rigs - fitted.mean[2]).T)
    # Means and covariance of standard normal numbers, by 4.5 standard errors.
    assert np.abs(z.mean(axis=1)).max() < 4.5 / np.sqrt(3000)
    assert np.abs(np.cov(z) - np.eye(len(NAMES))).max() < 4.5 * np.sqrt(2 / 3000)


def test_more_rigs_begin_with_the_same_and_another_seed_gives_others(official):
    few, many = official.population.rigs(SEED, 0, 3), official.population.rigs(SEED, 0, 9)
    other = official.population.rigs(bytes(32), 0, 3)
    for name, leaf in vars(few).items():
        np.testing.assert_array_equal(leaf, getattr(many, name)[:3])
        assert not np.array_equal(leaf, getattr(other, name))
        # Six significant digits, the same wherever they are printed.
        assert all(
            f"{x:.5e}" == f"{float(f'{x:.5e}'):.5e}"
            and np.isclose(x, float(f"{x:.5e}"), rtol=1e-12)
            for x in np.ravel(leaf)
        )


def test_drawn_rigs_are_lungs_of_their_label_and_rise_with_the_command(official):
    steps = 34
    u_in = np.repeat(np.linspace(8.0, 60.0, 5), 3)[:, None] * np.ones(steps)
    for lung, settings in enumerate(official.lungs().values()):
        rigs = official.population.rigs(SEED, lung, 60)
        assert np.median(1000.0 / rigs.E) == pytest.approx(settings["C"], rel=0.25)
        # Fitted rigs of one labelled resistor differ by 20 %.
        same = [
            own for own, other in zip(official.rigs, LUNGS, strict=True) if settings["R"] == other.R
        ]
        fitted = (official.members.R[0] + FLOW * official.members.K2[0])[np.concatenate(same)]
        resistance = np.median(rigs.R + FLOW * rigs.K2)
        assert resistance == pytest.approx(np.median(fitted), rel=0.25)
        three = jax.tree.map(lambda x: np.tile(x[:3], (5,) + (1,) * (x.ndim - 1)), rigs)
        with compilation.float64():
            zeros, dt = np.zeros((15, steps)), np.full((15, steps), protocol.DT)
            arrays = jax.tree.map(jnp.asarray, (three, np.full(15, 5.0), u_in, zeros, dt))
            final = np.asarray(open_loop(*arrays))[:, -1].reshape(5, 3)
        assert np.isfinite(final).all()
        assert np.all(np.diff(final, axis=0) > 0.0)


def test_left_out_sessions_lie_where_the_population_says(official):
    about = official.manifest["population"]
    assert sorted(about["sessions"]) == sorted(rig for rigs in official.rigs for rig in rigs)
    # 90 % regions: as many are inside as a binomial number of that mean is in 99 % of cases.
    inside = np.array(about["left_out"]) < 0.9
    assert np.count_nonzero(inside) >= binom.ppf(0.01, len(inside), 0.9)
    assert 0.10 <= about["gain_deviation"] <= 0.14
    assert about["gain_quantiles"] == list(draws.GAIN_QUANTILES)


def test_ranked_draws_are_on_rigs_that_nobody_trained_on():
    rigs: Any = load_rigs()
    drawn = rigs.draws(draws.COUNT, seed=SEED, name="practice")
    for lung in range(6):
        ranked, others = drawn.rig[lung, drawn.ranked], drawn.rig[lung, ~drawn.ranked]
        anew = ranked >= draws.FIRST_DRAWN
        assert np.count_nonzero(anew) == 10
        assert len(set(ranked[anew])) == 10
        assert set(ranked[~anew]) == set(rigs.held_out[lung])
        assert set(others) <= set(rigs.sessions[lung]) - set(rigs.held_out[lung])
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    own = rigs.population.rigs(SEED, 3, draws.COUNT)
    at = np.flatnonzero(drawn.rig[3] >= draws.FIRST_DRAWN)
    np.testing.assert_array_equal(plants.E[3, 1 + at, 0], own.E[at])
    held = np.flatnonzero(drawn.ranked & (drawn.rig[3] < draws.FIRST_DRAWN))
    expected = rigs.plants.E[drawn.member[3, held], drawn.rig[3, held]]
    np.testing.assert_array_equal(plants.E[3, 1 + held, 0], expected)
    # A rig has its own R, C and delay: nothing is added to them.
    for name in ("r_scale", "c_scale"):
        assert np.all(getattr(cells, name) == 1.0)
    assert np.all(cells.delay == 0.0)
    assert drawn.first(3).rig.tolist() == drawn.rig[:, :3].tolist()


def test_tuning_sees_training_rigs_alone():
    rigs = load_rigs().of_training
    drawn = rigs.draws(draws.COUNT)
    official = frozen.load()
    for own, training in zip(drawn.rig, official.training_rigs, strict=True):
        assert set(own) == set(training)


def test_what_is_no_population_is_refused(tmp_path):
    with pytest.raises(InputError, match="not a population"):
        load_population(tmp_path / "missing.npz")
    np.savez(tmp_path / "other.npz", mean=np.zeros((2, 3)), factor=np.zeros((2, 3, 3)))
    with pytest.raises(InputError, match="3"):
        load_population(tmp_path / "other.npz")
