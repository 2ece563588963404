"""A training between two updates, on disk."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.errors import InputError
from ventbench.files import write_atomically
from ventbench.plants.learned import Architecture
from ventbench.training.learned.data import Inspirations
from ventbench.training.learned.recipe import Recipe


def identity(
    architecture: Architecture, recipe: Recipe, seed: int, tau: float, data: Inspirations
) -> str:
    """Text that differs when a checkpoint cannot be continued."""
    sums = [float(np.asarray(x, float).sum()) for x in jax.tree.leaves(data)]
    parts = (dataclasses.asdict(architecture), dataclasses.asdict(recipe), seed, tau, sums)
    return json.dumps(parts, sort_keys=True)


def save(path: Path, carry: Any, step: int, identity: str) -> None:
    """Write networks and optimiser state after ``step`` updates, in one step."""
    leaves = {f"leaf{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(carry))}
    header = {"step": np.asarray(step), "identity": np.asarray(identity)}
    write_atomically(path, lambda file: np.savez(file, **header, **leaves))  # type: ignore[arg-type]


def resume(path: Path, carry: Any, identity: str) -> tuple[Any, int]:
    """Read what :func:`save` wrote, in the structure of ``carry``, and the updates done.

    Raises:
        InputError: if it belongs to another training.
    """
    with np.load(path, allow_pickle=False) as saved:
        if str(saved["identity"]) != identity:
            raise InputError(
                f"{path} belongs to a training with other data, seed or settings; delete it or "
                "choose another checkpoint"
            )
        leaves, structure = jax.tree.flatten(carry)
        found = [jnp.asarray(saved[f"leaf{i}"]) for i in range(len(leaves))]
        return jax.tree.unflatten(structure, found), int(saved["step"])
