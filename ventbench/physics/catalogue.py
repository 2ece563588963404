"""All mechanisms, found by the modules of :mod:`ventbench.physics.mechanisms`."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable
from functools import lru_cache

from ventbench.errors import InputError
from ventbench.physics import base, mechanisms
from ventbench.physics.mechanism import Mechanism
from ventbench.physics.parameters import Parameter


@lru_cache(maxsize=1)
def library() -> dict[str, Mechanism]:
    """Every mechanism by name, in alphabetical order.

    A module of the package ``mechanisms`` holds one, as ``MECHANISM``, under its own name.
    """
    found: dict[str, Mechanism] = {}
    for module in sorted(item.name for item in pkgutil.iter_modules(mechanisms.__path__)):
        mechanism = importlib.import_module(f"{mechanisms.__name__}.{module}").MECHANISM
        if mechanism.description.name != module:
            raise ValueError(f"{module}.py describes {mechanism.description.name!r}")
        found[module] = mechanism
    return found


def mechanism(name: str) -> Mechanism:
    """One mechanism.

    Raises:
        InputError: if there is none of this name.
    """
    try:
        return library()[name]
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
    """Paths of the base parameters and of those of some mechanisms, or of all."""
    chosen = library() if names is None else {name: mechanism(name) for name in names}
    own = [f"{name}.{p.name}" for name, item in chosen.items() for p in item.description.parameters]
    return (*(p.name for p in base.PARAMETERS), *own)


def strength_path(name: str) -> str:
    """Path of a mechanism's strength."""
    return f"{name}.{mechanism(name).description.strength.name}"


def _names(parameters: Iterable[Parameter]) -> str:
    return ", ".join(p.name for p in parameters)
