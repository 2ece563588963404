"""Plants at the labels of breaths."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.lungs import lung
from ventbench.plants.labelled import single_compartments, two_balloons
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stack import take
from ventbench.plants.two_balloon import two_balloon
from ventbench.precision import float64
from ventbench.rollouts import open_loop_breaths

LUNGS = ["R20C50", "R5C10", "R50C20"]


@pytest.mark.parametrize(
    ("plants_for", "one"),
    [(single_compartments, single_compartment), (two_balloons, two_balloon)],
)
def test_each_breath_has_the_plant_of_its_label(make_recording, plants_for, one):
    with float64():
        plants = plants_for(make_recording(LUNGS))
        for i, name in enumerate(LUNGS):
            assert take(plants, i) == one(lung(name))


def test_the_order_of_breaths_does_not_matter(make_recording):
    breaths = make_recording(LUNGS)
    order = [2, 0, 1]
    straight = open_loop_breaths(single_compartments, breaths)
    turned = open_loop_breaths(single_compartments, breaths.select(order))
    np.testing.assert_array_equal(turned, straight[order])
    np.testing.assert_array_equal(straight[:, 0], breaths.pressure[:, 0])
