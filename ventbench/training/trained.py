"""Result of a training of controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ventbench.errors import InputError
from ventbench.interfaces import Controller
from ventbench.lungs import LUNG_IDS, scored_lung
from ventbench.plants.catalog import Given, Simulators, load_simulators

#: Name of the network that serves all six lungs and is not told which one it ventilates.
ALL = "all"

#: Names of the networks that a training makes if not told otherwise: one a lung, and one for all.
NETWORKS = (*LUNG_IDS, ALL)


@dataclass(frozen=True)
class TrainedControllers:
    """Controllers by the lung that they were trained for.

    Attributes:
        controllers: pure controllers by lung id, or :data:`ALL`.
        report: content of ``training.json``: settings, errors, provenance of the simulators.
        folder: folder in which ``weights.npz`` and ``training.json`` were written.
    """

    controllers: dict[str, Controller]
    report: dict[str, Any]
    folder: Path

    def to_frame(self) -> pd.DataFrame:
        """One row a network: the columns that the report has for every network."""
        networks = self.report["networks"]
        return pd.DataFrame.from_dict(networks, orient="index").rename_axis("network")

    def _repr_html_(self) -> str:
        return self.to_frame().to_html()


def check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of networks to train, as lung ids or :data:`ALL`.

    Raises:
        InputError: if a name is neither.
    """
    return tuple(name if name == ALL else scored_lung(name).id for name in names)


def simulators_to_train_on(simulator: Given) -> Simulators:
    """Return simulators of the six scored lungs.

    Raises:
        InputError: if there are no such simulators, or none of one of the six lungs.
    """
    simulators = load_simulators(simulator)
    names = tuple(lung.id for lung in simulators.lungs)
    if names != LUNG_IDS:
        raise InputError(
            f"training needs plants of {', '.join(LUNG_IDS)} in this order; the simulators "
            f"{simulators.name} have {', '.join(names) or 'none'}"
        )
    return simulators
