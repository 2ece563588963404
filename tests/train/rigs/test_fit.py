"""Fitting the rigs: known lungs are found again, and what has no weight is not looked at."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench import simulation
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.plants.stacking import open_loop_breaths
from ventbench.recordings import join
from ventbench.task.lungs import RECORDED_LUNGS, lung
from ventbench.train.rigs.data import SAMPLES, complete_breaths, groups_of, inspirations
from ventbench.train.rigs.fit import (
    CHUNK,
    EXPIRATORY_WIDTHS,
    FitConfig,
    centre,
    fit,
    fit_expiration,
    plants,
)

THREE = tuple(lung(name) for name in ("R5C10", "R20C20", "R20C50"))
CONFIG = FitConfig(iterations=5 * CHUNK)


def equal(a, b) -> bool:
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) for x, y in leaves)


@pytest.fixture(scope="module")
def measured(make_synthetic):
    return make_synthetic(THREE, each=6)


@pytest.fixture(scope="module")
def reconstructed(make_synthetic):
    """Inspirations whose first pressure is unknown, as in the public file."""
    breaths = make_synthetic(THREE, each=2, seed=1, first_id=100)
    pressure = np.where(breaths.inspiratory, breaths.pressure, np.nan)
    pressure[:, 0] = np.nan
    return replace(breaths, pressure=pressure)


@pytest.fixture(scope="module")
def around(known_sessions):
    with float64():
        return centre(RECORDED_LUNGS, len(known_sessions))


#: Every third measured breath has no weight; all reconstructed ones have 0.4.
WEIGHT = np.append(1.0 * (np.arange(18) % 3 != 1), np.full(6, 0.4))


def fitted_to(measured, reconstructed, sessions, around, progress=lambda share: None):
    with float64():
        data = inspirations(join([measured, reconstructed]), sessions, RECORDED_LUNGS)
        return fit(data, jnp.asarray(WEIGHT), around, config=CONFIG, progress=progress).pooled


@pytest.fixture(scope="module")
def fitted(measured, reconstructed, known_sessions, around):
    told = []
    pooled = fitted_to(measured, reconstructed, known_sessions, around, told.append)
    assert told == [0.2, 0.4, 0.6, 0.8, 1.0]
    return pooled


def mean_errors(pooled, breaths, sessions):
    def of(part):
        return plants(pooled, groups_of(part, sessions, RECORDED_LUNGS))

    return simulation.open_loop_errors(of, breaths)


def test_finds_known_lungs_again(fitted, around, make_synthetic, known_sessions):
    """On breaths it has not seen."""
    new = make_synthetic(THREE, each=8, seed=2)
    with float64():
        before = mean_errors(around.pooled, new, known_sessions)
    after = mean_errors(fitted, new, known_sessions)
    assert before.mean() > 1.0
    assert after.mean() < 0.1 * before.mean()


def test_finds_the_expiratory_valve(true_parameters, around, measured, known_sessions):
    """The second stage changes what its list names, and expirations come nearer."""
    with float64():
        whole = complete_breaths(measured, known_sessions, RECORDED_LUNGS)
        known = {name: getattr(around.pooled, name) for name in EXPIRATORY_WIDTHS}
        start = replace(true_parameters, **known)
        refitted = fit_expiration(start, whole, jnp.ones(len(measured)))
        expired = (measured.u_out == 1) & measured.valid

        def error(pooled):
            plant = plants(pooled, groups_of(measured, known_sessions, RECORDED_LUNGS))
            p = open_loop_breaths(lambda _: plant, measured)
            return np.abs(p - measured.pressure)[expired].mean()

        assert error(refitted) < 0.2 * error(start)
    for name in vars(start):
        if name not in EXPIRATORY_WIDTHS:
            assert equal(getattr(refitted, name), getattr(start, name)), name


def test_what_has_no_weight_has_no_influence_at_all(
    fitted, measured, reconstructed, known_sessions, around
):
    """On what the rigs share; the same training twice is the same to the bit."""
    pressure = measured.pressure.copy()
    pressure[1::3] = pressure[1::3][::-1] * 2.0 + 3.0
    other = replace(measured, pressure=pressure)
    assert equal(fitted_to(other, reconstructed, known_sessions, around), fitted)
    pressure = measured.pressure.copy()
    pressure[0, 5] += 1.0
    other = replace(measured, pressure=pressure)
    assert not equal(fitted_to(other, reconstructed, known_sessions, around), fitted)


def test_sessions_without_breaths_stay_at_what_the_lungs_share(fitted, known_sessions):
    seen = {known_sessions.table.index(s) for s in known_sessions.table if lung(s.lung) in THREE}
    gain = np.asarray(fitted.session_gain)
    assert (gain[[*seen]] != 0.0).all()
    assert (np.delete(gain, [*seen]) == 0.0).all()


def test_inspirations_are_arranged(measured, reconstructed, known_sessions):
    both = join([measured, reconstructed])
    with float64():
        data = jax.tree.map(np.asarray, inspirations(both, known_sessions, RECORDED_LUNGS))
    n, m = len(measured), len(reconstructed)
    assert data.u_in.shape == data.dt.shape == data.pressure.shape == (n + m, SAMPLES - 1)
    np.testing.assert_array_equal(data.start_measured, [1.0] * n + [0.0] * m)
    np.testing.assert_array_equal(data.start[:n], measured.pressure[:, 0])
    # The command of sample i leads to the pressure of sample i + 1; 29 of 30 samples count.
    np.testing.assert_array_equal(data.u_in[:n, 3], measured.u_in[:, 3])
    np.testing.assert_array_equal(data.pressure[:n, 3], measured.pressure[:, 4])
    np.testing.assert_allclose(data.share.sum(axis=1), 1.0)
    np.testing.assert_array_equal((data.share > 0).sum(axis=1), 29)
    assert (data.pressure[:, 29:] == 0.0).all()


def test_breaths_that_cannot_be_learned_from_are_named(measured, known_sessions):
    pressure = measured.pressure.copy()
    pressure[4, 1:30] = np.nan
    with pytest.raises(InputError, match="breath 5 has no inspiratory pressure"):
        inspirations(replace(measured, pressure=pressure), known_sessions, RECORDED_LUNGS)


def test_a_breath_without_start_or_expiration_tells_nothing_of_the_expiratory_valve(
    measured, known_sessions
):
    pressure = measured.pressure.copy()
    pressure[0, 0] = np.nan
    pressure[1, 30:] = np.nan
    pressure[2, 40] = np.nan
    with float64():
        data = complete_breaths(
            replace(measured, pressure=pressure), known_sessions, RECORDED_LUNGS
        )
        share = np.asarray(data.share)
    np.testing.assert_allclose(share[:4].sum(axis=1), [0, 0, 2, 2])
    assert share[2, 40] == 0.0
