"""The published bounds: what they say, their commands attain."""

import jax
import numpy as np
import pytest

from ventbench.base import precision
from ventbench.entries import reference as references
from ventbench.plants.rigs import load_rigs
from ventbench.task import attainable, protocol
from ventbench.task.metrics.score import LEAST_HEADROOM


@pytest.fixture(scope="module")
def published():
    return references.published()


def test_bounds_are_in_order(published):
    assert published.attainable.shape == (6, 21, 6)
    assert np.all(published.lower <= published.attainable + 1e-9)
    assert np.all(published.attainable < published.pid)
    assert np.all((published.commands >= 0.0) & (published.commands <= 100.0))
    # Close to the bound that nothing can pass, beside what there is to win.
    gap = published.attainable - published.lower
    headroom = published.pid - published.attainable
    assert gap.mean() < 0.05 * headroom.mean()
    assert np.mean(headroom > LEAST_HEADROOM) > 0.95
    assert np.quantile(published.stationarity, 0.9) < 1e-4


def test_commands_attain_the_bounds(published):
    rigs = load_rigs()
    drawn = rigs.draws(20)
    about = references.settings(rigs.about, drawn.about())
    if about["simulators"] != published.about["simulators"]:
        pytest.skip("the bounds are of other simulators: run `ventbench headroom` again")
    assert published.about == about
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    # A cell of each lung, every fourth draw.
    lung, draw = np.repeat(np.arange(6), 5), np.tile([0, 4, 8, 12, 16], 6)
    pip = (lung + draw) % 6
    own = jax.tree.map(lambda x: x[lung, draw, 0], plants)
    some = jax.tree.map(lambda x: np.asarray(x)[lung, draw, pip], cells)
    with precision.float64():
        pressure = attainable.pressures(own, some, published.commands[lung, draw, pip])
    error = np.abs(pressure - some.pip[:, None]).mean(axis=1)
    np.testing.assert_allclose(error, published.attainable[lung, draw, pip], atol=1e-9)
