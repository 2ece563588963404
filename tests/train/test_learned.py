from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.plants.learned import Architecture
from ventbench.plants.single_compartment import single_compartment
from ventbench.task.lungs import lung
from ventbench.task.rollouts import open_loop
from ventbench.train.learned import (
    LearnedConfig,
    expiratory_time_constant,
    fit,
    horizon,
    inspirations,
)
from ventbench.train.residual import CHUNK

SHAPE = Architecture(pressures=3, controls=4, width=24, depth=3, boundary_width=8)
#: Shared, so that it is compiled once.
LONG = LearnedConfig(steps=600)
SHORT = LearnedConfig(steps=2 * CHUNK + 20, batch=8)
T = 31
OFF = (jnp.asarray(1.05), jnp.asarray(0.95))


def recordings(count: int, intervals=(0.0319, 0.0340), seed=0):
    """Breaths of a textbook lung under random held commands: u_in, u_out, dt, pressure."""
    rng = np.random.default_rng(seed)
    dt = rng.choice(intervals, (count, 1)) * (1 + 0.005 * rng.standard_normal((count, T)))
    u_in = np.repeat(18 * rng.uniform(size=(count, T)) ** 2, 4, axis=1)[:, :T]
    start, closed = 5 + rng.uniform(-1, 2, count), np.zeros((count, T))
    pressure = open_loop(single_compartment(lung("R20C20")), start, u_in, closed, dt)
    return u_in, closed, dt, np.asarray(pressure, float)


def error(plant, data) -> float:
    u_in, u_out, dt, pressure = data
    return float(np.abs(open_loop(plant, pressure[:, 0], u_in, u_out, dt) - pressure).mean())


def equal(a, b) -> bool:
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.fixture(scope="module")
def trained():
    return fit(*recordings(60), architecture=SHAPE, config=LONG)


@pytest.mark.parametrize("interval", [0.0319, 0.034, 0.030])
def test_learns_a_textbook_lung_at_every_interval(trained, interval):
    assert error(trained, recordings(30, (interval,), seed=1)) < 0.3


def test_varies_like_the_textbook_lung(trained):
    u_in, u_out, dt, pressure = recordings(30, (0.03,), seed=1)
    start = pressure[:, 0]
    off = open_loop(single_compartment(lung("R20C20")).vary(*OFF), start, u_in, u_out, dt)
    mine = open_loop(trained.vary(*OFF), start, u_in, u_out, dt)
    assert float(jnp.abs(mine - off).mean()) < 0.35


@pytest.mark.slow
def test_is_reproducible_and_seeds_differ():
    data = recordings(10)
    one, again, other = (fit(*data, architecture=SHAPE, config=SHORT, seed=s) for s in (3, 3, 4))
    assert equal(one, again)
    assert not equal(one, other)


def test_resumes_to_the_same_bits_after_ctrl_c(tmp_path):
    data, path = recordings(10), tmp_path / "training.npz"
    settings = {"architecture": SHAPE, "config": SHORT, "seed": 3}
    whole = fit(*data, **settings)

    def interrupt(done, *_):
        if done == 2 * CHUNK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(*data, **settings, checkpoint=path, progress=interrupt)
    assert path.exists()
    seen = []
    resumed = fit(*data, **settings, checkpoint=path, progress=lambda done, *_: seen.append(done))
    assert seen == [SHORT.steps]
    assert equal(whole, resumed)
    assert not path.exists()


def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    data, path = recordings(10), tmp_path / "training.npz"

    def interrupt(*progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(*data, architecture=SHAPE, config=SHORT, checkpoint=path, progress=interrupt)
    with pytest.raises(ValueError, match=r"work with other settings \(seed\)"):
        fit(*data, architecture=SHAPE, config=SHORT, seed=9, checkpoint=path)


def test_missing_pressures_are_masked():
    u_in, u_out, dt, pressure = recordings(60)
    holes = pressure.copy()
    holes[np.random.default_rng(5).uniform(size=pressure.shape) < 0.3] = np.nan
    plant = fit(u_in, u_out, dt, holes, architecture=SHAPE, config=LONG)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(plant))
    assert error(plant, recordings(30, seed=1)) < 0.7


