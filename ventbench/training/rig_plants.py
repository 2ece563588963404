"""What controllers are trained on: the plants of a version of the protocol, and what a cell weighs.

For version 2 these are all members of all rigs of each lung but the one that is set aside. The
development draws have no part: deviations are drawn anew from their ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench import draws, files, protocol, rig_draws
from ventbench.errors import InputError
from ventbench.headroom import reference
from ventbench.interfaces import Plant
from ventbench.lungs import LUNGS, Lung
from ventbench.metrics.score import LEAST_HEADROOM
from ventbench.plants import frozen
from ventbench.plants.catalog import Given
from ventbench.training.trained import simulators_to_train_on

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrainingPlants:
    """Plants of L lungs to train a controller on.

    Attributes:
        lungs: L of them.
        plants: leaves ``(K, L, ...)``, numpy: K plants of each lung, the nominal one first. In
            version 1 they are the members of the ensemble; in version 2 all members of all training
            rigs, in turn where a lung has fewer than K.
        about: version and hashes of the simulators, for the report.
        weights: of the error of each lung at each PIP, mean 1, shape ``(L, P)``: the inverse of
            what the normalised score divides by, without deviations; 1 in version 1, and for
            simulators without published bounds.
    """

    lungs: tuple[Lung, ...]
    plants: Plant
    about: Mapping[str, Any]
    weights: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the lungs."""
        return tuple(lung.id for lung in self.lungs)

    @property
    def nominal(self) -> Plant:
        """The nominal plant of each lung, leaves ``(L, ...)``."""
        return jax.tree.map(lambda leaf: np.asarray(leaf)[0], self.plants)


def ranges(version: int) -> Mapping[str, tuple[float, float]]:
    """Ranges of the deviations of a version of the protocol."""
    return rig_draws.RANGES if version == 2 else draws.RANGES


def plants_to_train_on(simulator: Given = "frozen", version: int = 1) -> TrainingPlants:
    """Load plants to train a controller on.

    Args:
        simulator: see :func:`ventbench.load_simulators`.
        version: of the protocol. In version 2 ``"frozen"`` stands for the simulators of that
            version, of each lung all rigs but the held-out one.

    Raises:
        InputError: if there is no such version, or there are no such simulators with plants.
    """
    if version not in protocol.VERSIONS:
        raise InputError(f"protocol {version}: there are {protocol.VERSIONS}")
    if version == 2 and isinstance(simulator, str) and simulator == "frozen":
        official = frozen.load(version=2)
        return TrainingPlants(LUNGS, _stacked(official), official.about(), _weights(official))
    simulators = simulators_to_train_on(simulator)
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
