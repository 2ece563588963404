"""Fits find again what the oracle had put into noisy recordings, and nothing where nothing was."""

from __future__ import annotations

from dataclasses import astuple

import jax.numpy as jnp
import numpy as np
import pytest

from tests.physics import cases
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.physics import library, parameter, paths, strength_path
from ventbench.system_id import START, Noise, Predictor, fit, interval, make_data
from ventbench.task.rollouts import open_loop

BREATHS, NOISE = 8, 0.2
#: Which only one breath in a few carries, or whose likelihood is no parabola.
APART = {"patient_effort", "valve_delay"}


def bic(fitted):
    """Bayesian information criterion."""
    count = fitted.problem.data.weight.sum()
    return len(fitted.minimum.x) * np.log(count) - 2.0 * fitted.log_likelihood.sum()


def within(fitted, path, truth, slack=1.0):
    """Whether the interval holds the truth, when stretched by ``slack`` around the value."""
    value, low, high = astuple(interval(fitted, path))
    return value - slack * (value - low) <= truth <= value + slack * (high - value)


@pytest.mark.parametrize("name", sorted(set(library()) - APART))
def test_recovers_its_parameters(name):
    m = {name: cases.strengths(name)[name]}  # an inertance has its own tubing
    data = make_data(cases.recording(BREATHS, m, noise=NOISE, seed=7))
    chosen = {  # a search chooses what has no derivative
        f"{owner}.{item.name}": own[item.name]
        for owner, own in m.items()
        for item in library()[owner].description.parameters
        if item.discrete
    }
    found = fit(data, m, fixed=chosen)
    assert found.minimum.converged
    assert found.problem.noise.sigma[0] == pytest.approx(NOISE, abs=0.03)
    # With 21 names and some parameters each, a few of the 95 % intervals miss; 1.6 of them do not.
    for owner, own in m.items():
        for item in library()[owner].description.parameters:
            if not item.shape:
                assert within(found, f"{owner}.{item.name}", own[item.name], 1.6)
    truth = {"R": 10.0, "C": 25.0, "R_ex": 5.0, "PEEP": 5.0}
    assert all(within(found, path, value, 1.6) for path, value in truth.items())
    # It is needed: without it the data are far less likely.
    without = fit(data)
    assert bic(without) > bic(found) + 6.0


def test_gas_that_rings_is_found_in_full():
    """At 7 ms a step the integrator damps the ringing, and a fit finds 15 % too little."""
    m = {"inertance": {"inertance": 0.06, "tubing": 0.5}}
    data = make_data(cases.recording(BREATHS, m, R=5.0, C=50.0, noise=0.05, seed=7))
    near = {"inertance.inertance": 0.05, "inertance.tubing": 0.45}
    fitted = fit(data, m, start=near)
    assert fitted.value("inertance.inertance")[0] == pytest.approx(0.06, rel=0.03)
    assert fitted.value("inertance.tubing")[0] == pytest.approx(0.5, rel=0.03)


def test_dead_time_has_a_profile():
    """Two and a half samples: flat between walls, where the curvature would promise too much."""
    m = cases.strengths("valve_delay")
    found = fit(make_data(cases.recording(BREATHS, m, noise=NOISE, seed=7)), m)
    value, low, high = astuple(interval(found, "valve_delay.delay"))
    assert low < 0.08 < high
    assert value == pytest.approx(0.08, abs=0.01)
    assert 0.003 < high - low < 0.04
    assert found.problem.noise.sigma[0] == pytest.approx(NOISE, abs=0.03)


@pytest.mark.parametrize(
    "name", ["valve_lag", "leak", "circuit_compliance", "turbulent_resistance"]
)
def test_finds_nothing_in_nothing(name):
    data = make_data(cases.recording(BREATHS, {}, noise=NOISE, seed=11))
    without, found = fit(data), fit(data, [name])
    assert bic(found) > bic(without)
    low, _ = found.ci95(strength_path(name))[0]
    assert low == 0.0
    assert not np.any(np.isnan(found.covariance))


