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
    assert check_names(NETWORKS) == (*LUNG_IDS, ALL)
    with pytest.raises(InputError, match="not a scored lung"):
        check_names(["R50C10"])


def test_simulators_must_have_the_six_lungs():
    simulators = simulators_to_train_on("single_compartment")
    assert jax.tree.leaves(simulators.ensemble)[0].shape[:2] == (1, 6)
    with pytest.raises(InputError, match=r"training needs plants of R5C10, .* have R5C20"):
        simulators_to_train_on({"R5C20": single_compartment(lung("R5C20"))})


def test_a_training_shows_a_row_a_network():
    report = {"networks": {"R5C10": {"gains": [1.0, 2.0, 0.0], "seconds": 3.0}}}
    trained = TrainedControllers({"R5C10": PID(1.0, 2.0)}, report, Path("runs"))
    table = trained.to_frame()
    assert table.loc["R5C10", "seconds"] == 3.0
    assert table.index.name == "network"
    assert "R5C10" in trained._repr_html_()
