import numpy as np
import pytest

from ventbench.physics import Parameter, parameter, paths


@pytest.mark.parametrize("path", paths())
def test_transforms_and_their_inverses(path):
    item = parameter(path)
    inner = item.low + (item.high - item.low) * np.linspace(0.01, 0.99, 9)
    np.testing.assert_allclose(item.physical(item.coordinate(inner)), inner, rtol=1e-12)
    step = 1e-6
    moved = (item.physical(item.coordinate(inner) + step) - inner) / step
    np.testing.assert_allclose(item.slope(inner), moved, rtol=1e-4)


@pytest.mark.parametrize("path", paths())
def test_prior_covers_the_range(path):
    item = parameter(path)
    mean, sd = item.prior()
    ends = item.coordinate([item.low, item.high])
    assert ends[0] <= mean <= ends[1]
    assert np.all(np.abs(ends - mean) <= 2.0 * sd * (1 + 1e-9))


def test_bad_values():
    with pytest.raises(ValueError, match="must lie within"):
        Parameter("x", "1", "out of bounds", 0.0, 1.0, 2.0, 0.5, 0.5)
    with pytest.raises(ValueError, match="positive lower bound"):
        Parameter("x", "1", "log of zero", 0.0, 1.0, 0.5, 0.5, 0.5, "log")
