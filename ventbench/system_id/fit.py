"""Fits of the base model with any set of mechanisms, with covariance and intervals.

Where the cost is no parabola, intervals are by profile likelihood.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats
from ventbench.base.interval import Interval
from ventbench.base.linear import inverse, solve
from ventbench.physics.catalogue import library, mechanism, paths
from ventbench.physics.model import Physics
from ventbench.system_id.data import Data, Noise, robust_noise
from ventbench.system_id.levenberg_marquardt import Minimum, minimise
from ventbench.system_id.predictor import START, Predictor
from ventbench.system_id.problem import (
    GIVEN,
    Partition,
    Problem,
    free_paths,
    make_problem,
    parameter_of,
)

#: Steps of a search before other starts are tried, most rounds of trying, and nats by which another
#: start must be better.
_FIRST_STEPS, _ROUNDS, _BETTER = 8, 3, 1.0

#: Breaths in excess of the shared unknowns from which on the sandwich covariance is used.
_SANDWICH_EXCESS = 10

#: Fewest degrees of freedom of an interval.
_LEAST_FREEDOM = 4

#: Largest leverage of one breath on an unknown.
_LEVERAGE = 0.98


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at the parameters that a fit found."""

    names: tuple[str, ...]  #: mechanisms of the hypothesis.
    problem: Problem  #: the problem with the estimated or given noise.
    minimum: Minimum  #: minimum of its cost.

    @property
    def noise(self) -> Noise:
        """Estimated or given noise."""
        return self.problem.noise

    @cached_property
    def values(self) -> Floats:
        """Physical values of all parameters and of the start, ``(n, P + 1)``."""
        return self.problem.values(self.minimum.x)

    @cached_property
    def residual(self) -> Floats:
        """Predicted minus measured, ``(n, c, T)``."""
        return self.problem.residual_of(self.values)

    @cached_property
    def log_likelihood(self) -> Floats:
        """Log-likelihood of each breath, nats, ``(n,)``."""
        return self.noise.log_likelihood(self.residual, self.problem.data.weight)

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the unknowns in coordinates, ``(U, U)``.

        The inverse Hessian is valid if noise and model are right. The sandwich estimate, which uses
        the spread of the breaths' gradients, is valid if the breaths are independent, whatever
        happens within them (coloured noise, an effect that the model lacks). Each unknown has the
        larger of the two variances; the correlations are those of the inverse Hessian.
        """
        hessian, index = self.minimum.hessian, self.problem.unknowns.index
        floor = 1e-9 * np.maximum(np.diag(hessian), 1e-9)
        bread = inverse(hessian + np.diag(floor))
        per_breath = np.array([len(np.unique(column)) == len(index) for column in index.T])
        common = np.unique(index[:, ~per_breath])
        if len(index) - len(common) < _SANDWICH_EXCESS:
            return bread
        inner = bread[np.ix_(common, common)]
        sandwich = _sandwich(self.problem, self.minimum, per_breath, common, inner)
        grown = np.ones(len(bread))
        grown[common] = np.sqrt(np.maximum(sandwich / np.diag(bread)[common], 1.0))
        return np.asarray(bread * np.outer(grown, grown), np.float64)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of intervals: breaths in excess of the shared unknowns."""
        layout = self.problem.unknowns
        separate = [len(np.unique(column)) == len(column) > 1 for column in layout.index.T]
        by_breath = np.array(separate, bool)[layout.path_of]  # such as a gain of each breath
        shared = int((layout.shared & ~by_breath).sum())
        return max(len(self.problem.data) - shared, _LEAST_FREEDOM)

    def value(self, path: str) -> Floats:
        """Physical values of a free parameter, one for each group of breaths."""
        x = self.minimum.x[self.problem.unknowns.of(path)]
        return parameter_of(path).physical(x)

    def ci95(self, path: str) -> Floats:
        """Ends of the 95 % intervals of a free parameter, within its bounds, ``(groups, 2)``."""
        layout, parameter = self.problem.unknowns, parameter_of(path)
        which = layout.of(path)
        reach = t_quantile(self.freedom) * np.sqrt(np.diag(self.covariance)[which])
        x = self.minimum.x[which]
        with np.errstate(over="ignore"):  # where the data say nothing
            ends = parameter.physical(np.stack([x - reach, x + reach], axis=1))
        return np.clip(ends, parameter.low, parameter.high)

    def column(self, path: str) -> Floats:
        """Physical values of any parameter in each breath, ``(n,)``."""
        return self.values[:, (*self.problem.predictor.names, START).index(path)]

    def plant(self, breath: int | slice = slice(None)) -> Physics:
        """The fitted model as a plant in float64: of one breath, or stacked over breaths."""
        names = [name for name in paths(self.names) if name not in GIVEN]
        names += ["position"] if any(mechanism(m).uses_position for m in self.names) else []
        return self.problem.predictor.plant({name: self.column(name)[breath] for name in names})


