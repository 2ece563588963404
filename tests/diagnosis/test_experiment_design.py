"""The next breath to record: which kind wins, what it gains, and that it is safe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.diagnosis.experiment_design import Rig, contrast, families, forecast, request_breaths
from ventbench.physics import paths
from ventbench.system_id import Data, Noise, Predictor, fit, parameter_values

NOISE = Noise((0.2,), (0.0,))
#: With what is asked for, 40 breaths: sizes repeat, and nothing is compiled twice.
N, T, DT = 35, 80, 0.032


def commands(n, R, C, seed, gain=1.0):
    """PI control of a plain R-C lung to random pressures; ``(n, T)`` each.

    The larger gains ring at every other sample; a ``gain`` of 0.4 makes them all smooth.
    """
    rng = np.random.default_rng(seed)
    u, out = np.zeros((n, T)), np.zeros((n, T))
    p, volume, integral = np.full(n, 5.0), np.zeros(n), np.zeros(n)
    target, kp, ki = rng.uniform(12, 30, n), gain * rng.uniform(1, 4, n), rng.uniform(2, 8, n)
    for t in range(31):
        error = target - p
        integral += DT / (DT + 0.5) * (error - integral)
        u[:, t] = np.clip(kp * error + ki * integral, 0, 100)
        volume += 22.8 * u[:, t] * DT
        p = 5 + volume / C + R * 22.8 * u[:, t] / 1000
    out[:, 31:] = 1.0
    return u, out


def simulated(u, out, truth, *, R=20.0, C=20.0, seed=0):
    """Breaths of the physics with noise of 0.2 cmH2O."""
    n = len(u)
    empty = Data(
        u,
        out,
        np.full((n, T), DT),
        np.zeros((n, 1, T)),
        np.ones((n, 1, T)),
        np.full(n, R),
        np.full(n, C),
        np.linspace(0, 1, n),
        np.zeros(n),
    )
    rng = np.random.default_rng(seed + 100)
    start = 5.0 + rng.normal(0, 0.3, n)
    values = parameter_values(empty, paths(), {"PEEP": 5.0, "start": start, **truth})
    clean = Predictor(empty, paths()).predict(values)[:, 0]
    return empty.with_pressure(clean + rng.normal(0, 0.2, clean.shape))


def recorded(truth, *, seed=0, gain=1.0):
    return simulated(*commands(N, 20.0, 20.0, seed, gain), truth, seed=seed)


def both(truth, one, other, *, seed=0, gain=1.0):
    data = recorded(truth, seed=seed, gain=gain)
    return [fit(data, [name], noise=NOISE) for name in (one, other)]


def expected(truth, other, u_in, u_out):
    """Nats of given breaths, if the first holds and the second is refitted."""
    data = truth.problem.data
    n = len(u_in)
    shape = (n, 1, T)
    new = Data(
        u_in,
        u_out,
        np.full((n, T), DT),
        np.zeros(shape),
        np.ones(shape),
        np.full(n, data.R[0]),
        np.full(n, data.C[0]),
        np.ones(n),
        np.zeros(n),
    )
    here = np.arange(len(data))
    simulator = Predictor(new, paths())
    one, two = (forecast(x, new, simulator, here, 5.0, NOISE) for x in (truth, other))
    return contrast(one, two, NOISE).nats(np.arange(n))


def test_pulses_tell_a_lag_from_a_delay():
    # Smooth commands: of those that ring at the sampling rate, a delay explains nothing, and any
    # breath refutes it.
    lag, delay = both({"valve_lag.tau": 0.04}, "valve_lag", "valve_delay", gain=0.4)
    found = request_breaths(lag, [delay], NOISE)
    assert found is not None
    assert "pulse" in found.title
    assert found.title.endswith("(lung R20C20)")
    assert found.why == ("valve_lag", "valve_delay")
    assert found.u_in.shape == found.u_out.shape == found.dt.shape == (5, T)
    more = commands(5, 20.0, 20.0, 9, gain=0.4)
    assert found.nats > 2.0 * expected(lag, delay, *more)
    assert found.nats <= expected(lag, delay, found.u_in, found.u_out) * 1.001
    assert found.nats <= expected(delay, lag, found.u_in, found.u_out) * 1.001


def test_a_hold_tells_a_leak_from_creep():
    leak, creep = both({"leak.conductance": 3.0}, "leak", "viscoelasticity")
    found = request_breaths(leak, [creep], NOISE)
    assert found is not None
    assert "hold" in found.title
    held = (found.u_in == 0) & (found.u_out == 0)
    assert np.max(held.sum(axis=1)) * DT > 1.9
    more = commands(5, 20.0, 20.0, 9)
    assert found.nats > 2.0 * expected(leak, creep, *more)


def test_what_is_asked_for_is_safe_also_with_another_lung():
    """A stiffening lung whose pressure rises above what a plain one would show."""
    stiff = {"nonlinear_compliance.stiffening": 0.04, "valve_delay.delay": 0.05}
    data = recorded(stiff)
    one = fit(data, ["nonlinear_compliance", "valve_delay"], noise=NOISE)
    two = fit(data, ["nonlinear_compliance", "valve_lag"], noise=NOISE)
    found = request_breaths(one, [two], NOISE)
    assert found is not None
    assert found.why == ("valve_delay", "valve_lag")
    seen = simulated(found.u_in, found.u_out, stiff).measured
    assert seen.min() > -1.0
    assert 10.0 < seen.max() < 51.0


def test_nothing_to_ask():
    plain, _ = both({}, "valve_lag", "valve_delay")
    assert request_breaths(plain, [], NOISE) is None
    # The same hypothesis twice: no breath tells it from itself.
    assert request_breaths(plain, [plain], NOISE) is None


def test_commands_of_all_kinds_are_possible():
    kinds = families(Rig(5.0, 50.0, 22.8, 5.0), T, DT)
    assert len({kind.title for kind in kinds}) == len(kinds) == 8
    for kind in kinds:
        assert kind.u_in.shape == kind.u_out.shape == (5, T)
        assert kind.u_in.min() >= 0.0
        assert 1.0 < kind.u_in.max() <= 100.0
        assert set(np.unique(kind.u_out)) <= {0.0, 1.0}
        # Nothing is blown in while it can escape, and the breath ends with an open valve.
        assert not np.any((kind.u_in > 0) & (kind.u_out > 0))
        assert kind.u_out.sum(axis=1).min() >= 3
        flow = 22.8 * kind.u_in
        pressure = 5.0 + np.cumsum(flow, axis=1) * DT / 50.0 + 5.0 * flow / 1000.0
        assert pressure.max() <= 35.0 + 1e-9


def test_nats_against_new_recordings():
    """Recorded, refitted and compared for real: the log-likelihood ratio grows as foretold."""
    gains, foretold = [], []
    for seed in range(4):
        leak, band = both({"leak.conductance": 2.0}, "leak", "valve_dead_band", seed=seed)
        found = request_breaths(leak, [band], NOISE)
        assert found is not None
        # The rig is what the fit says: what the fit does not know is not to be tested here.
        truth = {path: leak.column(path)[0] for path in ("leak.conductance", "R_ex", "PEEP")}
        R, C = leak.column("R")[0], leak.column("C")[0]
        new = simulated(found.u_in, found.u_out, truth, R=R, C=C, seed=50 + seed)
        new = replace(new, R=np.full(5, 20.0), C=np.full(5, 20.0))
        old = leak.problem.data
        columns = {k: np.concatenate([getattr(old, k), getattr(new, k)]) for k in vars(old)}
        joined = replace(old, **columns)
        again = [fit(joined, [name], noise=NOISE) for name in ("leak", "valve_dead_band")]
        before = leak.log_likelihood.sum() - band.log_likelihood.sum()
        after = again[0].log_likelihood.sum() - again[1].log_likelihood.sum()
        gains.append(after - before)
        foretold.append(expected(leak, band, found.u_in, found.u_out))
    # Noise alone spreads each gain by sqrt(2 nats), their mean by less than a tenth.
    assert np.mean(foretold) > 100.0
    assert np.mean(gains) == pytest.approx(np.mean(foretold), rel=0.15)