@pytest.mark.slow
def test_several_at_once():
    m = {
        "valve_lag": {"tau": 0.05},
        "turbulent_resistance": {"quadratic": 8.0},
        "viscoelasticity": {"ratio": 0.4, "time": 0.8},
        "exhalation_valve_delay": {"opening": 0.05},
    }
    found = fit(make_data(cases.recording(16, m, noise=NOISE, seed=5)), m)
    for owner, own in m.items():
        for name, value in own.items():
            assert within(found, f"{owner}.{name}", value, 2.0), (owner, name)


def test_answers_of_a_simulator_and_the_fitted_plant():
    """The fitted plant, run as any predictor, answers as the fit says."""
    m = cases.strengths("valve_lag") | cases.strengths("sensor_drift")
    data = make_data(cases.recording(BREATHS, m, noise=NOISE, seed=2))
    found = fit(data, m)
    with float64():
        start = jnp.asarray(found.column(START))
        arrays = (jnp.asarray(x) for x in (data.u_in, data.u_out, data.dt))
        answer = np.asarray(open_loop(found.plant(), start, *arrays))
    np.testing.assert_allclose(answer, data.measured[:, 0] + found.residual[:, 0], atol=1e-9)
    again = fit(data.with_pressure(answer), m, noise=Noise((0.05,), (0.0,)))
    assert again.value("valve_lag.tau")[0] == pytest.approx(found.value("valve_lag.tau")[0], 1e-3)
    assert again.minimum.cost < 1e-3
    assert set(found.plant(0).names) < set(paths())
    with pytest.raises(InputError, match="shape"):
        data.with_pressure(answer[:, 1:])
    with pytest.raises(InputError, match="not finite"):
        data.with_pressure(np.full_like(answer, np.nan))


@pytest.mark.slow
def test_flow_and_gains_and_their_prior():
    """Two lungs, one valve; flow pins the gain, which pressure alone leaves to the prior."""
    one = cases.recording(4, {}, noise=NOISE, R=10.0, C=25.0, gain=20.0, seed=1)
    two = cases.recording(4, {}, noise=NOISE, R=30.0, C=15.0, gain=20.0, seed=2)
    rng = np.random.default_rng(0)
    both = {}
    for key in one.__dataclass_fields__:
        a, b = getattr(one, key), getattr(two, key)
        both[key] = np.concatenate([a, b]) if isinstance(a, np.ndarray) else a
    both["flow"] = both["flow"] + rng.normal(0, 20.0, both["flow"].shape)
    data = make_data(type(one)(**both), flow=True)
    found = fit(data, free=["gain"])
    np.testing.assert_allclose(found.value("R"), [10.0, 30.0], rtol=0.05)
    np.testing.assert_allclose(found.value("C"), [25.0, 15.0], rtol=0.05)
    np.testing.assert_allclose(found.value("gain"), 20.0, rtol=0.02)
    assert found.problem.noise.sigma[1] == pytest.approx(20.0, rel=0.15)
    apart = fit(data, gain_sd=0.5)  # one of each breath
    assert apart.value("gain").shape == (8,)
    np.testing.assert_allclose(apart.value("gain"), 20.0, rtol=0.05)
    pinned = fit(data, gain_sd=1e-3)
    np.testing.assert_allclose(pinned.value("gain"), parameter("gain").neutral, rtol=0.01)


def test_shared_simulator_and_fixed_values():
    data = make_data(cases.recording(BREATHS, cases.strengths("leak"), noise=NOISE))
    predictor = Predictor(data, paths())
    held = fit(data, ["leak"], fixed={"leak.conductance": 20.0}, predictor=predictor)
    assert "leak.conductance" not in held.problem.unknowns.paths
    np.testing.assert_array_equal(held.column("leak.conductance"), 20.0)
    free = fit(data, ["leak"], free=["leak.exponent"], predictor=predictor)
    low, high = free.ci95("leak.exponent")[0]
    assert low <= 0.5 <= high
    with pytest.raises(InputError, match=r"outside 0\.0\.\.50\.0 mL/s"):
        fit(data, fixed={"leak.conductance": 99.0})
    with pytest.raises(InputError, match="no mechanism 'gremlins'"):
        fit(data, ["gremlins"])
    assert parameter("leak.exponent").shape
