"""A fit of a recording of sixty breaths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.physics import paths
from ventbench.system_id import Predictor, fit, make_data

from . import cases

FIVE = ("valve_lag", "turbulent_resistance", "leak", "circuit_compliance", "sensor_lag")


@pytest.mark.slow
def test_sixty_breaths_and_nine_parameters():
    m = {"valve_lag": {"tau": 0.05}, "turbulent_resistance": {"quadratic": 8.0}}
    few = make_data(cases.recording(12, m))
    data = few.select(np.arange(60) % 12)
    seen = data.measured + np.random.default_rng(0).normal(0, 0.2, data.measured.shape)
    data = replace(data, measured=seen)
    predictor = Predictor(data, paths())
    fitted = fit(data, FIVE, predictor=predictor)
    assert fitted.minimum.converged
    assert fitted.value("valve_lag.tau")[0] == pytest.approx(0.05, rel=0.2)
