"""Dead times of held commands: substeps of a sample, and delayed commands in each of them."""

from __future__ import annotations

import math
from functools import partial, reduce
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.arrays import Floats
from ventbench.physics.mechanism import apply_if_active

#: Substeps of a sample of about 30 ms, and past samples that a dead time may reach back over.
SUBSTEPS, MEMORY = 5, 6

#: Longest dead time, and longest substep, s.
LONGEST_DEAD_TIME, LONGEST_SUBSTEP = 0.15, 0.007

#: Quantile of uneven sampling intervals that decides on their substeps.
_LONG = 0.9

#: Length of the substep before a sample, s.
LAST_SUBSTEP = 0.001

#: Least distance of edges that get a cut each, as a share of a sample: 3 us change no sample, but
#: gas with mass loses digits in steps that are much shorter.
_APART = 1e-4


def resolution(dt: float) -> tuple[int, int]:
    """Numbers of substeps and of past samples that samples of ``dt`` seconds need."""
    return max(4, round(dt / LONGEST_SUBSTEP + 0.4)), math.ceil(LONGEST_DEAD_TIME / dt) + 1


def resolution_of(dt: Floats) -> tuple[int, int]:
    """Numbers of substeps and of past samples that unevenly spaced samples need.

    Args:
        dt: intervals between samples, s, ``(n, T)``.
    """
    substeps, memory = resolution(float(np.quantile(dt, _LONG)))
    substeps = max(substeps, resolution(float(np.median(dt)))[0])
    # Where samples lie close together, more of them are needed to reach back as far. A median says
    # nothing of that: of a grid with two samples at each reading, it would ask for hundreds.
    passed = np.cumsum(dt, axis=1)
    for row in passed:
        reaches = np.searchsorted(row, row + LONGEST_DEAD_TIME)
        complete = reaches < len(row)
        if complete.any():
            memory = max(memory, int((reaches - np.arange(len(row)))[complete].max()) + 1)
    return substeps, memory


def windows(
    dt: Array,
    past: tuple[Array, ...],
    dead_times: tuple[Array | float, ...],
    held: tuple[tuple[Array, ...], ...],
    count: int,
    skip_idle: bool = False,
) -> tuple[Array, ...]:
    """Cut a sample into substeps, and average delayed commands over each of them.

    Samples, substeps and cuts are arrays of their own, or the first axis: an operation on a whole
    batch becomes vector code, one along a last axis of six does not.

    Args:
        dt: length of the sample, s, ``(...)``.
        past: durations of the P samples before, the latest first, s, ``(...)`` each.
        dead_times: dead times, s, the most important first; numbers where no mechanism has one.
        held: the P + 2 last commands that each of them delays, the latest first, ``(...)`` each.
        count: number of substeps, at least 3.
        skip_idle: skip the computation of dead times that are zero in all elements.

    Returns:
        Lengths, s, and the mean of each command, ``(count, ...)`` each.
    """
    dt = dt + 0.0 * held[0][0]
    delays = [delay for delay in dead_times if isinstance(delay, jax.Array)]
    cut = substep_lengths(dt, past, (), count)
    if delays:
        active = _any_active(delays) if skip_idle else None
        cut = apply_if_active(
            active, lambda _: substep_lengths(dt, past, tuple(delays), count), cut
        )
    means = []
    for delay, values in zip(dead_times, held, strict=True):
        mean = tuple(values[0] + 0.0 * length for length in cut)
        if isinstance(delay, jax.Array):
            delayed = partial(_mean, delay=delay, lengths=cut, past=past, values=values)
            mean = apply_if_active(_any_active([delay]) if skip_idle else None, delayed, mean)
        means.append(mean)
    return tuple(jnp.stack(rows) for rows in (cut, *means))


