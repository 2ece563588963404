"""A hypothesis, the breaths that it is fitted to, and the fitted model."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.physics.catalogue import mechanism, strength_path
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.levenberg_marquardt import Minimum
from ventbench.system_id.noise import Noise
from ventbench.system_id.predictor import START, Predictor
from ventbench.system_id.problem import Problem, free_paths


@dataclass(frozen=True)
class Hypothesis:
    """The base model plus a set of terms: mechanisms, and basis terms of nonparametric components.

    Attributes:
        names: the terms, in the order in which they were added.
        free: shape parameters that are fitted as well, by path.
        fixed: parameters that keep a value other than their neutral one, by path.
    """

    names: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    fixed: tuple[tuple[str, float], ...] = ()

    def plus(self, other: Hypothesis) -> Hypothesis:
        """The union of two hypotheses; ``other`` wins where both fix a parameter."""
        return Hypothesis(
            tuple(dict.fromkeys(self.names + other.names)),
            tuple(dict.fromkeys(self.free + other.free)),
            tuple(dict(self.fixed + other.fixed).items()),
        )

    def without(self, *names: str) -> Hypothesis:
        """The hypothesis without some terms and their parameters."""

        def kept(path: str) -> bool:
            return path.rpartition(".")[0] not in names

        return Hypothesis(
            tuple(name for name in self.names if name not in names),
            tuple(path for path in self.free if kept(path)),
            tuple((path, value) for path, value in self.fixed if kept(path)),
        )

    def with_default(self, path: str) -> Hypothesis:
        """The hypothesis with a shape parameter at its default."""
        return Hypothesis(self.names, tuple(p for p in self.free if p != path), self.fixed)

    @property
    def breath_terms(self) -> tuple[str, ...]:
        """Terms with parameters that differ from breath to breath."""
        return tuple(name for name in self.names if varies_by_breath(name))

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """Paths of all parameters that are fitted."""
        fixed = dict(self.fixed)
        paths = dict.fromkeys((*free_paths(self.names), *self.free))
        return tuple(path for path in paths if path not in fixed)


def varies_by_breath(name: str) -> bool:
    """Whether a term has parameters that differ from breath to breath."""
    return any(parameter.scope == "breath" for parameter in mechanism(name).description.parameters)


@dataclass(frozen=True, eq=False)
class Partition:
    """Breaths, such as the training breaths, with the predictor of their readings."""

    data: Data
    predictor: Predictor


def make_partition(
    data: Data, names: tuple[str, ...], settings: SelectionConfig = DEFAULT
) -> Partition:
    """Combine breaths with a predictor of their measurements.

    Args:
        data: the breaths.
        names: paths of the predictor's parameters.
        settings: give the number of breaths that are simulated at once.
    """
    return Partition(data, Predictor(data, names, sizes=(settings.data.batch_size,)))


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A hypothesis at its maximum-likelihood parameters.

    Attributes:
        hypothesis: the terms.
        problem: data, noise and unknowns of the fit.
        minimum: minimum of the problem's cost.
        log_likelihood: log-likelihood of all its breaths, nats.
    """

    hypothesis: Hypothesis
    problem: Problem
    minimum: Minimum
    log_likelihood: float
    _residual_without: dict[str, Floats] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def values(self) -> Floats:
        """Physical values of all parameters and of the start, ``(n, P + 1)``."""
        return self.problem.values(self.minimum.x)

    @cached_property
    def residual(self) -> Floats:
        """Simulated minus measured, ``(n, c, T)``."""
        return self.problem.residual(self.minimum.x)

    @cached_property
    def jacobian(self) -> tuple[Floats, Floats]:
        """Residual and its derivative by the free parameters; see :meth:`Problem.jacobian`."""
        return self.problem.jacobian(self.minimum.x)

    def residual_without(self, name: str) -> Floats:
        """Residual with the strength of one mechanism set to zero, ``(n, c, T)``."""
        if name not in self._residual_without:
            values = self.values.copy()
            values[:, self.problem.predictor.names.index(strength_path(name))] = 0.0
            self._residual_without[name] = self.problem.residual_of(values)
        return self._residual_without[name]

    @property
    def names(self) -> tuple[str, ...]:
        """The hypothesis's terms."""
        return self.hypothesis.names

    @property
    def noise(self) -> Noise:
        """Noise that was assumed in the fit."""
        return self.problem.noise

    @property
    def shared_count(self) -> int:
        """Number of unknowns that several breaths share."""
        return int(self.problem.unknowns.shared.sum())

    def column(self, path: str) -> Floats:
        """Physical value of one parameter in each breath, ``(n,)``."""
        return self.values[:, (*self.problem.predictor.names, START).index(path)]

    def log_likelihood_at(self, noise: Noise) -> float:
        """Log-likelihood of the residuals under another noise, nats."""
        return float(noise.log_likelihood(self.residual, self.problem.data.weight).sum())
