"""All mechanisms, basis terms and events by name, and their parameters by path."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from types import ModuleType

from ventbench.base.errors import InputError
from ventbench.physics import events as happening
from ventbench.physics import mechanisms, nonparametric
from ventbench.physics.mechanism import BASE_PARAMETERS, Mechanism, Parameter

#: What :func:`extended` adds to the library, by name.
_added: dict[str, Mechanism] = {}


@contextmanager
def extended(*added: Mechanism) -> Iterator[None]:
    """Add mechanisms to the library while the block runs, in all threads of the process.

    Models, fits and searches then know them by name, as those of ``physics/mechanisms``.

    Raises:
        InputError: if the catalogue already has a mechanism or basis term of that name.
    """
    names = [mechanism.description.name for mechanism in added]
    for name in names:
        if name in everything() or names.count(name) > 1:
            raise InputError(f"the catalogue already has a mechanism {name!r}; choose another name")
    _added.update(zip(names, added, strict=True))
    _forget()
    try:
        yield
    finally:
        for name in names:
            del _added[name]
        _forget()


def _forget() -> None:
    """Make the library anew when it is next asked for."""
    for cached in (library, everything, paths):
        cached.cache_clear()


@cache
def library() -> dict[str, Mechanism]:
    """Every mechanism by name, in alphabetical order.

    A module of the package ``mechanisms`` defines one or several alike: classes with a description,
    and what it lists in ``MECHANISMS``.
    """
    return dict(sorted((_of(mechanisms) | _added).items()))


@cache
def basis_terms() -> dict[str, Mechanism]:
    """Every basis term of the nonparametric components by name, in alphabetical order.

    Modules of the package ``nonparametric`` define them. They are not in the library;
    a fit has those that its caller names.
    """
    return _of(nonparametric)


@cache
def events() -> dict[str, Mechanism]:
    """Every event by name, in alphabetical order.

    Modules of the package ``events`` define them. They are not in the library: they act in some
    breaths only, or with a phase of each breath.
    """
    return _of(happening)


def intermittent() -> tuple[str, ...]:
    """Events whose strength differs from breath to breath: those that act in some breaths."""
    strengths = ((name, event.description.strength) for name, event in events().items())
    return tuple(name for name, strength in strengths if strength.scope == "breath")


@cache
def everything() -> dict[str, Mechanism]:
    """The library, then the basis terms, then the events."""
    return library() | basis_terms() | events()


def mechanism(name: str) -> Mechanism:
    """A mechanism, basis term or event.

    Raises:
        InputError: if there is none of this name.
    """
    try:
        return everything()[name]
    except KeyError:
        raise InputError(f"no mechanism {name!r}; choose of {', '.join(library())}") from None


def special_cases(term: str) -> tuple[str, ...]:
    """Mechanisms of the library that a basis term contains, exactly or nearly."""
    descriptions = (mechanism.description for mechanism in library().values())
    return tuple(
        description.name for description in descriptions if term in description.special_case_of
    )


def parameter(path: str) -> Parameter:
    """A parameter by its path: ``R``, or ``valve_delay.delay``.

    Raises:
        InputError: if there is none.
    """
    owner, _, short = path.rpartition(".")
    among = mechanism(owner).description.parameters if owner else BASE_PARAMETERS
    for candidate in among:
        if candidate.name == short:
            return candidate
    choices = ", ".join(candidate.name for candidate in among)
    raise InputError(f"no parameter {path!r}; {owner or 'the base'} has {choices}")


@lru_cache
def paths(names: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Paths of the base parameters and of those of some mechanisms, or of the whole library.

    ``paths((*library(), *basis_terms()))`` has those of the basis terms as well.
    """
    inner = [
        f"{name}.{parameter.name}"
        for name in (library() if names is None else names)
        for parameter in mechanism(name).description.parameters
    ]
    return (*(parameter.name for parameter in BASE_PARAMETERS), *inner)


def strength_path(name: str) -> str:
    """Path of a mechanism's strength."""
    return f"{name}.{mechanism(name).description.strength.name}"


def _of(home: ModuleType) -> dict[str, Mechanism]:
    """Mechanisms of a module, or of the modules of a package.

    They are the described classes that it defines, and what it lists in ``MECHANISMS``.
    """
    catalogue: dict[str, Mechanism] = {}
    for module in _modules(home):
        defined = [x() for x in vars(module).values() if _is_described(x, module.__name__)]
        for instance in (*defined, *getattr(module, "MECHANISMS", ())):
            if catalogue.setdefault(instance.description.name, instance) is not instance:
                raise ValueError(f"two mechanisms have the name {instance.description.name!r}")
    return dict(sorted(catalogue.items()))


def _modules(home: ModuleType) -> list[ModuleType]:
    inner = pkgutil.iter_modules(getattr(home, "__path__", ()))
    names = sorted(module.name for module in inner)
    return [importlib.import_module(f"{home.__name__}.{name}") for name in names] or [home]


def _is_described(value: object, module: str) -> bool:
    """Whether a value is a class of mechanisms that a module defines, not imports."""
    if not isinstance(value, type) or value.__module__ != module:
        return False
    return issubclass(value, Mechanism) and "description" in vars(value)
