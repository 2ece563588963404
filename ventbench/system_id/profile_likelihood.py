"""Intervals by profile likelihood, for parameters in which the cost is no parabola."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ventbench.system_id.data import Floats
from ventbench.system_id.fit import Fit, t_quantile
from ventbench.system_id.levenberg_marquardt import minimise
from ventbench.system_id.problem import parameter_of

#: Most refits towards an end of an interval: to bracket it, and then to bisect.
_BRACKETING, _BISECTIONS = 14, 8

#: First stride for a kinked parameter, as a share of its range: at a steep wall of the likelihood
#: the curvature says nothing.
_STRIDE = 0.01

#: Points of the grid over a plateau, nats below which the plateau ends, and depth of a dip, in
#: nats, that the noise of a single sample may cause.
_GRID, _FAR, _DIP = 101, 6.0, 8.0

#: Nats by which a place of a change is left out of its interval: odds of 20 to one.
_UNLIKELY = 3.0


def profile_interval(fit: Fit, path: str, group: int = 0) -> tuple[float, float]:
    """Ends of the 95 % profile-likelihood interval of a free parameter, within its bounds.

    All other unknowns are refitted at each trial value. The interval contains the values whose cost
    exceeds the minimum by less than half the squared 97.5 % quantile of Student's t, times the
    factor by which the sandwich covariance exceeds the inverse Hessian.

    Args:
        fit: a fit.
        path: a free parameter.
        group: index of the group of breaths.
    """
    layout = fit.problem.unknowns
    unknown, parameter = int(layout.of(path)[group]), parameter_of(path)
    local = np.linalg.pinv(fit.minimum.hessian)[unknown, unknown]
    grown = max(float(fit.covariance[unknown, unknown] / max(local, 1e-30)), 1.0)
    allowed = fit.minimum.cost + 0.5 * t_quantile(fit.freedom) ** 2 * grown
    sd = float(np.sqrt(fit.covariance[unknown, unknown]))
    if parameter.kinked:
        sd = max(sd, _STRIDE * (parameter.high - parameter.low))
    ends = [_end(fit, unknown, sd * side, allowed) for side in (-1.0, 1.0)]
    low, high = (float(np.clip(parameter.physical(x), parameter.low, parameter.high)) for x in ends)
    return low, high


class ConfidenceInterval(NamedTuple):
    """An estimate and the ends of its 95 % interval, in physical units."""

    value: float
    low: float
    high: float


def interval(fit: Fit, path: str, group: int = 0) -> ConfidenceInterval:
    """Estimate and 95 % interval of a free parameter.

    In general, these are the minimum and the interval of the covariance. For a dead time, they are
    the mean and the central 95 % of the profile likelihood over its whole plateau: in the narrow
    wall where an edge passes a sample, the model can fit the noise of that one sample, a dip of
    some nats without meaning. The interval of a dead time is wider by half a substep at either end.
    That of a change point holds the places that are at most 20 times less likely than the best.
    """
    parameter = parameter_of(path)
    if parameter.change_point:
        value = float(fit.value(path)[group])
        places, costs = fit.problem.change_costs(fit.minimum.x, path)
        likely = [value, *places[costs < costs.min(initial=np.inf) + _UNLIKELY]]
        return ConfidenceInterval(value, min(likely), max(likely))
    if parameter.kinked:
        value = float(fit.value(path)[group])
        estimate = _plateau(fit, path, group) or ConfidenceInterval(
            value, *profile_interval(fit, path, group)
        )
        # The predictor smooths an edge over a substep, and resolves its time to half of it.
        reach = 0.5 * float(np.median(fit.problem.data.dt)) / fit.problem.predictor.substeps
        reach *= parameter.unit == "s"
        ends = np.clip([estimate.low - reach, estimate.high + reach], parameter.low, parameter.high)
        return ConfidenceInterval(estimate.value, float(ends[0]), float(ends[1]))
    low, high = fit.ci95(path)[group]
    return ConfidenceInterval(float(fit.value(path)[group]), float(low), float(high))


def _plateau(fit: Fit, path: str, group: int) -> ConfidenceInterval | None:
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
                beyond + 1 if costs[k] > min(costs.min(), fit.minimum.cost + _DIP) + _FAR else 0
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
    return ConfidenceInterval(float(weight @ grid / weight.sum()), float(low), float(high))


def _end(fit: Fit, unknown: int, stride: float, allowed: float) -> float:
    """Coordinate beyond which the profile cost exceeds ``allowed``, or the bound."""
    low, high = fit.problem.unknowns.bounds()
    bound = low[unknown] if stride < 0 else high[unknown]
    inside, point = fit.minimum.x[unknown], fit.minimum.x
    outside = None
    for _ in range(_BRACKETING):
        trial = float(np.clip(inside + stride, low[unknown], high[unknown]))
        cost, end = _pinned(fit, point, unknown, trial)
        if cost > allowed:
            outside = trial
            break
        inside, point, stride = trial, end, 1.6 * stride
        if trial == bound:
            return float(bound)
    if outside is None:
        return float(inside)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inside + outside)
        cost, end = _pinned(fit, point, unknown, middle)
        if cost > allowed:
            outside = middle
        else:
            inside, point = middle, end
    return float(0.5 * (inside + outside))


def _pinned(fit: Fit, x: Floats, unknown: int, value: float) -> tuple[float, Floats]:
    """Lowest cost with one unknown held, and its point, searched from ``x``."""
    low, high = fit.problem.unknowns.bounds()
    low[unknown] = high[unknown] = value
    end = minimise(fit.problem.cost, fit.problem.normal, x, low, high, tolerance=0.02, iterations=8)
    return end.cost, end.x
