"""Against closed forms: the first-order and the second-order step response."""

import numpy as np
import pytest

from ventbench.task.metrics import score as sr

PEEP, PIP, DT = 5.0, 25.0, 1e-3
STEP = PIP - PEEP
T = DT * np.arange(3001)


def first_order(tau):
    return PIP - STEP * np.exp(-T / tau)


def second_order(zeta, omega):
    damped = omega * np.sqrt(1 - zeta**2)
    phase = np.arccos(zeta)
    return PIP - STEP * np.exp(-zeta * omega * T) * np.sin(damped * T + phase) / np.sin(phase)


@pytest.mark.parametrize("tau", [0.05, 0.1, 0.3])
def test_first_order(tau):
    p = first_order(tau)
    assert sr.rise_time(p, PEEP, PIP, DT) == pytest.approx(tau * np.log(9), abs=1e-5)
    assert sr.settling_time(p, PEEP, PIP, DT) == pytest.approx(tau * np.log(20), abs=DT)
    assert sr.overshoot(p, PIP) == 0.0
    assert sr.overshoot_percent(p, PEEP, PIP) == 0.0
    assert sr.swings(p, PIP) == 0
    assert sr.steady_error(p, PIP) == pytest.approx(STEP * np.exp(-T[-5:].mean() / tau), abs=1e-4)


@pytest.mark.parametrize(("zeta", "omega"), [(0.2, 20.0), (0.4, 10.0), (0.7, 15.0)])
def test_second_order(zeta, omega):
    p = second_order(zeta, omega)
    over = np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2))
    assert sr.overshoot_percent(p, PEEP, PIP) == pytest.approx(100 * over, abs=0.01)
    assert sr.overshoot(p, PIP) == pytest.approx(STEP * over, abs=0.01)
    # Extrema, each `over` times the one before, that leave the dead band:
    extrema = STEP * over ** np.arange(1, 30)
    assert sr.swings(p, PIP) == np.sum(extrema > sr.RINGING_BAND)
    # The crossings of 10 % and 90 % and the last leaving of the band, from the formula itself:
    fine = np.interp(np.linspace(0, T[-1], 300_001), T, p)
    level = (fine - PEEP) / STEP
    rise = (np.argmax(level >= 0.9) - np.argmax(level >= 0.1)) * 1e-5
    assert sr.rise_time(p, PEEP, PIP, DT) == pytest.approx(rise, abs=2e-5)
    last = np.flatnonzero(np.abs(level - 1) > 0.05)[-1] * 1e-5
    assert sr.settling_time(p, PEEP, PIP, DT) == pytest.approx(last, abs=DT)


def test_small_steps_settle_into_half_a_cmh2o():
    p = 10.0 - np.array([5.0, 1.0, 0.6, 0.5, 0.3, 0.4])  # 5 % would be 0.25
    assert sr.settling_time(p, 5.0, 10.0, 0.03) == pytest.approx(0.09)


def test_settled_from_the_start_and_never():
    p = np.array([[10.0, 10.1, 9.9], [5.0, 10.0, 11.0]])
    np.testing.assert_array_equal(sr.settling_time(p, 5.0, 10.0, 0.03), [0.0, np.nan])


def test_never_rose():
    assert np.isnan(sr.rise_time(np.full(34, 20.0), PEEP, PIP, 0.03))


def test_rise_interpolates_between_samples():
    # 5, 15, 25: 10 % after 0.2 steps, 90 % after 1.8.
    assert sr.rise_time([5.0, 15.0, 25.0], 5.0, 25.0, 0.03) == pytest.approx(1.6 * 0.03)


def test_rise_from_above_the_first_level():
    assert sr.rise_time([8.0, 24.0], 5.0, 25.0, 1.0) == pytest.approx(15.0 / 16.0)
    assert sr.rise_time([30.0, 30.0], 5.0, 25.0, 1.0) == 0.0


def test_swings_count_nothing_inside_the_band():
    noise = 0.2 * np.sign(np.sin(np.arange(100)))
    assert sr.swings(PIP + noise, PIP) == 0
    # Through the band and back to the same side is no swing; to the other side is one.
    assert sr.swings([20.0, 25.1, 20.0], PIP) == 0
    assert sr.swings([20.0, 25.1, 26.0, 24.9, 26.0, 24.0], PIP) == 2


def test_ripple_and_steady_error_look_at_the_last_ten_steps():
    p = np.concatenate([np.full(24, 90.0), 25.0 + np.array([1.0, -1.0] * 5)])
    assert sr.ripple(p) == 2.0
    assert sr.steady_error(p, PIP) == 0.0
    assert sr.steady_error(p - 3.0, PIP) == pytest.approx(3.0)


def test_batches_are_the_single_ones():
    rng = np.random.default_rng(0)
    p = rng.normal(18, 6, size=(3, 4, 34))
    peep = rng.uniform(4, 6, size=(4,))
    pip, dt = rng.uniform(10, 35, size=(3, 4)), rng.uniform(0.02, 0.04, size=(3, 1))
    whole = [
        sr.rise_time(p, peep, pip, dt),
        sr.overshoot(p, pip),
        sr.overshoot_percent(p, peep, pip),
        sr.settling_time(p, peep, pip, dt),
        sr.steady_error(p, pip),
        sr.swings(p, pip),
        sr.ripple(p),
    ]
    for i in range(3):
        for j in range(4):
            one = [
                sr.rise_time(p[i, j], peep[j], pip[i, j], dt[i, 0]),
                sr.overshoot(p[i, j], pip[i, j]),
                sr.overshoot_percent(p[i, j], peep[j], pip[i, j]),
                sr.settling_time(p[i, j], peep[j], pip[i, j], dt[i, 0]),
                sr.steady_error(p[i, j], pip[i, j]),
                sr.swings(p[i, j], pip[i, j]),
                sr.ripple(p[i, j]),
            ]
            np.testing.assert_array_equal([figure[i, j] for figure in whole], one)


def test_nan_pressure():
    p = np.full(34, 20.0)
    p[3] = np.nan
    for figure in (sr.rise_time(p, 5.0, 20.0, 0.03), sr.settling_time(p, 5.0, 20.0, 0.03)):
        assert np.isnan(figure)
    assert np.isnan(sr.swings(p, 20.0))
    assert np.isnan(sr.overshoot(p, 20.0))
