"""What the tests of the physics share."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.physics import paths
from ventbench.system_id import Simulator, recorded, settings


@pytest.fixture(scope="session")
def predicted():
    """Function that simulates a recording with all mechanisms present, most of them neutral."""

    def run(breaths, m, **base):
        data = recorded(breaths)
        given = {f"{name}.{p}": value for name, own in m.items() for p, value in own.items()}
        values = settings(data, paths(), {"PEEP": 5.0} | base | given)
        return np.asarray(Simulator(data, paths()).predict(values))[:, 0]

    return run
