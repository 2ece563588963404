"""Result of a training of controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import pandas as pd

from ventbench.errors import InputError
from ventbench.interfaces import Controller
from ventbench.lungs import LUNG_IDS, Lung, lung, scored_lung
from ventbench.plants.catalog import Given, load_simulators
from ventbench.plants.simulators import Simulators

#: Name of the network that serves all lungs and is not told which one it ventilates.
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


class HasLungs(Protocol):
    """Simulators, or plants to train on, of some lungs."""

    @property
    def lungs(self) -> tuple[Lung, ...]:
        """The lungs."""
        ...


def check_names(names: Sequence[str] | None, simulators: HasLungs) -> tuple[str, ...]:
    """Return the names of networks to train, as lung ids or :data:`ALL`.

    Args:
        names: ids of lungs or :data:`ALL`; a network for every lung of the simulators if not given.
        simulators: to train on.

    Raises:
        InputError: if a name is neither, or there are no simulators of a lung.
    """
    known = tuple(entry.id for entry in simulators.lungs)
    if names is None:
        return known
    for name in names:
        if name == ALL or lung(name).id in known:
            continue
        if known == LUNG_IDS:
            scored_lung(name)
        raise InputError(f"the simulators have no lung {name}; they have {', '.join(known)}")
    return tuple(name if name == ALL else lung(name).id for name in names)


def simulators_to_train_on(simulator: Given) -> Simulators:
    """Return simulators with plants, of the six scored lungs or of any others.

    Raises:
        InputError: if there are no such simulators, or they have no plants.
    """
    simulators = load_simulators(simulator)
    if not simulators.lungs:
        raise InputError(
            f"training needs simulators with plants; {simulators.name} has none: give the official "
            "ones, a plant file or a folder that `ventbench train simulator` wrote"
        )
    return simulators
