"""The published bounds: what they say, their commands attain."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ventbench.entries import reference as references
from ventbench.plants.rigs import load_rigs
from ventbench.task import protocol
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
        pytest.fail("the bounds are of other simulators: run `ventbench board headroom` again")
    assert published.about == about
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    # Every fourth draw.
    some = np.arange(0, 21, 4)
    attained = references.witness_errors(
        replace(published, commands=published.commands[:, some]),
        *jax.tree.map(lambda x: x[:, some], (plants, cells)),
    )
    np.testing.assert_allclose(attained, published.attainable[:, some], atol=1e-9)
