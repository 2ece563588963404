"""What is taken to act: mechanisms, and which of their parameters are fitted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ventbench.physics.catalogue import mechanism
from ventbench.system_id.unknowns import freed


@dataclass(frozen=True)
class Hypothesis:
    """What is taken to act.

    Attributes:
        names: mechanisms, and elements of slots.
        free: shape parameters that are fitted too, by path.
        fixed: parameters that stand at a value other than their neutral one, by path.
    """

    names: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()

    def plus(self, other: Hypothesis) -> Hypothesis:
        """Both together."""
        return Hypothesis(
            tuple(dict.fromkeys(self.names + other.names)),
            tuple(dict.fromkeys(self.free + other.free)),
            tuple(dict(self.fixed + other.fixed).items()),
        )

    def without(self, *names: str) -> Hypothesis:
        """The same without some mechanisms and what is theirs."""

        def kept(path: str) -> bool:
            return path.rpartition(".")[0] not in names

        return Hypothesis(
            tuple(name for name in self.names if name not in names),
            tuple(path for path in self.free if kept(path)),
            tuple((path, value) for path, value in self.fixed if kept(path)),
        )

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """Of everything that is fitted."""
        fixed = dict(self.fixed)
        return tuple(p for p in dict.fromkeys((*freed(self.names), *self.free)) if p not in fixed)


def has_own(name: str) -> bool:
    """Whether a mechanism has parameters that are each breath's own."""
    return any(item.scope == "breath" for item in mechanism(name).description.parameters)