def fit(
    data: Data,
    mechanisms: Iterable[str] = (),
    *,
    free: Iterable[str] = (),
    fixed: Mapping[str, ArrayLike] | None = None,
    start: Mapping[str, ArrayLike] | None = None,
    gain_sd: float = 0.0,
    noise: Noise | None = None,
    predictor: Predictor | None = None,
    iterations: int = 40,
) -> Fit:
    """Fit a hypothesis: R, C, R_ex, PEEP, starting pressures and parameters of mechanisms.

    Shared parameters with several known minima are searched from several starts.

    Args:
        data: data from :func:`~ventbench.system_id.data.make_data`.
        mechanisms: names of the hypothesis.
        free: further free paths, such as ``gain`` or ``leak.exponent``.
        fixed: physical values of paths that stay fixed, a number or one for each breath.
        start: physical values to start from.
        gain_sd: prior standard deviation of the logarithm of each breath's valve gain, which is
            then fitted too; 0 if all breaths have the same gain.
        noise: measurement noise; estimated from the residuals if not given.
        predictor: predictor of the same data with all parameters, to avoid padding the data again.
        iterations: most steps of each search.

    Raises:
        InputError: if a name or a value does not fit.
    """
    mechanisms, fixed, start = tuple(mechanisms), dict(fixed or {}), dict(start or {})
    if predictor is None:
        terms = [name for name in mechanisms if name not in library()]
        predictor = Predictor(data, paths((*library(), *terms)))
    chosen = (p for p in dict.fromkeys((*free_paths(mechanisms), *free)) if p not in fixed)
    problem = make_problem(Partition(data, predictor), chosen, noise or Noise(), fixed, gain_sd)
    minimum = _search(problem, start, iterations)
    for _ in range(2 if noise is None else 0):
        problem = replace(problem, noise=robust_noise(problem.residual(minimum.x), data.weight))
        minimum = _descend(problem, minimum.x, iterations)
    return Fit(mechanisms, problem, minimum)


def _descend(problem: Problem, x: Floats, iterations: int) -> Minimum:
    """Search from one start."""
    low, high = problem.unknowns.bounds()
    x = problem.smoothed_start(x, iterations=iterations)
    return minimise(problem.cost, problem.normal, x, low, high, iterations=iterations)


def _search(problem: Problem, start: Mapping[str, ArrayLike], iterations: int) -> Minimum:
    """Search from given values, then try the values of ``Parameter.scan`` with all else as minimum.

    The search continues from a value that is better. Paths whose start is given are not scanned.
    """
    free = {path: parameter_of(path) for path in problem.unknowns.paths if path not in start}
    scanned = [
        path
        for path, definition in free.items()
        if definition.scan and definition.scope == "shared"
    ]
    minimum = _descend(problem, problem.start(start), _FIRST_STEPS if scanned else iterations)
    for _ in range(_ROUNDS if scanned else 0):
        better = problem.best_of_scan(minimum, scanned, _BETTER)
        if better is None:
            break
        minimum = _descend(problem, better, iterations)
    relocated = problem.at_likeliest_changes(minimum.x, _BETTER)
    if relocated is None and minimum.converged:
        return minimum
    return _descend(problem, minimum.x if relocated is None else relocated, iterations)