def substep_lengths(
    dt: Array, past: tuple[Array, ...], dead_times: tuple[Array, ...], count: int
) -> tuple[Array, ...]:
    """Cut a sample into substeps, of which it returns the lengths, s; arguments as of `windows`.

    A valve that opens within a substep is not the same as one that is half open throughout, so that
    a cut is moved to where a delayed edge arrives. The last substep is short: if an edge arrives
    within it, what it does to the sample is smoothed over that time, for the sake of derivatives.
    """
    short = jnp.minimum(LAST_SUBSTEP, dt / count)
    room, zero = dt - short, jnp.zeros_like(dt)
    cuts = [room * (k / (count - 1)) for k in range(1, count - 1)]
    free = [jnp.ones_like(dt, bool) for _ in cuts]
    least_apart, edges = _APART * dt, [zero, room]  # both are ends of substeps in any case
    for delay in dead_times[: count - 2]:
        edge, pending = zero, jnp.zeros_like(dt, bool)
        for begin in _begins(past):
            arrives = delay + begin + zero
            inside = (arrives > 0.0) & (arrives < room) & ~pending
            edge, pending = jnp.where(inside, arrives, edge), pending | inside
        for occupied in edges:
            pending = pending & (jnp.abs(edge - occupied) > least_apart)
        edges.append(edge)
        distances = [
            jnp.where(is_free, jnp.abs(cut - edge), jnp.inf)
            for cut, is_free in zip(cuts, free, strict=True)
        ]
        # With a tolerance: compilers may round a difference in two ways, and no cut would match.
        least = reduce(jnp.minimum, distances) + 1e-9 * dt
        for k, distance in enumerate(distances):
            nearest = pending & (distance <= least)
            cuts[k], free[k] = jnp.where(nearest, edge, cuts[k]), free[k] & ~nearest
            pending = pending & ~nearest
    ends = [zero, *_sorted(cuts), room, dt]
    # Two cuts may coincide; nothing may be divided by zero.
    return tuple(jnp.maximum(end - begin, 1e-6 * dt) for begin, end in pairwise(ends))


def window_weights(start: Array, length: Array, past: tuple[Array, ...]) -> list[Array]:
    """Shares of a window in this sample, in each of P samples before, and in all earlier ones.

    They are P + 2 weights that add up to one. The window begins so many s after this sample does
    (negative reaches back), and has a positive length, s; ``past`` as of :func:`windows`.
    """
    last = start + length
    edges = [jnp.inf, *_begins(past), -jnp.inf]
    return [
        jnp.maximum(jnp.minimum(last, upper) - jnp.maximum(start, lower), 0.0) / length
        for upper, lower in pairwise(edges)
    ]


def _mean(
    _: object,
    delay: Array,
    lengths: tuple[Array, ...],
    past: tuple[Array, ...],
    values: tuple[Array, ...],
) -> tuple[Array, ...]:
    """Mean over each substep of what was commanded ``delay`` seconds before, ``(...)`` each."""
    means, start = [], 0.0 - delay
    for length in lengths:
        weights = window_weights(start, length, past)
        means.append(sum(map(jnp.multiply, weights, values), start=jnp.zeros_like(length)))
        start = start + length
    return tuple(means)


def _begins(past: tuple[Array, ...]) -> list[Array | float]:
    """Starts of this sample and of those before, s after the start of this one, ``(...)`` each."""
    begins: list[Array | float] = [0.0]
    for before in past:
        begins.append(begins[-1] - before)
    return begins


def _any_active(delays: list[Array]) -> Array:
    """Whether any dead time is not zero in any element, ``()``."""
    return jnp.any(jnp.stack([jnp.any(delay != 0.0) for delay in delays]))


def _sorted(rows: list[Array]) -> list[Array]:
    """A few arrays, sorted element by element, by exchanges of neighbours."""
    rows = list(rows)
    for end in range(len(rows) - 1, 0, -1):
        for k in range(end):
            pair = rows[k], rows[k + 1]
            rows[k], rows[k + 1] = jnp.minimum(*pair), jnp.maximum(*pair)
    return rows
