"""Levenberg-Marquardt method with bounds, for costs with normal equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.linear import solve

#: Cost at a point; cost, gradient and Gauss-Newton Hessian at a point.
Cost = Callable[[Floats], float]
Normal = Callable[[Floats], tuple[float, Floats, Floats]]

#: Most solutions of one step: each pins the unknowns that would leave their bounds.
_PASSES = 4

#: Successive steps with little gain after which the search ends: the valley is flat.
_SLOW = 4


@dataclass(frozen=True)
class Minimum:
    """Point at which a search ended."""

    x: Floats  #: the point, ``(U,)``.
    cost: float  #: cost at the point.
    gradient: Floats  #: gradient at the point, ``(U,)``.
    hessian: Floats  #: Gauss-Newton Hessian at the point, ``(U, U)``.
    iterations: int  #: number of evaluations of the normal equations.
    converged: bool  #: False if the search ran out of iterations.


def minimise(
    cost: Cost,
    normal: Normal,
    x: Floats,
    low: Floats,
    high: Floats,
    *,
    tolerance: float = 1e-3,
    iterations: int = 40,
    warm_start: Minimum | None = None,
) -> Minimum:
    """Search for a local minimum within bounds, starting from ``x``.

    An unknown at a bound that the gradient pushes it against stays there for the step. An unknown
    that would cross its bound ends at the bound, and the rest of the step is solved for again.
    Damping multiplies the diagonal of the Hessian (Marquardt), so that scales do not matter.

    Most steps are accepted, and ``normal`` tells the cost as well. It is therefore asked at once,
    and ``cost`` only after a step has been rejected.

    Args:
        cost: cost at a point; infinity or nan rejects the step.
        normal: the same cost, its gradient and its Gauss-Newton Hessian at a point.
        x: start, ``(U,)``; it is moved into the bounds.
        low: lower bounds, ``(U,)``.
        high: upper bounds, ``(U,)``.
        tolerance: the search ends when the expected decrease of the cost is below it (in nats, if
            the cost is a negative log-likelihood), or after four steps that each gain less than ten
            times the tolerance.
        iterations: most evaluations of ``normal``.
        warm_start: where an earlier search for the same cost ended, if this one starts there; it
            need not be evaluated again.
    """
    if warm_start is None:
        x = np.clip(x, low, high)
        value, gradient, hessian = normal(x)
    else:
        x, value, gradient, hessian = (
            warm_start.x,
            warm_start.cost,
            warm_start.gradient,
            warm_start.hessian,
        )
    damping, slow = 1e-3, 0
    for iteration in range(1, iterations):
        pinned = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))
        accepted, rejected = False, False
        while damping < 1e10:
            step = _step(gradient, hessian, damping, pinned, low - x, high - x)
            trial = np.clip(x + step, low, high)
            expected = -float(gradient @ step + 0.5 * step @ hessian @ step)
            if expected < tolerance and damping <= 1e-2:
                return Minimum(x, value, gradient, hessian, iteration, True)
            reached, *slopes = (cost(trial),) if rejected else normal(trial)
            if reached < value:
                gain = (value - reached) / max(expected, 1e-12)
                damping = max(damping * (0.1 if gain > 0.5 else 1.0 if gain > 0.1 else 3.0), 1e-9)
                accepted = True
                break
            damping *= 8.0
            rejected = True
        if not accepted:  # no smaller value within rounding errors
            return Minimum(x, value, gradient, hessian, iteration, True)
        slow = slow + 1 if value - reached < 10.0 * tolerance else 0
        x, value = trial, reached
        gradient, hessian = slopes or normal(x)[1:]
        if slow == _SLOW:
            return Minimum(x, value, gradient, hessian, iteration, True)
    return Minimum(x, value, gradient, hessian, iterations, False)


def _step(
    gradient: Floats, hessian: Floats, damping: float, pinned: np.ndarray, low: Floats, high: Floats
) -> Floats:
    """Damped Gauss-Newton step; ``low`` and ``high`` bound the step of each unknown."""
    step, free = np.zeros_like(gradient), ~pinned
    floor = 1e-12 * max(float(np.diag(hessian).max(initial=0.0)), 1e-300)
    damped = hessian + np.diag(damping * np.maximum(np.diag(hessian), floor) + floor)
    for _ in range(_PASSES):
        index = np.flatnonzero(free)
        force = gradient[index] + damped[np.ix_(index, np.flatnonzero(~free))] @ step[~free]
        step[index] = -solve(damped[np.ix_(index, index)], force)
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = np.clip(step[beyond], low[beyond], high[beyond])
        free &= ~beyond
    return np.clip(step, low, high)