def _sandwich(
    problem: Problem, minimum: Minimum, per_breath: np.ndarray, common: np.ndarray, bread: Floats
) -> Floats:
    """Sandwich variances of the shared unknowns, from the spread between breaths, ``(s,)``.

    A breath with high leverage hides its own deviation. Each gradient is therefore scaled by the
    breath's leverage, as leaving the breath out would (cluster jackknife, CR3).
    """
    _, gradients, curvatures = problem.scores(minimum.x)
    layout = problem.unknowns
    if per_breath.any():  # eliminate the unknowns of single breaths (Schur complement)
        prior_precision = problem.precision[layout.index[:, per_breath]][:, :, None] * np.eye(
            int(per_breath.sum())
        )
        inner = curvatures[:, per_breath][:, :, per_breath] + prior_precision
        inner = inner + 1e-9 * np.maximum(inner.max(axis=(1, 2), keepdims=True), 1e-9) * np.eye(
            inner.shape[1]
        )
        across = solve(inner, curvatures[:, per_breath][:, :, ~per_breath]).swapaxes(1, 2)
        gradients, curvatures = (
            gradients[:, ~per_breath] - np.matmul(across, gradients[:, per_breath, None])[:, :, 0],
            curvatures[:, ~per_breath][:, :, ~per_breath]
            - np.matmul(across, curvatures[:, per_breath][:, :, ~per_breath]),
        )
    else:
        gradients, curvatures = (
            gradients[:, ~per_breath],
            curvatures[:, ~per_breath][:, :, ~per_breath],
        )
    rows, place = np.arange(len(gradients)), np.searchsorted(common, layout.index[:, ~per_breath])
    forces = np.zeros((len(rows), len(common)))
    np.add.at(forces, (rows[:, None], place), gradients)
    shares = np.zeros((len(rows), len(common), len(common)))
    np.add.at(shares, (rows[:, None, None], place[:, :, None], place[:, None, :]), curvatures)
    forces -= forces.mean(axis=0)
    residual_maker = np.eye(len(common)) - _LEVERAGE * np.matmul(shares, bread)
    spread = solve(residual_maker, forces[:, :, None])[:, :, 0] @ bread
    return np.asarray(np.sum(spread**2, axis=0) * (1.0 - 1.0 / len(rows)), np.float64)


def t_quantile(freedom: float) -> float:
    """The 97.5 % quantile of Student's t distribution.

    Args:
        freedom: degrees of freedom, above 0.
    """
    # Here, not above: scipy's special functions take a third of a second to import.
    from scipy import special

    return float(special.stdtrit(freedom, 0.975))


#: Most refits towards an end of an interval, to bracket it and then to find it; and to what share
#: of the last stride it is found.
_BRACKETING, _REFITS, _RESOLVED = 14, 8, 0.01

#: First stride, as a share of the way to the end by the covariance, a little more than that, so
#: that it brackets the end; and for a kinked parameter, as a share of its range: at a steep wall of
#: the likelihood the curvature says nothing.
_FIRST, _STRIDE = 1.1, 0.01

#: Points of the grid over a plateau, nats below which the plateau ends, and depth of a dip, in
#: nats, that the noise of a single sample may cause.
_GRID, _CUTOFF, _DIP = 101, 6.0, 8.0

#: Nats by which a place of a change is left out of its interval: odds of 20 to one.
_UNLIKELY = 3.0


def profile_interval(fit: Fit, path: str, group: int = 0) -> tuple[float, float]:
    """Ends of the 95 % profile-likelihood interval of a free parameter, within its bounds.

    All other unknowns are refitted at each trial value. The interval contains the values whose cost
    exceeds the minimum by less than half the squared 97.5 % quantile of Student's t, times the
    factor by which the sandwich covariance exceeds the inverse Hessian.
    """
    layout = fit.problem.unknowns
    unknown, parameter = int(layout.of(path)[group]), parameter_of(path)
    local = np.linalg.pinv(fit.minimum.hessian)[unknown, unknown]
    grown = max(float(fit.covariance[unknown, unknown] / max(local, 1e-30)), 1.0)
    allowed = fit.minimum.cost + 0.5 * t_quantile(fit.freedom) ** 2 * grown
    sd = float(np.sqrt(fit.covariance[unknown, unknown]))
    if parameter.kinked:
        sd = max(sd, _STRIDE * (parameter.high - parameter.low))
    else:
        sd *= _FIRST * t_quantile(fit.freedom)
    ends = [_end(fit, unknown, sd * side, allowed) for side in (-1.0, 1.0)]
    low, high = (float(np.clip(parameter.physical(x), parameter.low, parameter.high)) for x in ends)
    return low, high


def likely_places(places: Floats, costs: Floats, value: float) -> Interval:
    """A change at ``value``, and the places that are at most 20 times less likely than the best."""
    likely = [value, *places[costs < costs.min(initial=np.inf) + _UNLIKELY]]
    return Interval(value, min(likely), max(likely))


