import numpy as np
import pytest

from ventbench.metrics.waveform import lung_score, run_error


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
