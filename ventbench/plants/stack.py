"""Several plants of one kind as one pytree with leading axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp

PlantT = TypeVar("PlantT")


def stack(plants: Sequence[PlantT]) -> PlantT:
    """Stack plants of equal structure along a new leading axis.

    Raises:
        ValueError: if there is none, or their structures differ.
    """
    if not plants:
        raise ValueError("no plants to stack")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *plants)


def take(plants: PlantT, *index: int) -> PlantT:
    """Return one plant of a stack, by its index on each of the leading axes."""
    return jax.tree.map(lambda leaf: leaf[index], plants)
