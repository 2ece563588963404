"""Where the recorded pressure differs from the refitted simulator's, with calibrated p-values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import by_breath, significance
from ventbench.diagnosis.axes import Axis, axes
from ventbench.diagnosis.result import Place
from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]

#: Excess of the squared error that is worth a name, as a share of the noise's variance. Noise that
#: differs a little from place to place is no missing physics.
MATERIAL = 0.3

#: Part of the permitted chance that the test of the mean gets. The test of the square, whose
#: differences are skewed, errs less often than it may: it would waste half.
MEAN = 0.8

#: Below this p-value one place is as good as another, and the share orders them.
SURE = 0.01


@dataclass(frozen=True, eq=False)
class Profile:
    """Errors of k ranges of one axis; error is recorded minus simulated, cmH2O.

    Attributes:
        axis: with its ranges.
        mean: over breaths of each breath's mean error, ``(k,)``; NaN where there is none.
        half: half of the mean's 95 % interval, ``(k,)``.
        breaths: that have samples in the range, ``(k,)``.
    """

    axis: Axis
    mean: Floats
    half: Floats
    breaths: NDArray[np.int64]


def locate(
    breaths: Breaths,
    refit: Floats,
    noise_sd: float,
    flow: Floats | None = None,
    volume: Floats | None = None,
    *,
    level: float = 0.05,
    seed: int = 0,
) -> tuple[Place, ...]:
    """Find the ranges of phase, command, pressure and so on in which the simulator errs.

    Two tests a range, over breaths: whether the mean error is zero, and whether the squared error
    exceeds that outside the range, as errors do that change their sign from breath to breath. The
    p-values are corrected for all ranges of all axes and for both tests: if nothing is missing,
    the chance that any place is returned is ``level``.

    Args:
        breaths: n breaths of T samples.
        refit: pressures of the refitted simulator, cmH2O, ``(n, T)``.
        noise_sd: standard deviation of the measurement, cmH2O; NaN to take it from the errors.
        flow: of the refitted simulator, mL/s, ``(n, T)``, or None.
        volume: likewise, mL.
        level: largest p-value that is returned.
        seed: of the random flips.

    Returns:
        Places; first those with a p-value of at most :data:`SURE`, each kind by its share.
        Neighbouring ranges with errors of one sign are one place.
    """
    error, usable = errors(breaths, refit)
    around = axes(breaths, refit, flow, volume)
    if len(breaths) < significance.FEWEST or not around or not usable.any():
        return ()
    columns = [by_breath.columns(axis, error, usable) for axis in around]
    mean, excess, outside = (np.concatenate(part, axis=1) for part in zip(*columns, strict=True))
    variance = _variance(noise_sd, error, usable)
    by_mean = significance.p_values(mean, two_sided=True, seed=seed)
    by_square = significance.p_values(excess, two_sided=False, seed=seed + 1, weight=outside[0])
    with np.errstate(invalid="ignore"):
        size = by_breath.nanmean(excess)
        by_square = np.where(size > MATERIAL * variance, by_square, 1.0)
    p_value = np.minimum(1.0, np.minimum(by_mean / MEAN, by_square / (1.0 - MEAN)))
    sign = np.where(by_mean / MEAN <= level, np.sign(np.nan_to_num(by_breath.nanmean(mean))), 0.0)

    places: list[Place] = []
    squares = np.where(usable, error**2 - variance, 0.0)
    offset = 0
    for axis in around:
        mine = slice(offset, offset + len(axis))
        offset += len(axis)
        for first, last in _ranges(p_value[mine] <= level, sign[mine], axis.merge):
            if axis.merge and len(axis) > 1 and _everywhere(axis, usable, first, last):
                continue  # all of an axis is no place
            inside = usable & (axis.bins >= first) & (axis.bins <= last)
            share = squares[inside].sum() / max(float(squares.sum()), 1e-12)
            places.append(
                Place(
                    axis=axis.name,
                    low=float(axis.edges[first]) + (axis.name == "breath number"),
                    high=float(axis.edges[last + 1]),
                    unit=axis.unit,
                    mean_error=float(error[inside].mean()),
                    p_value=float(p_value[mine][first : last + 1].min()),
                    share=float(np.clip(share, 0.0, 1.0)),
                )
            )
    return tuple(sorted(places, key=lambda place: (place.p_value > SURE, -place.share)))


def profiles(
    breaths: Breaths,
    refit: Floats,
    flow: Floats | None = None,
    volume: Floats | None = None,
    *,
    judged: Floats | None = None,
) -> tuple[Profile, ...]:
    """Mean errors along all axes but the lungs, for pictures.

    Args:
        breaths: as in :func:`locate`.
        refit: likewise; it says which sample belongs to which range.
        flow: likewise.
        volume: likewise.
        judged: pressures of the simulator whose errors are wanted; those of ``refit`` if not given.
    """
    error, usable = errors(breaths, refit if judged is None else judged)
    found = []
    for axis in axes(breaths, refit, flow, volume):
        if not axis.merge:
            continue
        mean = by_breath.means(axis, error, usable)
        count = np.isfinite(mean).sum(axis=0)
        spread = np.sqrt(by_breath.nanmean((mean - by_breath.nanmean(mean)) ** 2))
        half = 1.96 * spread / np.sqrt(np.maximum(count - 1, 1))
        half = np.where(count > 1, half, np.nan)
        found.append(Profile(axis, by_breath.nanmean(mean), half, count))
    return tuple(found)


def errors(breaths: Breaths, simulated: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Recorded minus simulated pressure, cmH2O, zero where there is none; and where there is."""
    difference = breaths.pressure - np.asarray(simulated, float)
    usable = breaths.valid & np.isfinite(difference)
    return np.where(usable, difference, 0.0), usable


def _variance(noise_sd: float, error: Floats, usable: NDArray[np.bool_]) -> float:
    """Of the noise; if not told, the median of the samples' mean squares over breaths."""
    if np.isfinite(noise_sd) and noise_sd > 0:
        return float(noise_sd) ** 2
    count = usable.sum(axis=0)
    return float(np.median((error**2).sum(axis=0)[count > 0] / count[count > 0]))


def _ranges(found: NDArray[np.bool_], sign: Floats, merge: bool) -> list[tuple[int, int]]:
    """First and last index of runs of neighbours with one sign."""
    runs: list[tuple[int, int]] = []
    for k in np.flatnonzero(found).tolist():
        if merge and runs and runs[-1][1] == k - 1 and sign[k] == sign[k - 1]:
            runs[-1] = (runs[-1][0], k)
        else:
            runs.append((k, k))
    return runs


def _everywhere(axis: Axis, usable: NDArray[np.bool_], first: int, last: int) -> bool:
    used = axis.bins[usable & (axis.bins >= 0)]
    return bool(used.size) and first <= used.min() and last >= used.max()
