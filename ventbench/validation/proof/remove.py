"""A piece of physics taken out of a plant again."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ventbench import precision
from ventbench.interfaces import Plant
from ventbench.physics.catalogue import library, mechanism, parameter, slots
from ventbench.physics.model import Physics
from ventbench.plants.corrected import Corrected


def most_important(mechanisms: Sequence[Mapping[str, Any]]) -> str | None:
    """Name of the first mechanism that all breaths share; None if there is none.

    Args:
        mechanisms: of a ``diagnosis.json``, the most important first.
    """
    for item in mechanisms:
        scopes = [p.scope for p in mechanism(item["name"]).description.parameters]
        if item["name"] in library() and "breath" not in scopes:
            return str(item["name"])
    return None


def without(plant: Physics, names: Collection[str]) -> Physics:
    """Return a plant whose mechanisms of these names do nothing: their parameters are neutral."""
    with precision.float64():
        return plant.having(
            **{path: parameter(path).neutral for path in plant.names if _owner(path) in names}
        )


def by_names_alone(plant: Plant) -> Plant:
    """Return a corrected plant without what has no name: no element of a slot changes anything.

    Those of a simulator that has them itself stay what they are there.
    """
    if not isinstance(plant, Corrected):
        return without(plant, slots()) if isinstance(plant, Physics) else plant
    had, wanted = plant.had, plant.wanted
    elements = [path for path in (*wanted.names, *had.names) if _owner(path) in slots()]
    with precision.float64():
        same = wanted.having(**{path: had.get(path) for path in elements})
    return dataclasses.replace(plant, wanted=same)


def has_unnamed(plant: Plant) -> bool:
    """Whether a corrected plant has elements of slots."""
    physics = plant.wanted if isinstance(plant, Corrected) else plant
    return isinstance(physics, Physics) and any(_owner(path) in slots() for path in physics.names)


def _owner(path: str) -> str:
    return path.rpartition(".")[0]