def interval(fit: Fit, path: str, group: int = 0) -> Interval:
    """Estimate and 95 % interval of a free parameter.

    In general, these are the minimum and the interval of the covariance. For a dead time, they are
    the mean and the central 95 % of the profile likelihood over its whole plateau: in the narrow
    wall where an edge passes a sample, the model can fit the noise of that one sample, a dip of
    some nats without meaning. The interval of a dead time is wider by half a substep at either end.
    That of a change point holds the places that are at most 20 times less likely than the best.
    """
    parameter = parameter_of(path)
    if parameter.change_point:
        places, costs = fit.problem.change_costs(fit.minimum.x, path)
        return likely_places(places, costs, float(fit.value(path)[group]))
    if parameter.kinked:
        value = float(fit.value(path)[group])
        estimate = _plateau(fit, path, group) or Interval(
            value, *profile_interval(fit, path, group)
        )
        # The predictor smooths an edge over a substep, and resolves its time to half of it.
        reach = 0.5 * float(np.median(fit.problem.data.dt)) / fit.problem.predictor.substeps
        reach *= parameter.unit == "s"
        ends = np.clip([estimate.low - reach, estimate.high + reach], parameter.low, parameter.high)
        return Interval(estimate.value, float(ends[0]), float(ends[1]))
    low, high = fit.ci95(path)[group]
    return Interval(float(fit.value(path)[group]), float(low), float(high))


def _plateau(fit: Fit, path: str, group: int) -> Interval | None:
    """Mean and quantiles of the profile likelihood on a grid; None if it is narrower than that."""
    unknown, parameter = int(fit.problem.unknowns.of(path)[group]), parameter_of(path)
    grid = np.linspace(parameter.low, parameter.high, _GRID)
    nearest = int(np.argmin(np.abs(grid - fit.value(path)[group])))
    costs = np.full(_GRID, np.inf)
    for side in (range(nearest, _GRID), range(nearest - 1, -1, -1)):
        point = fit.minimum.x
        beyond = 0
        for k in side:
            costs[k], point = _pinned(fit, point, unknown, float(parameter.coordinate(grid[k])))
            beyond = (
                beyond + 1 if costs[k] > min(costs.min(), fit.minimum.cost + _DIP) + _CUTOFF else 0
            )
            if beyond == 2:
                break
    if costs.min() > fit.minimum.cost + _DIP:
        return None
    weight = np.exp(costs.min() - costs)
    if np.sum(weight > 0.05) < 3:
        return None
    share = np.concatenate([[0.0], np.cumsum(weight)]) / weight.sum()
    half = 0.5 * (grid[1] - grid[0])
    edges = np.clip(np.concatenate([grid - half, [grid[-1] + half]]), parameter.low, parameter.high)
    low, high = np.interp([0.025, 0.975], share, edges)
    return Interval(float(weight @ grid / weight.sum()), float(low), float(high))


def _end(fit: Fit, unknown: int, stride: float, allowed: float) -> float:
    """Coordinate beyond which the profile cost exceeds ``allowed``, or the bound."""
    from scipy import optimize  # here, as it takes long to import

    low, high = fit.problem.unknowns.bounds()
    bound = low[unknown] if stride < 0 else high[unknown]
    inside, point = float(fit.minimum.x[unknown]), fit.minimum.x
    target = float(np.sqrt(allowed - fit.minimum.cost))
    roots = {inside: -target}

    def beyond(x: float) -> float:
        """Root of the cost, which a parabola makes linear, beyond the target."""
        nonlocal point
        if x not in roots:
            cost, end = _pinned(fit, point, unknown, x)
            point = end if cost <= allowed else point
            roots[x] = float(np.sqrt(max(cost - fit.minimum.cost, 0.0))) - target
        return roots[x]

    for _ in range(_BRACKETING):
        trial = float(np.clip(inside + stride, low[unknown], high[unknown]))
        if beyond(trial) > 0.0:
            between = optimize.brentq(
                beyond,
                inside,
                trial,
                xtol=_RESOLVED * abs(stride),
                maxiter=_REFITS,
                full_output=True,
                disp=False,
            )
            return float(between[0])
        inside, stride = trial, 1.6 * stride
        if trial == bound:
            return float(bound)
    return inside


def _pinned(fit: Fit, x: Floats, unknown: int, value: float) -> tuple[float, Floats]:
    """Lowest cost with one unknown held, and its point, searched from ``x``.

    The others start where the parabola at the minimum has them, unless a wall of the likelihood
    makes that worse than ``x``.
    """
    problem, hessian = fit.problem, fit.minimum.hessian
    low, high = problem.unknowns.bounds()
    free = np.arange(len(x)) != unknown
    ahead, x = np.zeros_like(x), x.copy()
    ahead[free] = -solve(hessian[np.ix_(free, free)], hessian[free, unknown])
    there = np.clip(x + ahead * (value - x[unknown]), low, high)
    x[unknown] = there[unknown] = low[unknown] = high[unknown] = value
    start = np.stack([x, there])
    x = start[int(np.argmin(problem.costs(start)))]
    end = minimise(problem.cost, problem.normal, x, low, high, tolerance=0.02, iterations=8)
    return end.cost, end.x
