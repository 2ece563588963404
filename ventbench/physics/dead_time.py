"""Dead times of held commands: substeps of a sample, and delayed commands in each of them."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.physics.mechanism import apply_if_active

#: Substeps of a sample of about 30 ms, and past samples that a dead time may reach back over.
SUBSTEPS, MEMORY = 5, 6

#: Longest dead time, and longest substep, s.
LONGEST_DEAD_TIME, LONGEST_SUBSTEP = 0.15, 0.007

#: Quantile of uneven sampling intervals that decides on their substeps.
_LONG = 0.9

#: Length of the substep before a sample, s.
LAST_SUBSTEP = 0.001


def resolution(dt: float) -> tuple[int, int]:
    """Numbers of substeps and of past samples that samples of ``dt`` seconds need."""
    return max(4, round(dt / LONGEST_SUBSTEP + 0.4)), math.ceil(LONGEST_DEAD_TIME / dt) + 1


def resolution_of(dt: NDArray[np.float64]) -> tuple[int, int]:
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
        whole = reaches < len(row)
        if whole.any():
            memory = max(memory, int((reaches - np.arange(len(row)))[whole].max()) + 1)
    return substeps, memory


def windows(
    dt: Array, past: Array, dead_times: tuple[Array | float, ...], held: tuple[Array, ...],
    count: int, skip_idle: bool = False,
) -> tuple[Array, ...]:  # fmt: skip
    """Cut a sample into substeps, and average delayed commands over each of them.

    Args:
        dt: length of the sample, s, ``(...)``.
        past: durations of the samples before, the latest first, s, ``(..., P)``.
        dead_times: dead times, s, the most important first; numbers where no mechanism has one.
        held: the command that each of them delays, the latest first, ``(..., P + 1)``.
        count: number of substeps, at least 3.
        skip_idle: skip the computation of dead times that are zero in all elements.

    Returns:
        Lengths, s, and the mean of each command, ``(..., count)`` each.
    """
    dt = dt + 0.0 * held[0][..., 0]
    delays = [delay for delay in dead_times if isinstance(delay, jax.Array)]
    cut = substep_lengths(dt, past, (), count)
    if delays:
        active = _any_active(delays) if skip_idle else None
        cut = apply_if_active(
            active, lambda _: substep_lengths(dt, past, tuple(delays), count), cut
        )
    means = []
    for delay, values in zip(dead_times, held, strict=True):
        mean = values[..., :1] + 0.0 * cut
        if isinstance(delay, jax.Array):
            delayed = partial(_mean, delay=delay, lengths=cut, past=past, values=values)
            mean = apply_if_active(_any_active([delay]) if skip_idle else None, delayed, mean)
        means.append(mean)
    return cut, *means


def substep_lengths(dt: Array, past: Array, dead_times: tuple[Array, ...], count: int) -> Array:
    """Cut a sample into substeps.

    A valve that opens within a substep is not the same as one that is half open throughout, so that
    a cut is moved to where a delayed edge arrives. The last substep is short: if an edge arrives
    within it, what it does to the sample is smoothed over that time, for the sake of derivatives.

    Args:
        dt: length of the sample, s, ``(...)``.
        past: durations of the samples before, the latest first, s, ``(..., P)``.
        dead_times: dead times, s, the most important first.
        count: number of substeps, at least 3.

    Returns:
        Lengths, s, ``(..., count)``.
    """
    short = jnp.minimum(LAST_SUBSTEP, dt / count)
    room = (dt - short)[..., None]
    cuts = room * (jnp.arange(1, count - 1) / (count - 1)).astype(dt.dtype)
    free = jnp.ones_like(cuts)
    for delay in dead_times[: count - 2]:
        behind = jnp.concatenate([jnp.zeros_like(room), _sums(past)], axis=-1)
        arrives = (delay + 0.0 * dt)[..., None] - behind
        inside = (arrives > 0.0) & (arrives < room)
        edge = jnp.sum(jnp.where(inside, arrives, 0.0) * _first(inside), axis=-1, keepdims=True)
        away = jnp.where(free > 0, jnp.abs(cuts - edge), jnp.inf)
        # With a tolerance: compilers may round a difference in two ways, and no cut would match.
        nearest = _first(away <= jnp.min(away, axis=-1, keepdims=True) + 1e-9 * dt[..., None])
        nearest = nearest * jnp.any(inside, axis=-1, keepdims=True)
        cuts = jnp.where(nearest > 0, edge, cuts)
        free = free * (1.0 - nearest)
    ends = jnp.concatenate([jnp.zeros_like(room), _sorted(cuts), room, dt[..., None]], -1)
    # Two cuts may coincide; nothing may be divided by zero.
    return jnp.maximum(jnp.diff(ends, axis=-1), 1e-6 * dt[..., None])


def window_weights(start: Array, length: Array, past: Array) -> Array:
    """Shares of a window in this sample, in each of P samples before, and in all earlier ones.

    Args:
        start: start of the window, s after the start of this sample; negative reaches back;
            ``(...)``.
        length: length of the window, s, positive, ``(...)``.
        past: durations of the P samples before, the latest first, s, ``(..., P)``.

    Returns:
        Weights that add up to one, in that order, ``(..., P + 2)``.
    """
    begins = -jnp.cumsum(past, axis=-1)
    infinite = jnp.full_like(begins[..., :1], jnp.inf)
    zero = jnp.zeros_like(infinite)
    upper = jnp.concatenate([infinite, zero, begins], axis=-1)
    lower = jnp.concatenate([zero, begins, -infinite], axis=-1)
    first, last = start[..., None], (start + length)[..., None]
    inside = jnp.minimum(last, upper) - jnp.maximum(first, lower)
    return jnp.maximum(inside, 0.0) / length[..., None]


def _mean(_: Array, delay: Array, lengths: Array, past: Array, values: Array) -> Array:
    """Mean over each substep of what was commanded ``delay`` seconds before, ``(..., K)``."""
    starts = _sums(lengths) - lengths - (delay + 0.0 * lengths[..., 0])[..., None]
    weights = window_weights(starts, lengths, past[..., None, :])
    return jnp.sum(weights * values[..., None, :], axis=-1)


def _any_active(delays: list[Array]) -> Array:
    """Whether any dead time is not zero in any element, ``()``."""
    return jnp.any(jnp.stack([jnp.any(delay != 0.0) for delay in delays]))


def _first(mask: Array) -> Array:
    """One at the first True along the last axis, zero elsewhere."""
    return (mask & (_sums(mask.astype(float)) == 1.0)).astype(float)


def _sums(values: Array) -> Array:
    """Running sums along a short last axis."""
    total, sums = jnp.zeros_like(values[..., 0]), []
    for k in range(values.shape[-1]):
        total = total + values[..., k]
        sums.append(total)
    return jnp.stack(sums, axis=-1)


def _sorted(values: Array) -> Array:
    """Sorted along a short last axis, by exchanges of neighbours."""
    rows = [values[..., k] for k in range(values.shape[-1])]
    for end in range(len(rows) - 1, 0, -1):
        for k in range(end):
            rows[k], rows[k + 1] = (
                jnp.minimum(rows[k], rows[k + 1]),
                jnp.maximum(rows[k], rows[k + 1]),
            )
    return jnp.stack(rows, axis=-1)
