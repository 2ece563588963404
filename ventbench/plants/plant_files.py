"""Families of plants, one line each, and their files: JSON, or one ``.npz`` of arrays by path.

A family is known to files, ``--plant`` and the contract tests. Never pickle: a file can only name
the plant types of :data:`FAMILIES`, by their class names. Numbers have full precision: what is read
is to the bit what was written, and equal plants give equal bytes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.physics.model import Physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.learned import MLP, Boundary, Learned
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.two_balloon import TwoBalloon, two_balloon
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung


@dataclass(frozen=True)
class PlantFamily:
    """One kind of plant."""

    #: class of the plants; files name it by the class's name, so that a class that is renamed needs
    #: a line in :data:`RENAMED`.
    plant: type
    #: makes the plant of a lung at its label, if labels are all it needs. The family then has a
    #: name for ``--plant`` and goes through the contract tests of physics plants.
    for_lung: Callable[[Lung], Plant] | None = None
    parts: tuple[type, ...] = ()  #: further classes in its files.


#: By the name that ``--plant`` takes. ``physics`` and the learned ones are more than one line, see
#: :mod:`ventbench.plants.catalog`.
FAMILIES: dict[str, PlantFamily] = {
    "single_compartment": PlantFamily(SingleCompartment, single_compartment),
    "two_balloon": PlantFamily(TwoBalloon, two_balloon),
    "physics": PlantFamily(Physics),
    "corrected": PlantFamily(Corrected),
    "hybrid": PlantFamily(Hybrid),
    "learned": PlantFamily(Learned, parts=(Boundary, MLP)),
}

#: Today's class name by the name that older files have.
RENAMED: dict[str, str] = {}

#: Names of fields in plant files, by class and field, where they differ from the attribute's.
FIELDS_IN_FILES: dict[str, dict[str, str]] = {
    "Corrected": {"with_mechanisms": "wanted", "without_mechanisms": "had"}
}


def stored_type(name: str) -> type:
    """Return the class that a plant file names.

    Raises:
        KeyError: if there is no plant family with such a class.
    """
    types = {
        kind.__name__: kind
        for family in FAMILIES.values()
        for kind in (family.plant, *family.parts)
    }
    return types[RENAMED.get(name, name)]


FORMAT = "ventbench-plants-1"

_STRUCTURE = "structure"


def save_plants(
    path: Path, plants: Mapping[str, Plant], about: Mapping[str, Any] | None = None
) -> None:
    """Write plants by lung id in one step, as JSON or, if the path ends so, as ``.npz``.

    ``about`` are JSON values that say where they come from.

    Raises:
        ValueError: if a parameter of a JSON file is not finite.
        TypeError: if a plant has a part that no file can hold.
    """
    arrays: dict[str, np.ndarray] = {}
    lungs = {name: _encode(plant, name, arrays) for name, plant in plants.items()}
    head = {"format": FORMAT, "about": dict(about or {}), "lungs": lungs}
    if Path(path).suffix == ".npz":
        _write_npz(path, head, arrays)
        return
    stored = {
        name: {"dtype": str(array.dtype), "shape": list(array.shape), "values": array.tolist()}
        for name, array in arrays.items()
    }
    files.write_json(path, {**head, "arrays": stored})


def load_plants(path: Path, as_array: Callable[[Any], Any] = np.asarray) -> dict[str, Plant]:
    """Read what :func:`save_plants` wrote.

    ``as_array`` makes the leaves; those of numpy take the precision in force where they are used.

    Returns:
        Plants by the id of their lung, in the order of the file.

    Raises:
        InputError: if the file is not such a file, or names an unknown type of plant.
        OSError: if it cannot be read.
    """
    try:
        head, arrays = _content(path)
        if not isinstance(head, dict) or head.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        if not head["lungs"]:
            raise ValueError("it holds no lung")
        if "arrays" in head:
            arrays = {name: _array(value) for name, value in head["arrays"].items()}
        return {
            lung(name).id: _decode(node, arrays, as_array) for name, node in head["lungs"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        why = "it is no text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(
            f"{path} is not a file of plants ({why}); give a corrected.json that "
            "`ventbench diagnose` wrote"
        ) from error


def origin(path: Path) -> dict[str, Any]:
    """What a file of :func:`save_plants` says of the making of its plants; empty if nothing.

    Raises:
        OSError: if the file cannot be read.
    """
    try:
        about = _content(path)[0]["about"]
    except (KeyError, TypeError, ValueError):
        return {}
    return dict(about) if isinstance(about, dict) else {}


def _content(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """Structure, and the arrays that stand beside it in an ``.npz``."""
    if Path(path).suffix != ".npz":
        return json.loads(Path(path).read_bytes()), {}
    with np.load(path, allow_pickle=False) as npz:
        return json.loads(str(npz[_STRUCTURE])), dict(npz)


def save_plant(path: Path, plant: Any) -> None:
    """Write one plant, or a stack of plants, as ``.npz`` in one step.

    Raises:
        TypeError: if it has a part that no file can hold.
    """
    arrays: dict[str, np.ndarray] = {}
    _write_npz(path, _encode(plant, "", arrays), arrays)


def load_plant(path: Path, as_array: Callable[[Any], Any] = jnp.asarray) -> Any:
    """Read what :func:`save_plant` wrote.

    ``as_array`` makes the leaves; the default gives them the precision that is in force,
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


def _write_npz(path: Path, structure: Any, arrays: dict[str, np.ndarray]) -> None:
    content: dict[str, Any] = {
        **arrays,
        _STRUCTURE: np.array(json.dumps(structure, sort_keys=True)),
    }
    files.write_atomically(path, lambda file: np.savez(file, **content))


def _encode(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = type(value).__name__
        in_file = FIELDS_IN_FILES.get(kind, {})
        names = [field.name for field in dataclasses.fields(value)]
        stored = {in_file.get(name, name): getattr(value, name) for name in names}
        fields = {name: _encode(x, f"{path}.{name}", arrays) for name, x in stored.items()}
        return {"type": kind, "fields": fields}
    if isinstance(value, tuple | list):
        return {"tuple": [_encode(part, f"{path}.{i}", arrays) for i, part in enumerate(value)]}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        name = path.removeprefix(".")
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, str | int | float | bool) or value is None:
        return {"value": value}
    raise TypeError(f"{path}: a {type(value).__name__} cannot be stored in a plant file")


def _decode(node: dict[str, Any], arrays: Any, as_array: Callable[[Any], Any]) -> Any:
    if "type" in node:
        kind = stored_type(node["type"])
        in_file = FIELDS_IN_FILES.get(kind.__name__, {})
        attributes = {name: attribute for attribute, name in in_file.items()}
        children = {name: _decode(x, arrays, as_array) for name, x in node["fields"].items()}
        return kind(**{str(attributes.get(name, name)): x for name, x in children.items()})
    if "tuple" in node:
        return tuple(_decode(child, arrays, as_array) for child in node["tuple"])
    if "array" in node:
        return as_array(arrays[node["array"]])
    return node["value"]


def _array(value: dict[str, Any]) -> np.ndarray:
    dtype = np.dtype(value["dtype"])
    if dtype.kind not in "fiub":
        raise ValueError(f"arrays of {dtype} have no place in it")
    return np.array(value["values"], dtype).reshape(value["shape"])
