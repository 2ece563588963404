"""What the residuals of a final model say of the session: order in time, and nothing where it is
noise. The rig of these tests is that of :mod:`.made`, plain numpy without any fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ventbench.diagnosis.experiment import below, saturation
from ventbench.diagnosis.residual_analysis import excess_over_noise, quiet_samples
from ventbench.diagnosis.settings import DEFAULT, ResidualSettings
from ventbench.diagnosis.validation import Adequacy, check_residuals, order_p_value, passes_fdr
from ventbench.recordings import join

from . import made

BREATHS, LEVEL = 28, DEFAULT.residuals.veto_level
GROUPS = np.zeros(BREATHS, np.int64)

#: Enough permutations for the level of the veto.
FEWER = dataclasses.replace(DEFAULT.residuals, flips=1000)


def checked(
    gains: np.ndarray,
    zeros: np.ndarray | float = 0.0,
    seed: int = 0,
    *,
    scatter: bool = False,
    settings: ResidualSettings = FEWER,
) -> Adequacy:
    """Residuals of a perfect simulator where gains and zeros differ from breath to breath."""
    recorded = made.breaths(n=BREATHS)
    u_in, u_out, dt = recorded.u_in, np.asarray(recorded.u_out), recorded.dt
    simulated = made.answer(u_in, u_out, dt, 22.0, 47.5)[0]
    slope = made.answer(1.01 * u_in, u_out, dt, 22.0, 47.5)[0]
    pressure = made.answer(gains[:, None] * u_in, u_out, dt, 22.0, 47.5)[0]
    noise = made.NOISE * np.random.default_rng(seed).standard_normal(pressure.shape)
    pressure = pressure + noise + np.reshape(zeros, (-1, 1))
    return check_residuals(
        dataclasses.replace(recorded, pressure=pressure),
        simulated,
        (slope - simulated) / 0.01,
        np.zeros_like(slope),
        made.NOISE,
        22.8 * u_in,
        np.zeros_like(slope),
        gains_scatter=scatter,
        settings=settings,
    )


def test_a_gain_that_rises_in_mid_session_is_located_and_vetoes():
    """Pattern 1: it was counted as scatter of the gain, and nothing was missing."""
    gains = np.where(np.arange(BREATHS) < 14, 1.0, 1.25)
    for scatter in (False, True):
        found = checked(gains * np.exp(0.02 * np.sin(np.arange(BREATHS))), scatter=scatter)
        first = found.changes[0]
        assert (first.of, first.breath, first.drifts) == ("gain", 15, False)
        assert first.size == pytest.approx(1.25, rel=0.02)
        assert first.p_value < LEVEL
        assert first.worth > 0.2
        assert found.vetoed


def test_a_ramp_and_a_shift_of_the_zero():
    ramp = checked(np.linspace(0.9, 1.1, BREATHS)).changes[0]
    assert (ramp.of, ramp.drifts) == ("gain", True)
    assert ramp.size == pytest.approx(1.1 / 0.9, rel=0.03)
    shifted = checked(np.ones(BREATHS), 0.8 * (np.arange(BREATHS) >= 20)).changes[0]
    assert (shifted.of, shifted.breath) == ("zero", 21)
    assert shifted.size == pytest.approx(0.8, rel=0.1)


def test_scatter_without_an_order_is_no_change():
    gains = np.exp(np.random.default_rng(3).normal(0.0, 0.1, BREATHS))
    found = checked(gains, scatter=True)
    assert found.changes == ()
    assert not found.vetoed
    assert checked(gains, settings=DEFAULT.residuals).vetoed, (
        "but it is an error where all breaths have one gain"
    )


def test_noise_is_vetoed_as_rarely_as_promised():
    assert not any(checked(np.ones(BREATHS), seed=seed).vetoed for seed in range(5))


def test_a_change_that_is_worth_nothing_is_not_told():
    assert checked(np.where(np.arange(BREATHS) < 14, 1.0, 1.004)).changes == ()


def test_p_values_of_exchangeable_breaths_are_uniform():
    """Whatever the distribution; two lungs that differ are no order."""
    rng, few = np.random.default_rng(1), dataclasses.replace(DEFAULT.residuals, flips=200)
    p = np.array([order_p_value(rng.standard_cauchy(BREATHS), GROUPS, few) for _ in range(300)])
    assert 0.06 < np.mean(p <= 0.1) < 0.15
    assert 0.43 < np.mean(p <= 0.5) < 0.58
    lungs = (np.arange(BREATHS) >= 14).astype(np.int64)
    assert order_p_value(rng.normal(5.0 * lungs, 1.0), lungs) > 0.05
    assert order_p_value(rng.normal(5.0 * lungs, 1.0), GROUPS) < 0.001
    assert order_p_value(np.arange(4.0), GROUPS[:4]) == 1.0, "too few breaths to tell"
    assert order_p_value(np.zeros(BREATHS), GROUPS) == 1.0, "equal values have no order"


def test_false_discovery_rate_by_hand():
    p = np.array([0.03, 0.001, 0.02, 0.5])
    assert passes_fdr(p, 0.05).tolist() == [True, True, True, False]  # 0.03 <= 3/4 of 0.05
    assert passes_fdr(p, 0.01).tolist() == [False, True, False, False]
    assert not passes_fdr(np.full(4, 0.2), 0.05).any()


def test_saturated_readings_are_left_out():
    """Pattern 2: they became a valve whose flow falls with pressure."""
    recorded = made.breaths(n=BREATHS)
    top = float(np.quantile(recorded.pressure, 0.95))
    clipped = dataclasses.replace(recorded, pressure=np.minimum(recorded.pressure, top))
    saturated = saturation(clipped)
    assert saturated == pytest.approx((top, 0.05), rel=0.01)
    kept = below(clipped, top)
    np.testing.assert_array_equal(np.isnan(kept.pressure), recorded.pressure >= top)
    step = np.round(recorded.pressure / 0.07) * 0.07
    for whole in (recorded, dataclasses.replace(recorded, pressure=step)):
        assert saturation(whole) is None


def test_a_sensor_that_saturates_on_one_lung_does_so_on_all():
    """Pattern 11: readings that are few on one lung are as censored as the many on another."""
    one, other = (made.breaths(label, n=20) for label in ("R50C10", "R20C50"))
    top = float(np.quantile(other.pressure, 0.995))
    both = join([one, dataclasses.replace(other, breath_id=other.breath_id + 100)])
    clipped = dataclasses.replace(both, pressure=np.minimum(both.pressure, top))
    seldom = np.count_nonzero(other.pressure >= top)
    assert 0 < seldom < 0.01 * other.pressure.size
    assert saturation(clipped[20:]) is None
    assert saturation(clipped) == pytest.approx((top, np.mean(both.pressure >= top)))


#: Noise without any error of the simulator, ``(n, T)``, by kind: where gas flows and at which time.
Kind = Callable[[np.random.Generator, np.ndarray, np.ndarray], np.ndarray]


def _autoregressive(rng: np.random.Generator, flow: np.ndarray, _: np.ndarray) -> np.ndarray:
    each = 0.15 * rng.standard_normal(flow.shape)
    for k in range(1, each.shape[1]):
        each[:, k] += 0.7 * each[:, k - 1]
    return each


def _hum(rng: np.random.Generator, _: np.ndarray, time: np.ndarray) -> np.ndarray:
    phase = rng.uniform(0.0, 2.0 * np.pi, (len(time), 1))
    hum = 0.2 * np.sin(2.0 * np.pi * 50.0 * time + phase)
    return hum + 0.1 * rng.standard_normal(time.shape)


NOISES: dict[str, Kind] = {
    "white": lambda rng, flow, time: 0.2 * rng.standard_normal(flow.shape),
    "Student's t of 3": lambda rng, flow, time: 0.12 * rng.standard_t(3, flow.shape),
    "grows with flow": lambda rng, flow, time: (
        (0.08 + 0.8e-3 * np.abs(flow)) * rng.standard_normal(flow.shape)
    ),
    "autoregressive": _autoregressive,
    "hum of the mains": _hum,
    "small": lambda rng, flow, time: 0.03 * rng.standard_normal(flow.shape),
}


def world(kind: str, seed: int, *, step: float = 0.0) -> tuple[np.ndarray, ...]:
    """Errors of a perfect simulator, where they are known and where nothing moves, ``(n, T)``."""
    recorded = made.breaths(n=BREATHS)
    u_in, u_out = recorded.u_in, np.asarray(recorded.u_out)
    pressure, flow, _ = made.answer(u_in, u_out, recorded.dt, 22.0, 47.5)
    read = pressure + NOISES[kind](np.random.default_rng(seed), flow, recorded.time)
    if step:
        read = step * np.round(read / step)
    return read - pressure, recorded.valid, quiet_samples(recorded)


@pytest.mark.parametrize("kind", NOISES)
def test_noise_of_any_kind_is_noise(kind):
    """In 28 breaths, a fine or a coarse converter, and in 5, whose quiet ends tell little."""
    found = [excess_over_noise(*world(kind, k, step=0.5 * (k % 2))) for k in range(40)]
    few = [excess_over_noise(*(x[:5] for x in world(kind, k))) for k in range(40)]
    alarms = sum(each.p_value <= LEVEL for each in found)
    alarms += sum(each.outweighs_noise or each.p_value <= LEVEL for each in few)
    print(f"{kind}: {alarms} of {len(found + few)} false alarms")
    assert alarms <= 3


def test_five_readings_in_one_of_five_breaths_outweigh_the_noise():
    """A plug of five readings: "nothing is missing" was said beside 0.88 cmH2O for 0.18."""
    error, usable, quiet = (x[:5].copy() for x in world("white", 0))
    error[1, 1:6] += [5.1, 4.5, 4.3, 4.6, 4.6]
    assert excess_over_noise(error, usable, quiet).outweighs_noise


@pytest.mark.parametrize("kind", NOISES)
def test_an_error_of_some_breaths_that_lasts_is_none(kind):
    """A plug that opens: 1.2 cmH2O more for a quarter of a second, in each sixth breath."""
    error, usable, quiet = world(kind, 0)
    held = np.arange(BREATHS)[:, None] % 6 == 0
    time = made.breaths(n=BREATHS).time
    plug = np.where(held & (time > 0.2) & (time < 0.45), 1.2, 0.0)
    assert excess_over_noise(error + 2.0 * plug, usable, quiet).p_value <= LEVEL
    alone = excess_over_noise((error + 2.0 * plug)[:1], usable[:1], quiet[:1])
    slow = kind == "autoregressive"  # which the quiet end of one breath cannot tell
    assert slow or alone.p_value <= LEVEL, "and in one breath alone"