def test_windows_hold_the_start_then_the_samples():
    u_in, u_out, dt, pressure = recordings(2)
    u_out[:, 20:] = 1.0
    pressure[0, 3] = np.nan
    data = inspirations(u_in, u_out, dt, pressure, window=3)
    assert int(data.count) == 2
    assert data.u_in.shape == (128, 32)
    p = np.asarray(pressure[0], np.float32)
    np.testing.assert_array_equal(data.window[0, 0], [p[0]] * 3)
    np.testing.assert_array_equal(data.window[0, 2], p[:3])
    np.testing.assert_array_equal(data.window[0, 4], [p[2], 0.0, p[4]])
    np.testing.assert_array_equal(data.known[0, 4], [True, False, True])
    np.testing.assert_array_equal(data.weight[0, 1:4], [1, 0, 1])  # after sample 2 comes a blank
    np.testing.assert_array_equal(data.weight[1, :22], [1] * 20 + [0] * 2)
    assert float(data.weight[2:].sum()) == 0.0


def test_a_blank_first_pressure_takes_the_next_one():
    u_in, u_out, dt, pressure = recordings(1)
    pressure[0, 0] = np.nan
    data = inspirations(u_in, u_out, dt, pressure, window=2)
    assert float(data.start[0]) == np.float32(pressure[0, 1])


def test_horizons_grow_from_one_step_to_the_whole_inspiration():
    config = LearnedConfig(one_step=0.2, whole=0.4)
    shares = (0.0, 0.19, 0.4, 0.59, 0.61, 1.0)
    found = [int(horizon(config, jnp.asarray(x), 32)) for x in shares]
    assert found[:2] == [1, 1]
    assert 1 < found[2] < found[3] <= 32
    assert found[4:] == [33, 33]


def test_fits_the_time_constant_of_expiration():
    dt = np.full((3, 60), 0.033)
    time = np.concatenate([[0.0], np.cumsum(dt[0, 30:-1])])
    pressure = np.full((3, 60), 20.0)
    pressure[:, 30:] = 5 + 15 * np.exp(-time / 0.25)
    u_out = (np.arange(60) >= 30) * np.ones((3, 1))
    assert expiratory_time_constant(u_out, dt, pressure) == pytest.approx(0.25, rel=0.06)
    assert expiratory_time_constant(u_out, dt, np.full_like(pressure, np.nan)) == 0.2


def spoil(name, value, index=(0, 3)):
    arrays = dict(zip(("u_in", "u_out", "dt", "pressure"), recordings(2), strict=True))
    arrays[name][index] = value
    return arrays


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (spoil("u_in", 104.0), r"breath 0, step 3: u_in = 104.0 is outside 0..100"),
        (spoil("u_in", np.nan), "u_in = nan"),
        (spoil("dt", 0.0), "dt = 0.0"),
        (spoil("pressure", np.nan, 1), "breath 1 has no inspiratory step"),
        (spoil("u_out", 1.0, 0), "breath 0 has no inspiratory step"),
    ],
)
def test_bad_breaths_are_named(arrays, message):
    with pytest.raises(ValueError, match=message):
        inspirations(**arrays, window=3)


def test_shapes_must_agree():
    u_in, u_out, dt, pressure = recordings(2)
    with pytest.raises(ValueError, match="share one shape"):
        inspirations(u_in, u_out[:, 1:], dt, pressure, 3)
    with pytest.raises(ValueError, match="two samples or more"):
        inspirations(u_in[:0], u_out[:0], dt[:0], pressure[:0], 3)
    with pytest.raises(ValueError, match="weight"):
        inspirations(u_in, u_out, dt, pressure, 3, weight=np.ones(5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"one_step": 0.7}, "exceed 1"),
    ],
)
def test_impossible_recipes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        LearnedConfig(**change)
