"""The scale of normalised scores: 0 at the bound, 100 at the PID."""

import numpy as np
import pytest

from ventbench.task import protocol
from ventbench.task.metrics.score import LEAST_HEADROOM, controllable_error, normalised


def test_ends_of_the_scale():
    attainable, pid = np.array([1.0, 3.0]), np.array([2.0, 3.5])
    np.testing.assert_allclose(normalised(attainable, attainable, pid), 0.0)
    np.testing.assert_allclose(normalised(pid, attainable, pid), 100.0)
    np.testing.assert_allclose(normalised([1.25, 4.0], attainable, pid), [25.0, 200.0])


def test_a_pid_at_the_bound_does_not_blow_a_cell_up():
    assert normalised(1.05, 1.0, 1.0) == pytest.approx(5.0 / LEAST_HEADROOM)
    assert np.isnan(normalised(np.nan, 1.0, 2.0))


def test_the_first_step_and_the_first_breath_do_not_count():
    pressure = np.full((2, protocol.BREATHS, protocol.INSPIRATION_STEPS), 8.0)
    pressure[0, 0] = 100.0
    pressure[1, :, 0] = 5.0
    pressure[1, 2, 5] = 41.0
    error = controllable_error(pressure, 10.0)
    scored = 2 * (protocol.INSPIRATION_STEPS - 1)
    np.testing.assert_allclose(error, [2.0, 2.0 + 29.0 / scored])
