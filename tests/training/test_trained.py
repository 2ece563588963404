"""What a training of controllers takes and returns."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest

from ventbench.controllers.pid import PID
from ventbench.errors import InputError
from ventbench.lungs import LUNG_IDS, lung
from ventbench.plants.single_compartment import single_compartment
from ventbench.training.trained import (
    ALL,
    NETWORKS,
    TrainedControllers,
    check_names,
    simulators_to_train_on,
)


def test_networks_are_named_by_lungs_or_all():
    simulators = simulators_to_train_on("single_compartment")
    assert check_names(NETWORKS, simulators) == (*LUNG_IDS, ALL)
    assert check_names(None, simulators) == LUNG_IDS
    with pytest.raises(InputError, match="not a scored lung"):
        check_names(["R50C10"], simulators)


def test_simulators_may_have_any_lungs_but_must_have_plants():
    simulators = simulators_to_train_on("single_compartment")
    assert jax.tree.leaves(simulators.ensemble)[0].shape[:2] == (1, 6)
    own = simulators_to_train_on({"R7C33": single_compartment(lung("R7C33"))})
    assert check_names(None, own) == ("R7C33",)
    with pytest.raises(InputError, match="have no lung R5C20; they have R7C33"):
        check_names(["R5C20"], own)
    with pytest.raises(InputError, match="training needs simulators with plants"):
        simulators_to_train_on(lambda u_in, u_out, dt, *, R, C, initial_pressure: u_in)


def test_a_training_shows_a_row_a_network():
    report = {"networks": {"R5C10": {"gains": [1.0, 2.0, 0.0], "seconds": 3.0}}}
    trained = TrainedControllers({"R5C10": PID(1.0, 2.0)}, report, Path("runs"))
    table = trained.to_frame()
    assert table.loc["R5C10", "seconds"] == 3.0
    assert table.index.name == "network"
    assert "R5C10" in trained._repr_html_()
