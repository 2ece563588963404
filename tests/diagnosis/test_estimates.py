"""What a conclusion's parameters are fitted from."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.diagnosis import estimates
from ventbench.mechanics.labels import Estimate
from ventbench.physics.catalogue import parameter, paths
from ventbench.system_id import Noise, make_data, parameter_values
from ventbench.system_id.predictor import START, Predictor
from ventbench.system_id.problem import Partition, make_problem, parameter_of

from . import small

LAGS = ("valve_lag.tau", "valve_lag.second")


@pytest.mark.parametrize("found", [(0.08, 0.01), (0.01, 0.08), (0.08, None)])
def test_the_larger_of_two_lags_comes_first(found):
    """A search may end in either order: they are the same simulator."""
    values = {path: value for path, value in zip(LAGS, found, strict=True) if value is not None}
    data = make_data(small.made())
    partition = Partition(data, Predictor(data, paths(("valve_lag",))))
    problem = make_problem(partition, ("R", *values, START), Noise(), {})
    x = problem.start(values | {"R": 21.0, "leak.conductance": 3.0})
    start = {path: parameter_of(path).physical(x[problem.unknowns.of(path)]) for path in values}
    assert start[LAGS[0]] == 0.08
    assert start.get(LAGS[1]) == (None if found[1] is None else 0.01)
    np.testing.assert_allclose(problem.values(x)[:, 0], 21.0)


def test_two_lags_may_change_places():
    data = make_data(small.made())
    simulator = Predictor(data, paths(("valve_lag",)))
    order = [
        parameter_values(data, simulator.names, dict(zip(LAGS, pair, strict=True)))
        for pair in ((0.09, 0.03), (0.03, 0.09))
    ]
    one, other = simulator.predict_all(np.stack(order))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
    off = simulator.predict(parameter_values(data, simulator.names, {}))
    assert np.abs(one - off).max() > 1.0


def test_reported_intervals_contain_an_error_of_the_form(monkeypatch):
    monkeypatch.setattr(estimates, "FORM_ERROR", 0.02)
    sharp = Estimate(0.1, "s", (0.0999, 0.1001))
    wide = Estimate(0.1, "s", (0.05, 0.15))
    unknown = Estimate(0.1, "s", (-np.inf, np.inf))
    for own, low, high in (
        (sharp, 0.1 - 1.96 * 0.002, 0.1 + 1.96 * 0.002),
        (wide, 0.05, 0.15),
        (unknown, -np.inf, np.inf),
    ):
        widened = estimates.with_form_error({"tau": own}, "sensor_lag")["tau"]
        assert (widened.value, widened.unit) == (0.1, "s")
        assert widened.ci95 == pytest.approx((low, high), rel=0.01)
    # Slow stress trades against C: what acts beside it shifts its size and its time.
    own = {"ratio": Estimate(0.5, "1", (0.49, 0.51)), "time": Estimate(1.1, "s", (1.09, 1.11))}
    for alone, share in ((True, 0.02), (False, 0.201)):
        widened = estimates.with_form_error(own, "viscoelasticity", alone=alone)
        for each in widened.values():
            low, high = each.ci95  # by factors: a stress that is too small is farther off
            assert high / each.value == pytest.approx(np.exp(1.96 * share), rel=0.02)
            assert each.value / low == pytest.approx(np.exp(1.96 * share), rel=0.02)
    breath = {"amplitude": Estimate(2.0, "cmH2O", (1.9, 2.1))}
    assert estimates.with_form_error(breath, "patient_effort") == breath
    monkeypatch.setattr(estimates, "FORM_ERROR", 5.0)
    unsure = {"tau": Estimate(0.001, "s", (0.0, 0.002))}
    low, _ = estimates.with_form_error(unsure, "sensor_lag")["tau"].ci95
    assert low == parameter("sensor_lag.tau").low  # not beyond what is possible
