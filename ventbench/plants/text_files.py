"""Plants of some lungs in one JSON file that people can read: what ``--plant FILE`` takes.

Numbers have full precision: what is read is to the bit what was written. Like the binary files of
:mod:`ventbench.plants.files`, a text file can only name types of plant that are registered.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ventbench import files
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.lungs import lung
from ventbench.plants.files import _decode, _encode

FORMAT = "ventbench-plants-1"


def save(path: Path, plants: Mapping[str, Plant], about: Mapping[str, Any] | None = None) -> None:
    """Write plants in one step; equal plants give equal bytes.

    Args:
        path: target.
        plants: by the id of their lung, such as ``R20C50``.
        about: JSON values that say where they come from.

    Raises:
        ValueError: if a parameter is not finite.
        TypeError: if a plant has a part that no file can hold.
    """
    arrays: dict[str, np.ndarray] = {}
    lungs = {name: _encode(plant, name, arrays) for name, plant in plants.items()}
    stored = {
        name: {"dtype": str(array.dtype), "shape": list(array.shape), "values": array.tolist()}
        for name, array in arrays.items()
    }
    files.write_json(
        path, {"format": FORMAT, "about": dict(about or {}), "lungs": lungs, "arrays": stored}
    )


def load(path: Path, as_array: Callable[[Any], Any] = np.asarray) -> dict[str, Plant]:
    """Read what :func:`save` wrote.

    Args:
        path: of the file.
        as_array: makes the leaves; those of numpy take the precision in force where they are used.

    Returns:
        Plants by the id of their lung, in the order of the file.

    Raises:
        InputError: if the file is not such a file, or names an unknown type of plant.
        OSError: if it cannot be read.
    """
    text = Path(path).read_bytes()
    try:
        plain = json.loads(text)
        if not isinstance(plain, dict) or plain.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        if not plain["lungs"]:
            raise ValueError("it holds no lung")
        arrays = {name: _array(value) for name, value in plain["arrays"].items()}
        return {lung(k).id: _decode(v, arrays, as_array) for k, v in plain["lungs"].items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not a file of plants ({error}); give a corrected.json that "
            "`ventbench diagnose` wrote"
        ) from error


def _array(value: dict[str, Any]) -> np.ndarray:
    dtype = np.dtype(value["dtype"])
    if dtype.kind not in "fiub":
        raise ValueError(f"arrays of {dtype} have no place in it")
    return np.array(value["values"], dtype).reshape(value["shape"])
