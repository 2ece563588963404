"""Plants of several lungs as one stack, also where their physics name different parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ventbench import precision
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.physics.model import Physics


def stacked(plants: Sequence[Plant]) -> Plant:
    """Stack plants along a new leading axis; they keep their precision.

    A mechanism that only some have is neutral in the others, and so changes nothing there.

    Raises:
        InputError: if they are of different kinds or sizes.
    """
    similar = _alike(list(plants))
    try:
        return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *similar)
    except ValueError as error:
        raise InputError(
            "the plants of the file's lungs have different structures and cannot be run together; "
            "make a file for each lung"
        ) from error


def _alike(plants: list[Any]) -> list[Any]:
    """The same plants, with the same parameters named at every place where there are physics."""
    first = plants[0]
    if not dataclasses.is_dataclass(first) or any(type(x) is not type(first) for x in plants):
        return plants
    if isinstance(first, Physics):
        return _physics(plants)
    for field in dataclasses.fields(first):
        parts = [getattr(plant, field.name) for plant in plants]
        if dataclasses.is_dataclass(parts[0]):
            plants = [
                dataclasses.replace(plant, **{field.name: part})
                for plant, part in zip(plants, _alike(parts), strict=True)
            ]
    return plants


def _physics(plants: list[Physics]) -> list[Physics]:
    names = list(dict.fromkeys(name for plant in plants for name in plant.names))
    substeps, memory = (max(getattr(p, x) for p in plants) for x in ("substeps", "memory"))
    found = []
    for plant in plants:
        # One that has no PEEP takes the pressure that it starts from, which no number can say.
        missing = [name for name in names if name not in plant.names]
        if "PEEP" in missing:
            raise InputError("some of the file's plants have a PEEP of their own and some not")
        with precision.float64():
            full = plant.having(**{name: plant.get(name) for name in missing})
        values = tuple(np.asarray(value) for value in full.values)
        found.append(dataclasses.replace(full, values=values, substeps=substeps, memory=memory))
    return found
