"""The simulators behind every ``--simulator``: one resolver for names, files, functions and arrays.

====================================  ============================================================
What is given                         What it stands for
====================================  ============================================================
``frozen`` (or ``hybrid``)            the official simulators
``physics``                           R-C lungs at their labels
``two_balloon``, ...                  another family of ``plant_files.FAMILIES`` at the labels
``FILE.json``                         plants of some lungs, such as a ``corrected.json``
``FOLDER``                            what ``ventbench train simulator`` wrote
``FILE.csv``, ``FILE.parquet``        simulated pressures of recorded breaths
``module:name``                       a function or class in plain Python, or a plant; or a mapping
a plant                               that plant for every lung
a mapping                             plants, functions or classes by lung id
a function, class or object           a simulator in plain Python or NumPy; see
                                      :mod:`~ventbench.plants.python_simulators`
an array                              simulated pressures of given breaths
====================================  ============================================================
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np
from numpy.typing import ArrayLike

from ventbench.base import files
from ventbench.base.errors import InputError, InputTypeError
from ventbench.physics import physics
from ventbench.plants import frozen
from ventbench.plants.plant_files import FAMILIES, load_plants, parse_rig_id
from ventbench.plants.python_simulators import (
    PythonSimulators,
    is_jax_plant,
    python_simulator,
)
from ventbench.plants.simulators import (
    FrozenSimulators,
    LabelledPlants,
    OnePlant,
    PlantsByLung,
    SimulatedPressures,
    Simulators,
)
from ventbench.plants.single_compartment import single_compartment
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.foreign.formats import read_table
from ventbench.recordings.read import COLUMNS
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung


class Stepping(Protocol):
    """A simulator in plain Python that runs sample by sample; see ``python_simulators``."""

    @property
    def step(self) -> Callable[..., Any]:
        """Method that holds one command."""
        ...


#: Simulators in plain Python, alone or by lung id; also plants by lung id.
PythonSimulatorLike: TypeAlias = "Stepping | Mapping[str, Any] | Callable[..., Any]"

_ACCEPTED = (
    "a name, a file, a plant, plants by lung id, a function of commands or an array of pressures"
)

#: All that :func:`load_simulators` takes.
SimulatorLike: TypeAlias = "str | Path | Simulators | Plant | PythonSimulatorLike | ArrayLike"


def names() -> tuple[str, ...]:
    """Return the names of simulators that need no file."""
    return tuple(_named())


def load_simulators(
    simulator: SimulatorLike = "frozen", *, breaths: Breaths | None = None
) -> Simulators:
    """Simulators by whatever stands for them; see the table of this module.

    Args:
        simulator: a name, a path, ``"module:name"``, a plant, plants by lung id, a function of
            commands or an array of simulated pressures. What is :class:`Simulators` already is
            returned as it is.
        breaths: the recording that an array answers to, row by row; only for arrays.

    Returns:
        The simulators.

    Raises:
        InputError: if there are no such simulators, or a file is damaged.

    Examples:
        >>> from ventbench import load_simulators
        >>> load_simulators("physics").plant("R20C50").get("C").item()
        50.0
    """
    if isinstance(simulator, Simulators):
        return simulator
    if simulator is None or isinstance(simulator, bool | int | float | Breaths):
        raise InputTypeError("simulator", simulator, _ACCEPTED)
    if isinstance(simulator, str | Path):
        return _by_text(str(simulator))
    if (found := _of_value(simulator)) is not None:
        return found
    return _of_array(simulator, breaths)


def _is_python(value: Any) -> bool:
    """Whether a value is a simulator in plain Python: a function, or a class or object with step.

    Arrays, and pytrees that JAX can trace, are none.
    """
    if isinstance(value, np.ndarray | jax.Array) or is_jax_plant(value):
        return False
    return callable(value) or hasattr(value, "step")


def _python_by_lung(by_id: Mapping[str, Any], name: str, sha256: str | None = None) -> Simulators:
    """Simulators in plain Python by lung id."""
    by_lung = {}
    for key, value in by_id.items():
        if not _is_python(value):
            raise InputError(
                f"{name}, lung {key}: a {type(value).__name__} beside functions and classes; give "
                "plants alone, or functions and classes alone"
            )
        label = lung(key)
        by_lung[label.R, label.C] = python_simulator(value, f"{name}, lung {key}")

    def run(arguments: Mapping[str, Any]) -> ArrayLike:
        label = arguments["R"], arguments["C"]
        if label not in by_lung:
            available = ", ".join(lung(key).id for key in by_id)
            raise InputError(f"{name} have no such lung; they have {available}")
        return by_lung[label](arguments)

    provenance = _provenance("function", sha256, function=name, lungs=sorted(by_id))
    return PythonSimulators(name=name, about=provenance, sha256=sha256, function=run)


def _provenance(kind: str, sha256: str | None, **more: Any) -> dict[str, Any]:
    """What results keep of simulators."""
    return {"kind": kind, **more} | ({} if sha256 is None else {"sha256": sha256})


def _leaves_sha256(plants: Any) -> str:
    """Hash of all parameters, by which results and interrupted work tell plants apart."""
    digest = hashlib.sha256(str(jax.tree.structure(plants)).encode())
    for leaf in jax.tree.leaves(plants):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _by_text(text: str) -> Simulators:
    if text in (named := _named()):
        return named[text]()
    path = Path(text)
    if (path / frozen.MANIFEST).is_file():
        return _frozen(frozen.load(path), path.name)
    if path.is_file():
        name = path.name.lower()
        if name.endswith((".csv", ".csv.gz", ".parquet")):
            return _of_table(read_table(path).columns, path.name, str(path), files.sha256(path))
        if name.endswith(".fmu"):
            raise InputError(
                f"{path} is an FMU, whose machine code nothing here runs; give --simulator "
                "module:name of an object that steps it with fmpy, as docs/own_rig.md shows"
            )
        return _plant_file(path)
    module, colon, attribute = text.partition(":")
    if colon and all(part.isidentifier() for part in (*module.split("."), attribute)):
        return _imported(module, attribute)
    raise InputError(
        f"--simulator {text!r}: there is no such file, nor a simulator of that name; choose "
        f"{', '.join(names())}, a file of plants (.json), a CSV or Parquet file of simulated "
        "pressures, or module:function"
    )


def _official() -> Simulators:
    return _frozen(frozen.load(), "frozen")


def _frozen(loaded: frozen.Frozen, name: str) -> Simulators:
    return FrozenSimulators(
        name=name,
        about=loaded.about(),
        lungs=tuple(map(lung, loaded.lung_ids)),
        sha256=loaded.manifest_sha256,
        trained=loaded,
    )


def _at_label(
    name: str, make: Callable[[Lung], Plant], make_of_breath: Callable[[Lung], Plant]
) -> Simulators:
    return LabelledPlants(name=name, about={"kind": name}, make=make, make_of_breath=make_of_breath)


def _named() -> dict[str, Callable[[], Simulators]]:
    """Loaders of the simulators that need no file, by name."""
    resolvers: dict[str, Callable[[], Simulators]] = {
        "frozen": _official,
        "hybrid": _official,  # the kind of plant that the official ones are
        # Of recorded breaths the exact solution is quicker than the general solver.
        "physics": partial(_at_label, "physics", physics, single_compartment),
    }
    for name, family in FAMILIES.items():
        if family.for_lung is not None:
            resolvers[name] = partial(_at_label, name, family.for_lung, family.for_lung)
    return resolvers


def _of_value(value: Any, text: str | None = None, sha256: str | None = None) -> Simulators | None:
    """Simulators that a mapping, a function, a class, an object or a plant is; None for others.

    Args:
        value: any.
        text: how ``--simulator`` names it, if it does.
        sha256: of the module that it is from; by default that of the parameters of plants.
    """
    if isinstance(value, Mapping):
        if any(_is_python(entry) for entry in value.values()):
            return _python_by_lung(value, text or "the given simulators", sha256)
        digest = sha256 or _leaves_sha256(value)
        about = {"kind": "plants"} | ({"module": text} if text else {"sha256": digest})
        return _plants(dict(value), text or "the given plants", about, digest)
    if _is_python(value):
        name = text or getattr(value, "__qualname__", type(value).__name__)
        about, function = (
            _provenance("function", sha256, function=name),
            python_simulator(value, name),
        )
        return PythonSimulators(name=name, about=about, sha256=sha256, function=function)
    if isinstance(value, Plant):
        name, digest = text or type(value).__name__, sha256 or _leaves_sha256(value)
        about = _provenance("plant", digest, plant=name)
        return OnePlant(name=name, about=about, sha256=digest, given=value)
    return None


def _plants(
    plants: dict[str, Plant],
    name: str,
    about: Mapping[str, Any],
    sha256: str,
    origin: Mapping[str, Any] | None = None,
) -> Simulators:
    if not plants:
        raise InputError(f"{name}: there is no plant in it")
    by_lung: dict[str, Plant] = {}
    by_clock: dict[str, list[tuple[float, Plant]]] = {}
    for key, plant in plants.items():
        if not isinstance(plant, Plant):
            raise InputError(
                f"{name}, lung {key}: a {type(plant).__name__} is no plant; it needs init and step"
            )
        label, interval = parse_rig_id(key)
        if interval is None:
            by_lung[label] = plant
        else:
            by_clock.setdefault(label, []).append((interval, plant))
    if unknown := sorted(by_clock.keys() - by_lung.keys()):
        raise InputError(f"{name}: {unknown[0]} is there at ventilators alone; add it by its id")
    return PlantsByLung(
        name=name,
        about=about,
        lungs=tuple(map(lung, by_lung)),
        sha256=sha256,
        origin=origin or {},
        by_lung=by_lung,
        by_clock=by_clock,
    )


def _plant_file(path: Path) -> Simulators:
    digest = files.sha256(path)
    plants, origin = load_plants(path)
    about = _provenance("file", digest, file=path.name)
    return _plants(plants, path.name, about, digest, origin)


def _imported(module: str, attribute: str) -> Simulators:
    """Simulators that ``module:attribute`` names; modules of the working folder are found too."""
    text = f"{module}:{attribute}"
    sys.path.insert(0, str(Path.cwd()))
    try:
        loaded = importlib.import_module(module)
        value = getattr(loaded, attribute)
    except Exception as error:
        raise InputError(
            f"--simulator {text}: it cannot be imported: {type(error).__name__}: {error}"
        ) from error
    finally:
        sys.path.remove(str(Path.cwd()))
    source = inspect.getsourcefile(loaded)
    digest = files.sha256(Path(source)) if source is not None else None
    if (found := _of_value(value, text, digest)) is not None:
        return found
    raise InputError(
        f"--simulator {text}: a {type(value).__name__} is neither a function, a plant nor plants "
        "by lung id"
    )


def _of_array(values: Any, breaths: Breaths | None) -> Simulators:
    try:
        pressures = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputTypeError("simulator", values, _ACCEPTED) from error
    if breaths is None or pressures.shape != breaths.pressure.shape:
        expected = "the breaths it answers to" if breaths is None else str(breaths.pressure.shape)
        raise InputError(
            f"an array of simulated pressures, shape {pressures.shape}, needs {expected}"
        )
    columns = {name: getattr(breaths, name) for name in ("breath_id", "R", "C")}
    table = {name: np.repeat(x, breaths.valid.sum(axis=1)) for name, x in columns.items()}
    table |= {"u_in": breaths.u_in[breaths.valid], COLUMNS[0]: pressures[breaths.valid]}
    return _of_table(table, "the given pressures", "the given pressures")


def _of_table(
    table: Mapping[str, np.ndarray], name: str, file: str, sha256: str | None = None
) -> Simulators:
    provenance = _provenance("pressures", sha256, **({} if sha256 is None else {"file": name}))
    return SimulatedPressures(name=name, about=provenance, sha256=sha256, table=table, file=file)
