"""The mildest point at which something goes wrong: critical severity along rays and combinations.

Coordinates say how far physics is off, each in a unit of its own; the severity of a point is its
Mahalanobis distance from the origin, and 1 is the end of the range. :func:`mildest` first goes
outwards along each coordinate alone, then along combinations: it changes the direction at random,
asks at the present critical severity and a little below it, and keeps the direction that is worst.
What it finds is an upper bound on the least severity; that it finds nothing is no proof. The same
margins give the same answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Severities at which each coordinate is tried alone, and the part of the interval between a safe
#: and an unsafe one to which the critical severity is found.
LEVELS, FINENESS = (0.5, 1.0), 32

#: Rounds of the search over directions, directions of each, and the factor below the present
#: severity at which they are asked as well.
ROUNDS, DIRECTIONS, BELOW = 20, 12, 0.85

#: Share of the coordinates that change in a direction, and the first and last standard deviation of
#: the change over the largest coordinate.
CHANGED, WIDTHS = 0.3, (0.6, 0.1)

#: A coordinate smaller than this share of the largest is left out of a direction.
NEGLIGIBLE = 0.1

#: Most that a margin counts where the steepest ascent is worked out.
MOST = 100.0

#: Points of each lung that are worth asking for together.
BATCH = 24

#: By how much points ``(S, L, A)`` at settings ``(S, L)`` are beyond a limit, any unit: above 0 it
#: goes wrong, infinite where there is no degree. Shape ``(S, L)``.
Margin = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, eq=False)
class Space:
    """Coordinates of the search, A of them, for L lungs.

    Attributes:
        metric: a point ``x`` has the severity ``sqrt(x' metric x)``, shape ``(L, A, A)``.
        group: of each coordinate; at most one of a group is not zero in a point, length A.
        signed: whether a coordinate may be negative, length A.
    """

    metric: Floats
    group: NDArray[np.int64]
    signed: NDArray[np.bool_]

    def directions(self, points: Floats) -> Floats:
        """Points of severity 1 in given directions, with the rules kept, shape ``(..., L, A)``."""
        points = np.where(self.signed, points, np.maximum(points, 0.0))
        size = np.abs(points)
        for own in np.unique(self.group):
            at = np.flatnonzero(self.group == own)
            size[..., at] *= size[..., at] >= size[..., at].max(axis=-1, keepdims=True)
        points = np.where(size > NEGLIGIBLE * size.max(axis=-1, keepdims=True), points, 0.0)
        square = np.einsum("...la,lab,...lb->...l", points, self.metric, points)
        return points / np.sqrt(np.maximum(square, 1e-30))[..., None]

    @property
    def alone(self) -> Floats:
        """Directions of one coordinate each, shape ``(J, L, A)``."""
        every = np.eye(len(self.group))
        every = np.concatenate([every, -every[self.signed]])
        return self.directions(np.repeat(every[:, None], len(self.metric), axis=1))


@dataclass(frozen=True, eq=False)
class Found:
    """Result of :func:`mildest` for L lungs.

    Attributes:
        severity: shape ``(L,)``; NaN where nothing went wrong.
        point: the coordinates, shape ``(L, A)``; where nothing went wrong the worst of severity 1.
        setting: of these points, shape ``(L,)``.
        margin: of these points, shape ``(L,)``; see :data:`Margin`.
        alone: severity of each of :attr:`Space.alone` at the worst setting, shape ``(J, L)``; NaN
            where nothing went wrong.
    """

    severity: Floats
    point: Floats
    setting: Floats
    margin: Floats
    alone: Floats


def mildest(margin: Margin, space: Space, settings: Sequence[float]) -> Found:
    """Search for the mildest point of each lung at which something goes wrong; see the module.

    Args:
        margin: of points.
        space: the coordinates.
        settings: at which each point may be tried, such as PIPs.
    """
    alone = space.alone
    count, lungs, size = alone.shape
    every, given = np.arange(lungs), np.asarray(settings, float)
    origin = np.zeros((len(given), lungs, size))
    begun = _together(margin, origin, given[:, None]).repeat(count, axis=0)
    # A ray is a direction at a setting; those of one setting follow each other.
    rays = np.tile(alone, (len(given), 1, 1))
    at = np.broadcast_to(given.repeat(count)[:, None], begun.shape)
    values = _together(margin, np.multiply.outer(LEVELS, rays), at)
    high = np.full(at.shape, np.nan)
    for level, own in zip((*LEVELS[::-1], 0.0), (*values[::-1], begun), strict=True):
        high = np.where(own > 0, level, high)
    low = np.where(high > LEVELS[0], LEVELS[0], 0.0)
    some = np.isfinite(high).any(axis=1)
    if some.any():
        high[some] = _first(margin, rays[some], at[some], low[some], high[some])

    # The mildest ray of each lung, or the one that is worst at the end of the range.
    best = np.where(np.isfinite(high), high, 2.0 - 1e-6 * values[-1]).argmin(axis=0)
    direction, radius, setting = rays[best, every], high[best, every], at[best, every]
    # Were margins linear, the steepest ascent would be the answer.
    first, last = (np.minimum(x, MOST) for x in (begun, values[-1]))
    rise = np.maximum(last - first, 0.0)
    same = best // count * count + np.arange(count)[:, None]
    steepest = np.einsum("jla,jl->la", alone, rise[same, every])
    numbers = np.random.default_rng(0)
    for width in np.geomspace(*WIDTHS, ROUNDS):
        # The same changes for all lungs: none depends on which others are searched.
        step = width * numbers.normal(size=(DIRECTIONS, 1, size))
        step = step * (numbers.random(step.shape) < CHANGED)
        fresh = direction + step * np.abs(direction).max(axis=-1, keepdims=True)
        fresh[0], fresh[1] = direction, steepest
        fresh = space.directions(fresh)
        end = np.where(np.isnan(radius), 1.0, radius)
        asked = np.stack([BELOW * end, end])[:, None, :, None] * fresh
        values = _together(margin, asked, setting)
        below = (values[0] > 0).any(axis=0)
        ahead = np.where(below, values[0], values[1])
        direction = fresh[ahead.argmax(axis=0), every]
        radius = np.where(below, BELOW * end, np.where(ahead.max(axis=0) > 0, end, radius))
    severity = _first(margin, direction[None], setting[None], 0.0 * radius[None], radius[None])[0]
    point = np.where(np.isnan(severity), 1.0, severity)[:, None] * direction
    reached = _together(margin, point, setting)
    lowest = np.fmin.reduce(high.reshape(len(given), count, lungs))
    return Found(severity, point, setting, reached, lowest)


def _together(margin: Margin, points: Floats, at: Floats) -> Floats:
    """Margins of points ``(..., L, A)`` at settings, in one call, shape ``(..., L)``."""
    shape = points.shape[:-1]
    flat = np.broadcast_to(at, shape).reshape(-1, shape[-1])
    return margin(points.reshape(-1, *points.shape[-2:]), flat).reshape(shape)


def _first(margin: Margin, rays: Floats, at: Floats, low: Floats, high: Floats) -> Floats:
    """Least severity at which S rays ``(S, L, A)`` go wrong, between two, ``(S, L)``.

    Where there are few rays, intervals are cut in more than two.
    """
    cuts = max(1, BATCH // len(rays))
    for _ in range(math.ceil(math.log(FINENESS) / math.log(cuts + 1))):
        edges = np.linspace(low, high, cuts + 2)
        points = np.nan_to_num(edges[1:-1])[..., None] * rays
        wrong = _together(margin, points, at) > 0
        first = np.where(wrong.any(axis=0), wrong.argmax(axis=0), cuts)[None]
        low, high = (np.take_along_axis(edges, first + k, axis=0)[0] for k in (0, 1))
    return high
