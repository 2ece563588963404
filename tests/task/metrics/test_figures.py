import numpy as np
import pytest

from ventbench.task.metrics.score import (
    clipped_share,
    mean_change,
    mean_command,
    time_above_alarm,
)


def test_effort_by_hand():
    u = [10.0, 30.0, 20.0, 20.0]
    assert mean_command(u) == 20.0
    assert mean_change(u) == pytest.approx((10 + 20 + 10 + 0) / 4)
    assert clipped_share([-1.0, 0.0, 100.0, 101.0]) == 0.5


def test_nan_command():
    u = np.array([[1.0, np.nan], [1.0, 2.0]])
    for figure in (mean_command(u), mean_change(u), clipped_share(u)):
        np.testing.assert_array_equal(np.isnan(figure), [True, False])


def test_time_above_alarm():
    p = [20.0, 23.0, 23.1, 30.0, 22.0]
    assert time_above_alarm(p, 20.0, 0.03) == pytest.approx(0.06)
    assert np.isnan(time_above_alarm([20.0, np.nan], 20.0, 0.03))
