"""Levenberg-Marquardt within bounds, for sums whose normal equations are at hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ventbench.physics.fits.data import Floats

#: Cost and, on demand, gradient and approximate Hessian at a point.
Cost = Callable[[Floats], float]
Normal = Callable[[Floats], tuple[float, Floats, Floats]]

#: Gradient and approximate Hessian by carried derivatives, at the point whose cost was asked last.
Near = Callable[[Floats], tuple[Floats, Floats]]

#: Times that a step is found anew since unknowns would leave their bounds.
_PASSES = 4

#: Steps in a row that hardly lower the cost after which a valley is called flat.
_SLOW = 4

#: Share of the expected fall from which a step is good, and derivatives are carried on; the most
#: times in a row; share (and one over it) within which those carried once may tell that it is over.
_GOOD, _CARRIED, _TRUSTED = 0.5, 3, 0.7


@dataclass(frozen=True)
class Minimum:
    """Where a search ended.

    Attributes:
        x: the point, ``(U,)``.
        cost: there.
        gradient: there, ``(U,)``.
        hessian: its Gauss-Newton approximation there, ``(U, U)``; cruder, like the gradient, if
            derivatives were carried.
        iterations: derivatives that were computed.
        converged: False if it ran out of iterations.
    """

    x: Floats
    cost: float
    gradient: Floats
    hessian: Floats
    iterations: int
    converged: bool


def minimise(
    cost: Cost, normal: Normal, x: Floats, low: Floats, high: Floats, *, near: Near | None = None,
    warm: bool = False, tolerance: float = 1e-3, iterations: int = 40,
) -> Minimum:  # fmt: skip
    """Search for a minimum from ``x``.

    Unknowns at a bound that the gradient pushes against stay there for the step; others that would
    pass theirs end there, and the rest of the step is found anew. Damping is by
    Marquardt's diagonal, so that scales do not matter.

    Args:
        cost: value at a point; infinite or nan is a step too far.
        normal: also gradient and Gauss-Newton Hessian.
        x: start, moved into the bounds, ``(U,)``.
        low: bounds, ``(U,)``.
        high: bounds.
        near: what stands for the derivatives after a step that did what was expected of it, if
            they are dear; those of the minimum are then approximate too.
        warm: it knows derivatives from a search nearby, which this one starts with.
        tolerance: the expected fall of the cost (in nats, if it is minus a log-likelihood) at
            which the search ends; or after four steps that each gain less than ten times that.
        iterations: most evaluations of ``normal``.
    """
    x = np.clip(x, low, high)
    value, gradient, hessian = (cost(x), *near(x)) if near and warm else normal(x)
    damping, slow, carried, gain = 1e-3, 0, int(warm), 0.0
    iteration = 1
    while iteration < iterations:
        pinned = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))
        moved = over = False
        while damping < 1e10:
            step = _step(gradient, hessian, damping, pinned, low - x, high - x)
            trial = np.clip(x + step, low, high)
            expected = -float(gradient @ step + 0.5 * step @ hessian @ step)
            over = expected < tolerance and damping <= 1e-2
            if over:
                break
            reached = cost(trial)
            moved = reached < value
            if moved or carried:
                break
            damping *= 8.0
        if not moved:  # no smaller value to be found, to rounding, unless the slopes are wrong
            trusted = carried == 1 and _TRUSTED < gain < 1.0 / _TRUSTED
            # Where bounds cut a step short the slopes may expect a rise: they are wrong, then.
            if not carried or (over and trusted and expected > -tolerance):
                return Minimum(x, value, gradient, hessian, iteration, True)
            value, gradient, hessian = normal(x)
            iteration, carried = iteration + 1, 0
            continue
        gain = (value - reached) / max(expected, 1e-12)
        damping = max(damping * (0.1 if gain > 0.5 else 1.0 if gain > 0.1 else 3.0), 1e-9)
        slow = slow + 1 if value - reached < 10.0 * tolerance else 0
        x = trial
        if near is not None and gain > _GOOD and carried < _CARRIED and slow < _SLOW:
            value = reached
            gradient, hessian = near(x)
            carried += 1
            continue
        value, gradient, hessian = normal(x)
        iteration, carried = iteration + 1, 0
        if slow == _SLOW:
            return Minimum(x, value, gradient, hessian, iteration, True)
    return Minimum(x, value, gradient, hessian, iteration, False)


def _step(
    gradient: Floats, hessian: Floats, damping: float, pinned: np.ndarray, low: Floats, high: Floats
) -> Floats:
    """Damped Newton step; ``low`` and ``high`` are how far each unknown may go."""
    step, free = np.zeros_like(gradient), ~pinned
    floor = 1e-12 * max(float(np.diag(hessian).max(initial=0.0)), 1e-300)
    damped = hessian + np.diag(damping * np.maximum(np.diag(hessian), floor) + floor)
    for _ in range(_PASSES):
        index = np.flatnonzero(free)
        force = gradient[index] + damped[np.ix_(index, np.flatnonzero(~free))] @ step[~free]
        step[index] = -np.linalg.solve(damped[np.ix_(index, index)], force)
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = np.clip(step[beyond], low[beyond], high[beyond])
        free &= ~beyond
    return np.clip(step, low, high)
