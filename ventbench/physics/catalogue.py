"""All mechanisms and elements of slots, found by the modules of their packages."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable
from functools import lru_cache
from types import ModuleType

from ventbench.errors import InputError
from ventbench.physics import base, mechanisms
from ventbench.physics import nonparametric as places
from ventbench.physics.mechanism import Mechanism
from ventbench.physics.parameters import Parameter


@lru_cache(maxsize=1)
def library() -> dict[str, Mechanism]:
    """Every mechanism by name, in alphabetical order.

    A module of the package ``mechanisms`` holds one, as ``MECHANISM``, under its own name.
    """
    return _found(mechanisms)


@lru_cache(maxsize=1)
def slots() -> dict[str, Mechanism]:
    """Every element of a slot by name, in alphabetical order: shapes that have no name.

    Modules of the package ``slots`` hold them in the same way, except those whose names begin with
    an underscore. They are not in the library; a fit that names them has them.
    """
    return _found(places)


@lru_cache(maxsize=1)
def everything() -> dict[str, Mechanism]:
    """The library, then the elements of slots."""
    return library() | slots()


def mechanism(name: str) -> Mechanism:
    """One mechanism, or element of a slot.

    Raises:
        InputError: if there is none of this name.
    """
    try:
        return everything()[name]
    except KeyError:
        raise InputError(f"no mechanism {name!r}; choose of {', '.join(library())}") from None


def parameter(path: str) -> Parameter:
    """A parameter by its path: ``R``, or ``valve_delay.delay``.

    Raises:
        InputError: if there is none.
    """
    owner, _, short = path.rpartition(".")
    among = mechanism(owner).description.parameters if owner else base.PARAMETERS
    for item in among:
        if item.name == short:
            return item
    raise InputError(f"no parameter {path!r}; {owner or 'the base'} has {_names(among)}")


@lru_cache
def paths(names: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Paths of the base parameters and of those of some mechanisms, or of the whole library.

    ``paths((*library(), *slots()))`` has the elements of slots as well.
    """
    chosen = library() if names is None else {name: mechanism(name) for name in names}
    own = [f"{name}.{p.name}" for name, item in chosen.items() for p in item.description.parameters]
    return (*(p.name for p in base.PARAMETERS), *own)


def strength_path(name: str) -> str:
    """Path of a mechanism's strength."""
    return f"{name}.{mechanism(name).description.strength.name}"


def _found(package: ModuleType) -> dict[str, Mechanism]:
    found: dict[str, Mechanism] = {}
    modules = sorted(item.name for item in pkgutil.iter_modules(package.__path__))
    for module in (name for name in modules if not name.startswith("_")):
        mechanism = importlib.import_module(f"{package.__name__}.{module}").MECHANISM
        if mechanism.description.name != module:
            raise ValueError(f"{module}.py describes {mechanism.description.name!r}")
        found[module] = mechanism
    return found


def _names(parameters: Iterable[Parameter]) -> str:
    return ", ".join(p.name for p in parameters)
