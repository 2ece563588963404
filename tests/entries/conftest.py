"""Textbook lungs to score submissions on; ``make``, which writes submissions, serves all tests."""

from __future__ import annotations

import pytest

from ventbench.base import compilation
from ventbench.entries.scaffold import create
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.stacking import stack
from ventbench.task.lungs import LUNGS

from ..conftest import MANIFEST as MANIFEST


@pytest.fixture(scope="session")
def plants() -> SingleCompartment:
    """The six lungs, float64, stacked."""
    with compilation.float64():
        return stack([single_compartment(lung) for lung in LUNGS])


@pytest.fixture
def demo(tmp_path):
    return create("demo", "ppo", tmp_path)
