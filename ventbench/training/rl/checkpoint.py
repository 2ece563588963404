"""A training between two iterations, on disk: plain arrays, never pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.errors import InputError
from ventbench.files import write_atomically


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _like(old: Any, new: np.ndarray) -> Any:
    if isinstance(old, np.ndarray):
        return new
    return jax.random.wrap_key_data(jnp.asarray(new)) if _is_key(old) else jnp.asarray(new)


def save(path: Path, carry: Any, done: int, identity: str) -> None:
    """Write the leaves of ``carry`` after ``done`` parts, in one step."""
    leaves = {f"leaf{i}": _plain(leaf) for i, leaf in enumerate(jax.tree.leaves(carry))}
    header = {"done": np.asarray(done), "identity": np.asarray(identity)}
    write_atomically(path, lambda file: np.savez(file, **header, **leaves))  # pyright: ignore[reportArgumentType]


def resume(path: Path, carry: Any, identity: str) -> tuple[Any, int]:
    """Read what :func:`save` wrote, in the structure of ``carry``, and how much was done.

    Raises:
        InputError: if it belongs to another training or is damaged.
    """
    like, structure = jax.tree.flatten(carry)
    try:
        with np.load(path, allow_pickle=False) as saved:
            known, done = str(saved["identity"]), int(saved["done"])
            found = [saved[f"leaf{i}"] for i in range(len(like))] if known == identity else []
    except (KeyError, ValueError, OSError) as error:
        raise InputError(f"{path} is not a checkpoint: {error}; delete it to start anew") from error
    if known != identity:
        raise InputError(
            f"{path} belongs to a training with other lungs, seeds, settings or simulators; delete "
            "it, or choose another folder with --out"
        )
    leaves = [_like(old, new) for old, new in zip(like, found, strict=True)]
    return jax.tree.unflatten(structure, leaves), done
