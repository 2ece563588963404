"""Plants in files: one ``.npz`` with every array by its path, and the structure as JSON text.

Never pickle: a file can only name the plant types that are registered here.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench import files
from ventbench.errors import InputError

_STRUCTURE = "structure"


def _types() -> dict[str, type]:
    from ventbench.plants import registry

    return registry.TYPES


def _encode(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            field.name: _encode(getattr(value, field.name), f"{path}.{field.name}", arrays)
            for field in dataclasses.fields(value)
        }
        return {"type": type(value).__name__, "fields": fields}
    if isinstance(value, tuple | list):
        return {"tuple": [_encode(x, f"{path}.{i}", arrays) for i, x in enumerate(value)]}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        name = path.removeprefix(".")
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, str | int | float | bool) or value is None:
        return {"value": value}
    raise TypeError(f"{path}: a {type(value).__name__} cannot be stored in a plant file")


def _decode(node: dict[str, Any], arrays: Any, as_array: Callable[[Any], Any]) -> Any:
    if "type" in node:
        fields = {name: _decode(child, arrays, as_array) for name, child in node["fields"].items()}
        return _types()[node["type"]](**fields)
    if "tuple" in node:
        return tuple(_decode(child, arrays, as_array) for child in node["tuple"])
    if "array" in node:
        return as_array(arrays[node["array"]])
    return node["value"]


def save(path: Path, plant: Any) -> None:
    """Write a plant, or a stack of plants, in one step; equal plants give equal bytes."""
    arrays: dict[str, np.ndarray] = {}
    structure = _encode(plant, "", arrays)
    arrays[_STRUCTURE] = np.array(json.dumps(structure, sort_keys=True))
    files.write_atomically(path, lambda file: np.savez(file, **arrays))  # pyright: ignore[reportArgumentType]


def load(path: Path, as_array: Callable[[Any], Any] = jnp.asarray) -> Any:
    """Read what :func:`save` wrote.

    Args:
        path: of the file.
        as_array: makes the leaves; the default gives them the precision that is in force,
            ``numpy.asarray`` that of the file.

    Raises:
        InputError: if the file is not a plant file, or names an unknown type of plant.
        OSError: if it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return _decode(json.loads(str(arrays[_STRUCTURE])), arrays, as_array)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a plant file of ventbench: {error!r}") from error
