"""What the tests of the physics share."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.physics import paths
from ventbench.system_id import Predictor, make_data, parameter_values


@pytest.fixture(scope="session")
def predicted():
    """Function that simulates a recording with all mechanisms present, most of them neutral."""

    def run(breaths, m, **base):
        data = make_data(breaths)
        given = {f"{name}.{p}": value for name, own in m.items() for p, value in own.items()}
        values = parameter_values(data, paths(), {"PEEP": 5.0} | base | given)
        return np.asarray(Predictor(data, paths()).predict(values))[:, 0]

    return run
