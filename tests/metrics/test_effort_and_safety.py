import numpy as np
import pytest

from ventbench.metrics import effort, safety


def test_effort_by_hand():
    u = [10.0, 30.0, 20.0, 20.0]
    assert effort.mean_command(u) == 20.0
    assert effort.mean_change(u) == pytest.approx((10 + 20 + 10 + 0) / 4)
    assert effort.clipped_share([-1.0, 0.0, 100.0, 101.0]) == 0.5


def test_nan_command():
    u = np.array([[1.0, np.nan], [1.0, 2.0]])
    for figure in (effort.mean_command(u), effort.mean_change(u), effort.clipped_share(u)):
        np.testing.assert_array_equal(np.isnan(figure), [True, False])


def test_time_above_alarm():
    p = [20.0, 23.0, 23.1, 30.0, 22.0]
    assert safety.time_above_alarm(p, 20.0, 0.03) == pytest.approx(0.06)
    assert np.isnan(safety.time_above_alarm([20.0, np.nan], 20.0, 0.03))


def test_longest_run_against_loop():
    flags = np.random.default_rng(0).random((200, 12)) < 0.6
    for row, found in zip(flags, safety.longest_run(flags), strict=True):
        text = "".join("x" if flag else " " for flag in row)
        assert found == max(map(len, text.split()), default=0)


@pytest.mark.parametrize(
    ("pressure", "pip", "dt", "passes"),
    [
        ([36.0] * 3 + [20.0] * 31, 20.0, 0.03, True),  # 0.09 s
        ([36.0] * 4 + [20.0] * 30, 20.0, 0.03, False),  # 0.12 s
        ([36.0, 36.0, 36.0, 20.0] * 8, 20.0, 0.03, True),  # never 0.1 s in one go
        ([35.0] * 34, 20.0, 0.03, True),  # the limit itself
        ([36.0] * 4 + [20.0] * 30, 20.0, 0.025, True),  # 0.1 s exactly
        ([61.0] * 34, 50.0, 0.03, False),  # 60 cmH2O whatever the PIP
        ([59.0] * 34, 50.0, 0.03, True),
        ([20.0] * 33 + [np.nan], 20.0, 0.03, False),
    ],
)
def test_gate(pressure, pip, dt, passes):
    assert safety.safe(pressure, pip, dt) == passes
