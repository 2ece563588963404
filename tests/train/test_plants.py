"""What a training of controllers takes and returns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.controllers.pid import PID
from ventbench.plants import frozen
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.single_compartment import single_compartment
from ventbench.task.lungs import LUNG_IDS, lung
from ventbench.train.plants import (
    ALL,
    TrainedControllers,
    check_names,
    plants_to_train_on,
)


def _hybrid(plants: Any) -> Hybrid:
    assert isinstance(plants, Hybrid)
    return plants


@pytest.fixture(scope="module")
def official():
    return frozen.load()


def test_every_member_of_every_training_rig_is_there_and_no_held_out_one(official):
    given = plants_to_train_on()
    assert given.names == LUNG_IDS
    members, plants, first = (
        official.sessions_plants,
        _hybrid(given.plants),
        _hybrid(jax.tree.map(lambda leaf: leaf[0], given.plants)),
    )
    for at, (rigs, apart) in enumerate(
        zip(official.training_rigs, official.held_out_rigs, strict=True)
    ):
        assert not set(apart) & set(rigs)
        trained = {tuple(row) for row in np.stack([plants.E, plants.R], -1)[:, at]}
        wanted = {
            tuple(row) for row in np.stack([members.E, members.R], -1)[:, rigs].reshape(-1, 2)
        }
        assert trained == wanted
        nominal = members.E[0, official.rigs[at][0]]
        assert plants.E[0, at] == first.E[at] == nominal


def test_a_cell_weighs_what_the_normalised_score_divides_by():
    weights = plants_to_train_on().weights
    assert weights.shape == (6, 6)
    assert weights.mean() == pytest.approx(1.0)
    # At PIP 10 on a stiff lung little is to be gained, at PIP 35 on R20C50 much.
    assert weights[0, 0] > 3 * weights[5, 5] > 0


def test_networks_are_named_by_lungs_or_all():
    simulators = plants_to_train_on("single_compartment")
    assert check_names((*LUNG_IDS, ALL), simulators) == (*LUNG_IDS, ALL)
    assert check_names(None, simulators) == LUNG_IDS
    with pytest.raises(InputError, match="not a scored lung"):
        check_names(["R50C10"], simulators)


def test_simulators_may_have_any_lungs_but_must_have_plants():
    simulators = plants_to_train_on("single_compartment")
    assert jax.tree.leaves(simulators.plants)[0].shape == (1, 6)
    assert np.all(simulators.weights == 1.0)
    own = plants_to_train_on({"R7C33": single_compartment(lung("R7C33"))})
    assert check_names(None, own) == ("R7C33",)
    with pytest.raises(InputError, match="have no lung R5C20; they have R7C33"):
        check_names(["R5C20"], own)
    with pytest.raises(InputError, match="training needs simulators with plants"):
        plants_to_train_on(lambda u_in, u_out, dt, *, R, C, initial_pressure: u_in)


def test_a_training_shows_a_row_a_network():
    report = {"networks": {"R5C10": {"gains": [1.0, 2.0, 0.0], "seconds": 3.0}}}
    trained = TrainedControllers({"R5C10": PID(1.0, 2.0)}, report, Path("runs"))
    table = trained.to_frame()
    assert table.loc["R5C10", "seconds"] == 3.0
    assert table.index.name == "network"
    assert "R5C10" in trained._repr_html_()
