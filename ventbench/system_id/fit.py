"""Fits of the base model with any set of mechanisms to recordings or to simulators' answers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ventbench.physics.catalogue import mechanism, paths
from ventbench.physics.model import Physics
from ventbench.precision import float64
from ventbench.system_id import starts
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.intervals import covariance, quantile
from ventbench.system_id.least_squares import Minimum
from ventbench.system_id.noise import Noise, estimate
from ventbench.system_id.problem import Problem, settings
from ventbench.system_id.unknowns import described, freed, unknowns


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a fit ended.

    Attributes:
        mechanisms: of the hypothesis.
        problem: with the noise that was found or given.
        minimum: of its cost.
        values: physical values of everything, ``(n, P + 1)``, columns as in the simulator.
        residual: simulated minus measured, ``(n, c, T)``.
        log_likelihood: of each breath, ``(n,)``.
        covariance: of the unknowns in coordinates, ``(U, U)``.
    """

    mechanisms: tuple[str, ...]
    problem: Problem
    minimum: Minimum
    values: Floats
    residual: Floats
    log_likelihood: Floats
    covariance: Floats

    @property
    def bic(self) -> float:
        """Bayesian information criterion, by the samples that count; less is better."""
        count = float(self.problem.data.weight.sum())
        return -2.0 * float(self.log_likelihood.sum()) + len(self.minimum.x) * np.log(count)

    def value(self, path: str) -> Floats:
        """Physical values of a free parameter, one for each of its groups."""
        x = self.minimum.x[self.problem.unknowns.of(path)]
        return described(path).physical(x)

    def ci95(self, path: str) -> Floats:
        """Ends of 95 % intervals of a free parameter, ``(groups, 2)``, within its bounds."""
        layout, item = self.problem.unknowns, described(path)
        which = layout.of(path)
        freedom = max(len(self.problem.data) - int(layout.shared.sum()), 4)
        reach = quantile(freedom) * np.sqrt(np.diag(self.covariance)[which])
        x = self.minimum.x[which]
        with np.errstate(over="ignore"):  # of what the data say nothing about
            ends = item.physical(np.stack([x - reach, x + reach], axis=1))
        return np.clip(ends, item.low, item.high)

    def column(self, path: str) -> Floats:
        """Physical value of any parameter in each breath, ``(n,)``."""
        return self.values[:, (*self.problem.simulator.names, START).index(path)]

    def plant(self, breath: int | slice = slice(None)) -> Physics:
        """The fitted plant, in float64: one breath's, or a stack over breaths."""
        names = [name for name in paths(self.mechanisms) if name != "position"]
        names += ["position"] if any(mechanism(m).uses_position for m in self.mechanisms) else []
        simulator = self.problem.simulator
        with float64():
            given = {name: self.column(name)[breath] for name in names}
            plant = Physics((), (), simulator.substeps, simulator.memory).having(**given)
        return plant


def fit(
    data: Data,
    mechanisms: Iterable[str] = (),
    *,
    free: Iterable[str] = (),
    fixed: Mapping[str, ArrayLike] | None = None,
    start: Mapping[str, ArrayLike] | None = None,
    groups: Mapping[str, ArrayLike] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    noise: Noise | None = None,
    simulator: Simulator | None = None,
    iterations: int = 40,
) -> Fit:
    """Fit a hypothesis: R, C, R_ex, PEEP, starting pressures and the mechanisms' parameters.

    Mechanisms start at their mild strength, as some have little slope at zero, and where several
    minima are known to be possible from several values; see :mod:`ventbench.system_id.starts`.

    Args:
        data: from :func:`~ventbench.system_id.data.recorded`.
        mechanisms: names.
        free: further paths, such as ``gain`` or ``leak.exponent``.
        fixed: physical values of paths that stay, a number or one for each breath.
        start: physical values to start from.
        groups: which breaths share a parameter: see :func:`unknowns`.
        prior: mean and standard deviation in coordinates, by path.
        noise: of the measurement; found from the residuals if not given.
        simulator: of the same data with all parameters, to save placing it again.
        iterations: most steps of each search.

    Raises:
        InputError: if a name or a value does not fit.
    """
    mechanisms, fixed, start = tuple(mechanisms), dict(fixed or {}), dict(start or {})
    simulator = simulator or Simulator(data, paths())
    layout = unknowns(
        data, (p for p in dict.fromkeys((*freed(mechanisms), *free)) if p not in fixed), groups
    )
    base = settings(data, simulator.names, fixed)
    mean, precision = layout.prior(prior or {})
    problem = Problem(data, simulator, layout, base, noise or Noise(), mean, precision)
    order = (*simulator.names, START)
    first = {p: base[:, order.index(p)] for p in layout.paths if "." not in p}
    first |= {p: described(p).mild for p in layout.paths if "." in p}
    first |= {p: value for p, value in start.items() if p in layout.paths}
    found = starts.search(problem, layout.pack(first), set(start), iterations)
    for _ in range(2 if noise is None else 0):
        problem = replace(problem, noise=estimate(problem.residual(found.x), data.weight))
        found = starts.descend(problem, found.x, iterations)
    residual = problem.residual(found.x)
    return Fit(
        mechanisms, problem, found, problem.values(found.x), residual,
        problem.noise.log_likelihood(residual, data.weight), covariance(problem, found),
    )  # fmt: skip


def held_out(fit_: Fit, data: Data, *, free: Iterable[str] = ()) -> Fit:
    """Put what a fit has found to other breaths, which refit only what is their own.

    Args:
        fit_: with shared parameters that are the same for all breaths of ``data``.
        data: other breaths; those of one lung, if the fit has several.
        free: paths that may move as well.
    """
    layout, names = fit_.problem.unknowns, fit_.problem.simulator.names
    own = {p for p in layout.paths if described(p).scope == "breath"} | set(free) | {"position"}
    fixed = {name: _of_labels(fit_, data, name) for name in names if name not in own}
    return fit(data, fit_.mechanisms, free=free, fixed=fixed, noise=fit_.problem.noise)


def _of_labels(fit_: Fit, data: Data, path: str) -> Floats:
    """Mean of a parameter over the fitted breaths of the same label, or over all if it is new."""
    known, column = fit_.problem.data, fit_.column(path)
    same = (data.R[:, None] == known.R) & (data.C[:, None] == known.C)
    same |= ~same.any(axis=1, keepdims=True)
    item = described(path)  # rounding must not carry a value at its bound beyond it
    return np.clip(same @ column / same.sum(axis=1), item.low, item.high)
