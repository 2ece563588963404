"""Breaths with their simulator, and a hypothesis fitted to them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ventbench.diagnosis.effort import EFFORT
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.physics.catalogue import strength_path
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.least_squares import Minimum
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem

#: Breaths that are simulated at once: one number, so that little is compiled and held in memory.
#: Two thirds of 60 breaths are one part; many breaths at once hide what starting each step costs.
_SIZES = (40,)


@dataclass(frozen=True, eq=False)
class Side:
    """Some breaths and the simulator of their commands."""

    data: Data
    simulator: Simulator


@dataclass(frozen=True, eq=False)
class Solved:
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

    @cached_property
    def quiet(self) -> Floats:
        """Residual if the patient were passive, ``(n, c, T)``."""
        values = self.values.copy()
        values[:, self.problem.simulator.names.index(strength_path(EFFORT))] = 0.0
        return self.problem.residual_of(values)

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

    def likelihood_at(self, noise: Noise) -> float:
        """Log-likelihood of its residuals if the noise is another."""
        return float(noise.log_likelihood(self.residual, self.problem.data.weight).sum())


def simulator(data: Data, names: tuple[str, ...]) -> Simulator:
    """Place some breaths in parts of one size."""
    return Simulator(data, names, sizes=_SIZES)
