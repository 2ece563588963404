"""Fast recordings on a coarser grid: commands keep their times and volumes."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.physics import resolution, resolution_of
from ventbench.plants.catalog import load_simulators
from ventbench.recordings.breaths import Breaths, make_breaths
from ventbench.recordings.decimation import decimate, is_fast


def recorded(rate: float, hold: int, noise: float = 0.0) -> Breaths:
    """Two breaths of an R-C lung; the command changes every ``hold`` samples."""
    count, rng = int(2.0 * rate), np.random.default_rng(0)
    time = np.arange(count) / rate * np.ones((2, 1))
    u_out = (time >= 1.0).astype(np.int8)
    levels = rng.uniform(5.0, 40.0, (2, count // hold + 1))
    u_in = np.where(u_out == 1, 0.0, np.repeat(levels, hold, axis=1)[:, :count])
    made = make_breaths([1, 2], [20.0] * 2, [50.0] * 2, time, u_in, u_out, np.full_like(time, 5.0))
    pressure = load_simulators("physics").pressures(made)
    pressure += noise * rng.standard_normal(pressure.shape)
    return make_breaths([1, 2], [20.0] * 2, [50.0] * 2, time, u_in, u_out, pressure)


@pytest.mark.parametrize(("rate", "hold"), [(1000.0, 37), (200.0, 7), (100.0, 3)])
def test_held_commands_lose_nothing(rate, hold):
    """A simulator answers on the coarse grid exactly as on the fine one."""
    breaths = recorded(rate, hold)
    assert is_fast(breaths)
    fewer = decimate(breaths)
    assert fewer.breaths.time.shape[1] < 0.8 * breaths.time.shape[1]
    exact = load_simulators("physics").pressures(breaths)
    coarse = load_simulators("physics").pressures(fewer.breaths)
    valid = fewer.breaths.valid
    np.testing.assert_allclose(coarse[valid], fewer.of(exact)[valid], atol=1e-9)
    readings = np.isfinite(fewer.breaths.pressure)
    np.testing.assert_array_equal(
        fewer.breaths.pressure[readings], fewer.of(breaths.pressure)[readings]
    )
    switch = fewer.breaths.time[0][np.argmax(fewer.breaths.u_out[0] == 1)]
    assert switch == pytest.approx(1.0, abs=1.0 / rate)


def test_a_moving_command_keeps_its_volume_and_nearly_its_pressure():
    """A smooth command, which changes at every sample, in a lung of high resistance."""
    time = np.arange(0.0, 2.0, 1e-3)[None]
    u_out = (time >= 1.0).astype(np.int8)
    u_in = np.where(u_out == 1, 0.0, 20.0 + 15.0 * np.sin(9.0 * time))
    made = make_breaths([1], [50.0], [20.0], time, u_in, u_out, np.full_like(time, 5.0))
    fewer = decimate(made)
    exact = fewer.of(load_simulators("physics").pressures(made))
    coarse = load_simulators("physics").pressures(fewer.breaths)
    readings = np.isfinite(fewer.breaths.pressure)
    assert np.abs(coarse - exact)[readings].max() < 0.5
    assert np.abs(coarse - exact)[readings].mean() < 0.1
    valid = fewer.breaths.valid[0]
    volume = np.sum((fewer.breaths.u_in * fewer.breaths.dt)[0, valid][:-1])
    assert volume == pytest.approx(float(np.sum((made.u_in * made.dt)[0, :-1])), rel=1e-12)


def test_a_noisy_command_does_not_keep_every_sample():
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 2.0, 1e-3)[None]
    u_in = np.clip(30.0 + 2.0 * rng.standard_normal(time.shape), 0.0, 100.0)
    made = make_breaths([1], [5.0], [50.0], time, u_in, 0 * time, np.full_like(time, 5.0))
    fewer = decimate(made)
    assert fewer.breaths.valid.sum() <= 640
    assert 80 <= np.isfinite(fewer.breaths.pressure).sum() <= 300
    exact = fewer.of(load_simulators("physics").pressures(made))
    coarse = load_simulators("physics").pressures(fewer.breaths)
    readings = np.isfinite(fewer.breaths.pressure)
    assert np.abs(coarse - exact)[readings].mean() < 0.2


def test_slow_recordings_stay_as_they_are():
    assert not is_fast(recorded(50.0, 2))
    assert not is_fast(recorded(20.0, 1))


def test_resolution_of_uneven_samples_reaches_as_far_back():
    even = np.full((3, 80), 0.032)
    assert resolution_of(even) == resolution(0.032) == (5, 6)
    uneven = np.tile([0.001] * 10 + [0.02], (1, 20))
    substeps, memory = resolution_of(uneven)
    past = np.convolve(uneven[0], np.ones(memory - 1), "valid")
    assert past.min() >= 0.15
    assert substeps >= resolution(0.02)[0] - 1
