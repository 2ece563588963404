import numpy as np
import pytest

from ventbench.task.metrics.score import longest_run, lung_score, passes_safety_gate, run_error


def test_first_breath_is_ignored():
    pressure = np.full((3, 34), 20.0)
    pressure[0] = 1000.0
    pressure[1] += 1.0
    pressure[2, :17] -= 4.0
    assert run_error(pressure, 20.0) == pytest.approx((1.0 + 2.0) / 2)


def test_against_loop():
    rng = np.random.default_rng(0)
    pressure = rng.normal(20, 5, size=(4, 6, 3, 34))
    pip = rng.uniform(10, 35, size=(4, 6))
    expected = np.zeros(4)
    for lung in range(4):
        for k in range(6):
            error = [abs(pressure[lung, k, b, s] - pip[lung, k]) for b in (1, 2) for s in range(34)]
            expected[lung] += sum(error) / len(error) / 6
    found = lung_score(run_error(pressure, pip[..., None, None]))
    np.testing.assert_allclose(found, expected)


def test_nan_does_not_hide():
    pressure = np.zeros((2, 3, 34))
    pressure[0, 2, 33] = np.nan
    np.testing.assert_array_equal(run_error(pressure, 0.0), [np.nan, 0.0])
    assert np.isnan(lung_score([1.0, np.nan]))


def test_shape():
    with pytest.raises(ValueError, match="do not end in"):
        run_error(np.zeros((3, 33)), 10.0)


def test_longest_run_against_loop():
    flags = np.random.default_rng(0).random((200, 12)) < 0.6
    for row, found in zip(flags, longest_run(flags), strict=True):
        text = "".join("x" if flag else " " for flag in row)
        assert found == max(map(len, text.split()), default=0)


@pytest.mark.parametrize(
    ("pressure", "pip", "dt", "passes"),
    [
        ([36.0] * 3 + [20.0] * 31, 20.0, 0.03, True),  # 0.09 s
        ([36.0] * 4 + [20.0] * 30, 20.0, 0.03, False),  # 0.12 s
        ([36.0] * 3 + [20.0, 20.0] * 4 + [36.0], 20.0, 0.03, False),  # 0.12 s, in two goes
        ([36.0, 36.0, 20.0, 20.0] * 8, 20.0, 0.03, False),  # every other step
        ([70.0] * 3 + [20.0] * 31, 20.0, 0.03, True),
        ([70.1] + [20.0] * 33, 20.0, 0.03, False),  # the cap
        ([35.0] * 34, 20.0, 0.03, True),  # the limit itself
        ([36.0] * 4 + [20.0] * 30, 20.0, 0.025, True),  # 0.1 s exactly
        ([61.0] * 34, 50.0, 0.03, False),  # 60 cmH2O whatever the PIP
        ([59.0] * 34, 50.0, 0.03, True),
        ([20.0] * 33 + [np.nan], 20.0, 0.03, False),
    ],
)
def test_gate(pressure, pip, dt, passes):
    assert passes_safety_gate(pressure, pip, dt) == passes
