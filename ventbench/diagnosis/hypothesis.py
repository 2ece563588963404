"""What is taken to act: mechanisms, and which of their parameters are fitted.

Breaths with their simulator, and a hypothesis fitted to them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.physics.catalogue import mechanism, strength_path
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.least_squares import Minimum
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem
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


@dataclass(frozen=True, eq=False)
class Partition:
    """Some breaths and the simulator of their commands."""

    data: Data
    simulator: Simulator


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A hypothesis fitted to some breaths.

    Attributes:
        hypothesis: what acts.
        problem: of the breaths.
        minimum: of the cost.
        log_likelihood: of the breaths, sum.
    """

    hypothesis: Hypothesis
    problem: Problem
    minimum: Minimum
    log_likelihood: float
    _residual_without: dict[str, Floats] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def values(self) -> Floats:
        """Physical values of everything, ``(n, P + 1)``."""
        return self.problem.values(self.minimum.x)

    @cached_property
    def residual(self) -> Floats:
        """Simulated minus measured, ``(n, c, T)``."""
        return self.problem.residual(self.minimum.x)

    @cached_property
    def jacobian(self) -> tuple[Floats, Floats]:
        """Residual and its derivatives by the coordinates of each path; see :class:`Problem`."""
        return self.problem.jacobian(self.minimum.x)

    def residual_without(self, name: str) -> Floats:
        """Residual with the strength of one mechanism set to zero, ``(n, c, T)``."""
        if name not in self._residual_without:
            values = self.values.copy()
            values[:, self.problem.simulator.names.index(strength_path(name))] = 0.0
            self._residual_without[name] = self.problem.residual_of(values)
        return self._residual_without[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Mechanisms, and elements of slots."""
        return self.hypothesis.names

    @property
    def noise(self) -> Noise:
        """Noise at which it was fitted."""
        return self.problem.noise

    @property
    def shared(self) -> int:
        """Unknowns that are not one breath's own."""
        return int(self.problem.unknowns.shared.sum())

    def column(self, path: str) -> Floats:
        """Physical value of a parameter in each breath, ``(n,)``."""
        return self.values[:, (*self.problem.simulator.names, START).index(path)]

    def log_likelihood_at(self, noise: Noise) -> float:
        """Log-likelihood of its residuals if the noise is another."""
        return float(noise.log_likelihood(self.residual, self.problem.data.weight).sum())


def make_partition(
    data: Data, names: tuple[str, ...], settings: SelectionConfig = DEFAULT
) -> Partition:
    """Combine breaths with a simulator of their commands.

    Args:
        data: the breaths.
        names: parameters of the simulator.
        settings: gives the breaths that are simulated at once.
    """
    return Partition(data, Simulator(data, names, sizes=(settings.data.batch_size,)))
