"""Parameters sorted by what they belong to, and the mechanisms that they bring into play."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import jax.numpy as jnp
from jax import Array

from ventbench.physics import base
from ventbench.physics.idle import acts, unless_idle
from ventbench.physics.mechanism import Mechanism, Values

Before = TypeVar("Before")

_BASE = {item.name: item.neutral for item in base.PARAMETERS}


@dataclass(frozen=True)
class Parts:
    """Parameters sorted by owner, and mechanisms in order of rank.

    Attributes:
        base: of the base model.
        mechanisms: those with a named parameter.
        own: of each of them.
        acting: which of them act, if idle ones are to be skipped.
    """

    base: Values
    mechanisms: dict[str, Mechanism]
    own: dict[str, Values]
    acting: dict[str, Array]

    def change(self, name: str, hook: Callable[..., Before], before: Before, *seen: Any) -> Before:
        """What a mechanism makes of something: ``hook(mechanism, its values, before, *seen)``."""

        def changed(before: Before) -> Before:
            return hook(self.mechanisms[name], self.own[name], before, *seen)

        return unless_idle(self.acting.get(name), changed, before)

    def total(self, term: Callable[[Mechanism, Values], Array | float]) -> Array | float:
        """Sum over mechanisms."""
        return sum(term(item, self.own[name]) for name, item in self.mechanisms.items())


def sort(
    named: Mapping[str, Array], library: Mapping[str, Mechanism], skip_idle: bool = False
) -> Parts:
    """Sort parameters, given by path, and fill in what is not named."""
    # Arrays of numpy, as a file gives them, become what dead times are told by.
    named = {path: jnp.asarray(value) for path, value in named.items()}
    owners = {path.rpartition(".")[0] for path in named}
    chosen = sorted((n for n in library if n in owners), key=lambda n: (library[n].rank, n))
    own = {}
    for name in chosen:
        items = library[name].description.parameters
        own[name] = {p.name: named.get(f"{name}.{p.name}", jnp.asarray(p.neutral)) for p in items}
    given = {name: named.get(name, jnp.asarray(value)) for name, value in _BASE.items()}
    acting = {name: acts(library[name], own[name]) for name in chosen if skip_idle}
    return Parts(given, {name: library[name] for name in chosen}, own, acting)
