"""Families of plants, one line each; plants by lung as JSON, a stack of them as ``.npz``.

A family is known to files, ``--simulator`` and the contract tests. Never pickle: a file can only
name the plant types of :data:`FAMILIES`, by their class names. Numbers have full precision: what is
read is to the bit what was written, and equal plants give equal bytes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.physics.model import Physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.sensed import Sensed, Sensor
from ventbench.plants.single_compartment import SingleCompartment, single_compartment
from ventbench.plants.two_balloon import TwoBalloon, two_balloon
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung


@dataclass(frozen=True)
class PlantFamily:
    """One kind of plant."""

    plant: type  #: class of the plants; files name it by the class's name.
    #: makes the plant of a lung at its label, if labels are all it needs. The family then has a
    #: name for ``--simulator`` and goes through the contract tests of physics plants.
    for_lung: Callable[[Lung], Plant] | None = None


#: By the name that ``--simulator`` takes. ``physics`` and ``frozen`` are more than one line, see
#: :mod:`ventbench.plants.catalog`.
FAMILIES: dict[str, PlantFamily] = {
    "single_compartment": PlantFamily(SingleCompartment, single_compartment),
    "two_balloon": PlantFamily(TwoBalloon, two_balloon),
    "physics": PlantFamily(Physics),
    "corrected": PlantFamily(Corrected),
    "hybrid": PlantFamily(Hybrid),
    "sensed": PlantFamily(Sensed),
}

#: Names of fields in plant files, by class and field, where they differ from the attribute's.
FIELDS_IN_FILES: dict[str, dict[str, str]] = {
    "Corrected": {"with_mechanisms": "wanted", "without_mechanisms": "had"}
}


def stored_type(name: str) -> type:
    """Return the class that a plant file names.

    Raises:
        KeyError: if there is no plant family with such a class.
    """
    classes = {family.plant.__name__: family.plant for family in FAMILIES.values()}
    return {**classes, "Sensor": Sensor}[name]


FORMAT = "ventbench-plants-1"

_STRUCTURE = "structure"


def rig_id(lung_id: str, interval: float) -> str:
    """Id of a lung at one of several ventilators, which its sampling interval, s, tells."""
    return f"{lung_id}@{1000.0 * interval:.4g}ms"


def parse_rig_id(text: str) -> tuple[str, float | None]:
    """Id of a lung, and sampling interval of its ventilator, s, if the text says which.

    Raises:
        InputError: if there is no such lung or interval.
    """
    name, at, interval = text.partition("@")
    if not at:
        return lung(name).id, None
    number = interval.removesuffix("ms")
    if not number.replace(".", "", 1).isdecimal() or not float(number):
        raise InputError(f"{text!r}: no sampling interval; write it as R20C50@33.3ms")
    return lung(name).id, float(number) / 1000.0


def save_plants(
    path: Path, plants: Mapping[str, Plant], about: Mapping[str, Any] | None = None
) -> None:
    """Write plants by lung id, or :func:`rig_id`, as JSON in one step.

    ``about`` are JSON values that say where they come from.

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
    head = {"format": FORMAT, "about": dict(about or {}), "lungs": lungs}
    files.write_json(path, {**head, "arrays": stored})


def load_plants(path: Path) -> tuple[dict[str, Plant], dict[str, Any]]:
    """Read what :func:`save_plants` wrote.

    Returns:
        Plants by the id of their lung, or :func:`rig_id`, in the order of the file, with NumPy
        leaves, which take the precision in force where they are used; and what the file says of
        their making.

    Raises:
        InputError: if the file is not such a file, or names an unknown type of plant.
        OSError: if it cannot be read.
    """
    try:
        head = json.loads(Path(path).read_bytes())
        if not isinstance(head, dict) or head.get("format") != FORMAT:
            raise ValueError(f"its format is not {FORMAT}")
        if not head["lungs"]:
            raise ValueError("it holds no lung")
        arrays = {name: _array(value) for name, value in head["arrays"].items()}
        plants = {}
        for name, node in head["lungs"].items():
            label, interval = parse_rig_id(name)
            key = label if interval is None else rig_id(label, interval)
            plants[key] = _decode(node, arrays)
        return plants, dict(head.get("about", {}))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        why = "it is no text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(
            f"{path} is not a file of plants ({why}); give a corrected.json that "
            "`ventbench diagnose` wrote"
        ) from error


def save_plant(path: Path, plant: Any) -> None:
    """Write one plant, or a stack of plants, as ``.npz`` in one step.

    Raises:
        TypeError: if it has a part that no file can hold.
    """
    arrays: dict[str, np.ndarray] = {}
    structure = np.array(json.dumps(_encode(plant, "", arrays), sort_keys=True))
    content: dict[str, Any] = {**arrays, _STRUCTURE: structure}
    files.write_atomically(path, lambda file: np.savez(file, **content))


def load_plant(path: Path) -> Any:
    """Read what :func:`save_plant` wrote, with NumPy leaves of the precision of the file.

    Raises:
        InputError: if the file is not a plant file, or names an unknown type of plant.
        OSError: if it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return _decode(json.loads(str(arrays[_STRUCTURE])), arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a plant file of ventbench: {error!r}") from error


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


def _decode(node: dict[str, Any], arrays: Any) -> Any:
    if "type" in node:
        kind = stored_type(node["type"])
        in_file = FIELDS_IN_FILES.get(kind.__name__, {})
        attributes = {name: attribute for attribute, name in in_file.items()}
        children = {name: _decode(x, arrays) for name, x in node["fields"].items()}
        return kind(**{str(attributes.get(name, name)): x for name, x in children.items()})
    if "tuple" in node:
        return tuple(_decode(child, arrays) for child in node["tuple"])
    if "array" in node:
        return np.asarray(arrays[node["array"]])
    return node["value"]


def _array(value: dict[str, Any]) -> np.ndarray:
    dtype = np.dtype(value["dtype"])
    if dtype.kind not in "fiub":
        raise ValueError(f"arrays of {dtype} have no place in it")
    return np.array(value["values"], dtype).reshape(value["shape"])
