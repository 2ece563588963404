"""What the ways of learning have in common."""

from __future__ import annotations

from typing import Any, Protocol

from jax import Array

from ventbench.interfaces import Plant


class Method(Protocol):
    """A recipe: hashable, so that it can be a static argument of ``jit``; its methods are pure."""

    @property
    def breaths(self) -> int:
        """Episodes in an iteration."""
        ...

    @property
    def iterations(self) -> int:
        """Of the whole training."""
        ...

    def init(self, key: Array) -> Any:
        """State at the start."""
        ...

    def iterate(self, state: Any, plants: Plant) -> Any:
        """State one iteration later, on lungs with leaves ``(L, ...)``."""
        ...

    def policy(self, state: Any) -> Any:
        """What has been learned so far, as a pure controller."""
        ...
