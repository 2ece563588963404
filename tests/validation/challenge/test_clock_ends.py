"""Delayed edges at the very end of a breath."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.validation.challenge.clock import clock, sampling


@pytest.mark.parametrize("seed", range(8))
def test_samples_stay_and_time_goes_on_whatever_the_dead_times(seed):
    rng = np.random.default_rng(seed)
    u_out = np.zeros((3, 80), np.int8)
    u_out[:, 31:] = 1
    for _ in range(25):
        time = sampling(3, 80, 3e-4, rng)
        late, late_out = (float(x) for x in rng.uniform(0.0, 0.12, 2))
        found = clock(time, u_out, late, late_out, 8)
        nodes = found.nodes
        assert np.all(np.diff(nodes, axis=1) > 0)
        np.testing.assert_allclose(nodes[:, ::8], time, atol=0)
