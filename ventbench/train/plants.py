"""What controllers are trained on, what a cell weighs in it, and what a training returns.

Of the frozen simulators these are all members of all rigs of each lung but the one that is set
aside. The development draws have no part: deviations are drawn anew from their ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.entries import reference
from ventbench.plants import frozen
from ventbench.plants.catalog import SimulatorLike, load_simulators
from ventbench.task import protocol
from ventbench.task.interfaces import Controller, Plant
from ventbench.task.lungs import LUNG_IDS, LUNGS, Lung, lung, scored_lung
from ventbench.task.metrics.score import LEAST_HEADROOM


@dataclass(frozen=True, eq=False)
class TrainingPlants:
    """Plants of L lungs to train a controller on."""

    lungs: tuple[Lung, ...]  #: L of them.
    #: leaves ``(K, L, ...)``, numpy: K plants of each lung, the nominal one first. Of the frozen
    #: simulators they are all members of all training rigs, in turn where a lung has fewer than K;
    #: of others the members of the ensemble.
    plants: Plant
    about: Mapping[str, Any]  #: version and hashes of the simulators, for the report.
    #: of the error of each lung at each PIP, mean 1, shape ``(L, P)``: the inverse of what the
    #: normalised score divides by, without deviations; 1 for simulators without published bounds.
    weights: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the lungs."""
        return tuple(lung.id for lung in self.lungs)

    @property
    def nominal(self) -> Plant:
        """The nominal plant of each lung, leaves ``(L, ...)``."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], self.plants)


def plants_to_train_on(simulator: SimulatorLike = "frozen") -> TrainingPlants:
    """Load plants to train a controller on.

    Args:
        simulator: see :func:`ventbench.load_simulators`; ``"frozen"`` stands for all rigs of each
            lung but the held-out one.

    Raises:
        InputError: if there are no such simulators, or they have no plants.
    """
    if isinstance(simulator, str) and simulator == "frozen":
        official = frozen.load()
        return TrainingPlants(LUNGS, _stacked(official), official.about(), _weights(official))
    simulators = load_simulators(simulator)
    if not simulators.lungs:
        raise InputError(
            f"training needs simulators with plants; {simulators.name} has none: give the official "
            "ones, a plant file or a folder that `ventbench train simulator` wrote"
        )
    count = len(simulators.lungs)
    ones = np.ones((count, len(protocol.PIPS)))
    return TrainingPlants(simulators.lungs, simulators.ensemble, dict(simulators.about), ones)


def _stacked(official: frozen.Frozen) -> Plant:
    """All members of all training rigs, leaves ``(K, L, ...)``."""
    members = jax.tree.leaves(official.sessions_plants)[0].shape[0]
    count = members * math.lcm(*(len(rigs) for rigs in official.training_rigs))
    pairs = [
        [(k // len(rigs) % members, rigs[k % len(rigs)]) for k in range(count)]
        for rigs in official.training_rigs
    ]
    at = np.array(pairs).transpose(1, 0, 2)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[at[..., 0], at[..., 1]], official.members)


def _weights(official: frozen.Frozen) -> Floats:
    bounds = reference.load(files.data_path(reference.FILE))
    if bounds.about["simulators"] != official.manifest_sha256:
        return np.ones((len(LUNGS), len(protocol.PIPS)))
    inverse = 1.0 / np.maximum(bounds.pid[:, 0] - bounds.attainable[:, 0], LEAST_HEADROOM)
    return inverse / inverse.mean()


#: Name of the network that serves all lungs and is not told which one it ventilates.
ALL = "all"


@dataclass(frozen=True)
class TrainedControllers:
    """Controllers by the lung that they were trained for."""

    controllers: dict[str, Controller]  #: pure controllers by lung id, or :data:`ALL`.
    #: content of ``training.json``: settings, errors, provenance of the simulators.
    report: dict[str, Any]
    folder: Path  #: folder in which ``weights.npz`` and ``training.json`` were written.

    def to_frame(self) -> pd.DataFrame:
        """One row a network: the columns that the report has for every network."""
        networks = self.report["networks"]
        return pd.DataFrame.from_dict(networks, orient="index").rename_axis("network")

    def __repr__(self) -> str:
        """Names and folder."""
        return f"<TrainedControllers {', '.join(self.controllers)} in {self.folder}>"

    def _repr_html_(self) -> str:
        return self.to_frame().to_html()


def check_names(
    names: Sequence[str] | None, trained_on: TrainingPlants, *, all_lungs: bool = True
) -> tuple[str, ...]:
    """Return the names of networks to train, as lung ids or :data:`ALL`.

    Args:
        names: ids of lungs or :data:`ALL`; a network for every lung of the simulators if not given.
        trained_on: plants to train on.
        all_lungs: whether :data:`ALL` is a name.

    Raises:
        InputError: if a name is neither, or there are no simulators of a lung.
    """
    available = trained_on.names
    if names is None:
        return available
    names = [names] if isinstance(names, str) else names
    for name in names:
        if (all_lungs and name == ALL) or lung(name).id in available:
            continue
        if available == LUNG_IDS:
            scored_lung(name)
        raise InputError(f"the simulators have no lung {name}; they have {', '.join(available)}")
    return tuple(name if name == ALL else lung(name).id for name in names)
