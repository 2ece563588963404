"""Intervals by profile likelihood: for what the sum of squares is no parabola in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ventbench.system_id.data import Floats
from ventbench.system_id.fit import Fit
from ventbench.system_id.intervals import quantile
from ventbench.system_id.least_squares import minimise
from ventbench.system_id.unknowns import described

#: Refits towards either end, first to pass it and then to halve the distance.
_OUT, _IN = 14, 8

#: First stride of a kinked parameter, as a share of its range: at a wall the curvature is no guide.
_STRIDE = 0.01

#: Points of a plateau's grid; nats beyond which it ends, and of a dip that may be a sample's noise.
_GRID, _FAR, _DIP = 101, 6.0, 8.0


def profile(fit: Fit, path: str, group: int = 0) -> tuple[float, float]:
    """Ends of the 95 % interval of a free parameter, physical, within its bounds.

    All else is refitted at each value that is tried. The interval holds the values at which the
    cost is less than that of a normal distribution at its 95 % quantile, times what the spread
    between breaths adds to the variance.

    Args:
        fit: where the search ended.
        path: a free parameter.
        group: which of its groups.
    """
    layout = fit.problem.unknowns
    unknown, item = int(layout.of(path)[group]), described(path)
    local = np.linalg.pinv(fit.minimum.hessian)[unknown, unknown]
    grown = max(float(fit.covariance[unknown, unknown] / max(local, 1e-30)), 1.0)
    freedom = max(len(fit.problem.data) - int(layout.shared.sum()), 4)
    allowed = fit.minimum.cost + 0.5 * quantile(freedom) ** 2 * grown
    sd = float(np.sqrt(fit.covariance[unknown, unknown]))
    if item.kinked:
        sd = max(sd, _STRIDE * (item.high - item.low))
    ends = [_end(fit, unknown, sd * side, allowed) for side in (-1.0, 1.0)]
    low, high = (float(np.clip(item.physical(x), item.low, item.high)) for x in ends)
    return low, high


class Interval(NamedTuple):
    """A value and the ends of its 95 % interval, physical."""

    value: float
    low: float
    high: float


def interval(fit: Fit, path: str, group: int = 0) -> Interval:
    """Value and 95 % interval of a free parameter.

    Usually where the search ended and what its curvature says. Of a dead time it is mean and
    central 95 % of the profile likelihood over the whole plateau: in the narrow wall where an edge
    passes a sample a model fits that one sample's noise, a dip of some nats that means nothing. Its
    interval is wider by half a substep at either end.
    """
    item = described(path)
    if item.kinked:
        value = float(fit.value(path)[group])
        found = _plateau(fit, path, group) or Interval(value, *profile(fit, path, group))
        # The simulator smooths an edge over a substep, and knows its time to half of it.
        reach = 0.5 * float(np.median(fit.problem.data.dt)) / fit.problem.simulator.substeps
        ends = np.clip([found.low - reach, found.high + reach], item.low, item.high)
        return Interval(found.value, float(ends[0]), float(ends[1]))
    low, high = fit.ci95(path)[group]
    return Interval(float(fit.value(path)[group]), float(low), float(high))


def _plateau(fit: Fit, path: str, group: int) -> Interval | None:
    """Moments of the profile likelihood on a grid, or None if it is narrower than the grid."""
    unknown, item = int(fit.problem.unknowns.of(path)[group]), described(path)
    grid = np.linspace(item.low, item.high, _GRID)
    nearest = int(np.argmin(np.abs(grid - fit.value(path)[group])))
    costs = np.full(_GRID, np.inf)
    for side in (range(nearest, _GRID), range(nearest - 1, -1, -1)):
        point = fit.minimum.x
        beyond = 0
        for k in side:
            costs[k], point = _pinned(fit, point, unknown, float(item.coordinate(grid[k])))
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
    edges = np.clip(np.concatenate([grid - half, [grid[-1] + half]]), item.low, item.high)
    low, high = np.interp([0.025, 0.975], share, edges)
    return Interval(float(weight @ grid / weight.sum()), float(low), float(high))


def _end(fit: Fit, unknown: int, stride: float, allowed: float) -> float:
    """Coordinate beyond which the refitted cost exceeds what is allowed, or the bound."""
    low, high = fit.problem.unknowns.bounds()
    bound = low[unknown] if stride < 0 else high[unknown]
    inside, point = fit.minimum.x[unknown], fit.minimum.x
    outside = None
    for _ in range(_OUT):
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
    for _ in range(_IN):
        middle = 0.5 * (inside + outside)
        cost, end = _pinned(fit, point, unknown, middle)
        if cost > allowed:
            outside = middle
        else:
            inside, point = middle, end
    return float(0.5 * (inside + outside))


def _pinned(fit: Fit, x: Floats, unknown: int, value: float) -> tuple[float, Floats]:
    """Lowest cost with one unknown held, searched from ``x``, and where it is."""
    low, high = fit.problem.unknowns.bounds()
    low[unknown] = high[unknown] = value
    end = minimise(fit.problem.cost, fit.problem.normal, x, low, high, tolerance=0.02, iterations=8)
    return end.cost, end.x
