import numpy as np
import pytest

from ventbench.task.metrics import open_loop


def test_equation_by_hand():
    measured = [[5.0, 6.0, 8.0, 9.0], [5.0, 5.0, 5.0, 5.0]]
    simulated = [[5.0, 6.5, 7.0, 9.0], [5.0, 4.0, 4.0, 4.0]]
    np.testing.assert_allclose(open_loop.distance(measured, simulated), [1.5, 3.0])
    np.testing.assert_allclose(open_loop.mae(measured, simulated), [0.5, 1.0])
    np.testing.assert_allclose(open_loop.by_horizon(measured, simulated), [0.75, 1.0, 0.5])


def test_against_loop():
    rng = np.random.default_rng(0)
    measured, simulated = rng.normal(size=(2, 7, 31))
    mask = rng.random((7, 31)) < 0.5
    measured[rng.random((7, 31)) < 0.1] = np.nan
    sums, counts = np.zeros(7), np.zeros(7)
    for i in range(7):
        for t in range(1, 31):
            if mask[i, t] and not np.isnan(measured[i, t]):
                sums[i] += abs(measured[i, t] - simulated[i, t])
                counts[i] += 1
    np.testing.assert_allclose(open_loop.distance(measured, simulated, mask), sums)
    np.testing.assert_allclose(open_loop.mae(measured, simulated, mask), sums / counts)


def test_start_is_given_and_not_predicted():
    assert open_loop.mae([[5.0, 6.0]], [[9.0, 6.0]]) == [0.0]


def test_nothing_to_count_is_nan():
    mask = [[True, False, False]]  # the start alone
    assert np.isnan(open_loop.distance([[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0]], mask))
    assert np.isnan(open_loop.mae([[1.0, np.nan, np.nan]], [[1.0, 2.0, 3.0]]))
    assert np.isnan(open_loop.by_horizon([[1.0, np.nan]], [[1.0, 2.0]]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_broken_simulator_is_infinitely_far(value):
    simulated = [[1.0, 2.0, value], [1.0, 2.0, 3.0]]
    measured = [[1.0, 2.5, 3.0], [1.0, 2.5, 3.0]]
    np.testing.assert_array_equal(open_loop.mae(measured, simulated), [np.inf, 0.25])
    np.testing.assert_array_equal(open_loop.by_horizon(measured, simulated), [0.5, np.inf])
    mask = [True, True, False]
    np.testing.assert_array_equal(open_loop.mae(measured, simulated, mask), [0.5, 0.5])


def test_shapes_must_pair():
    with pytest.raises(ValueError, match="do not pair"):
        open_loop.distance(np.zeros((2, 5)), np.zeros((2, 6)))
    with pytest.raises(ValueError, match="do not pair"):
        open_loop.distance(1.0, 1.0)
