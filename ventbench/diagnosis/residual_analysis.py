"""Open-loop errors of a simulator: how large they are, and where they lie, with p-values.

Breaths are the independent unit of the tests, since the samples of one breath share its noise.
Under the null hypothesis the errors of a breath are as likely with the opposite sign, in all ranges
together; so the largest statistic over all ranges under random sign flips tells how large chance
makes it (Westfall and Young, Resampling-Based Multiple Testing, 1993).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.diagnosis.findings import ErrorRegion, OpenLoopComparison, OpenLoopError
from ventbench.diagnosis.residual_axes import EDGE_SIZE, Axis, axes
from ventbench.diagnosis.settings import DEFAULT, CorrectionSettings, ResidualSettings
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Fit

#: Length of what is reported as the beginning of inspiration, s.
_BEGINNING = 0.2

#: Share of the breaths, those that err most, without which it is asked whether more than noise is
#: left: a wrong first reading puts a whole breath off, since every simulation starts there.
_SET_ASIDE = 0.1

#: Time after the start of expiration from which little moves, s; fewest quiet samples of a breath
#: that show the sensor's scatter; times that scatter that the noise may have (it is coloured, and a
#: converter rounds a quiet signal more than a moving one); least scatter, cmH2O.
_QUIET_AFTER, _QUIET_SAMPLES, _QUIET_FACTOR, _LEAST_NOISE = 0.6, 10, 3.0, 0.05

#: Share of the chance of any range that the test of the mean gets; the test of the square, whose
#: differences are skewed, errs less often than it may.
_MEAN_SHARE = 0.8

#: Excess of the squared error that is reported, as a share of the noise's variance: noise that
#: differs a little from range to range is no missing physics.
MIN_EXCESS = 0.3


@dataclass(frozen=True, eq=False)
class Profile:
    """Errors in the k ranges of one axis; the error is recorded minus simulated, cmH2O."""

    axis: Axis  #: axis with its ranges.
    mean: Floats  #: mean over breaths of each breath's mean error, ``(k,)``; NaN in an empty range.
    half: Floats  #: half of the 95 % interval of the mean, ``(k,)``.
    breaths: Ints  #: number of breaths with samples in the range, ``(k,)``.


def open_loop_error(recorded: Floats, simulated: Floats, mask: Bools) -> OpenLoopError:
    """Error over the samples of a mask, all ``(n, T)``; NaN if there is none."""
    error = (simulated - recorded)[mask & np.isfinite(recorded) & np.isfinite(simulated)]
    if error.size == 0:
        return OpenLoopError(float("nan"), float("nan"))
    return OpenLoopError(float(np.mean(np.abs(error))), float(np.sqrt(np.mean(error**2))))


def compare_open_loop(
    breaths: Breaths,
    held_out: Bools,
    pressures: dict[str, Floats],
    noise_floor: float,
    scatter_error: Floats | None = None,
    sensor: float = float("nan"),
) -> OpenLoopComparison:
    """Open-loop errors of a simulator before and after its correction.

    Args:
        breaths: n recorded breaths of T samples.
        held_out: breaths that no fit has seen, ``(n,)``.
        pressures: pressures of the simulator ``before``, ``refit`` and ``after``, cmH2O, ``(n,
            T)``.
        noise_floor: standard deviation of the noise, cmH2O.
        scatter_error: standard deviation of the pressure because gains or efforts differ from
            breath to breath, cmH2O, ``(n, T)``; None if nothing does.
        sensor: that of :func:`sensor_noise`.
    """
    # The first sample is where every simulation starts.
    inspiration = breaths.inspiratory & (breaths.time > 0) & held_out[:, None]

    def by_stage(mask: Bools) -> dict[str, OpenLoopError]:
        return {
            stage: open_loop_error(breaths.pressure, simulated, mask)
            for stage, simulated in pressures.items()
        }

    whole = by_stage(inspiration)
    parts = {
        f"first {_BEGINNING:g} s of inspiration": inspiration & (breaths.time <= _BEGINNING),
        "rest of inspiration": inspiration & (breaths.time > _BEGINNING),
        "expiration": (breaths.u_out == 1) & breaths.valid & held_out[:, None],
    }
    lungs = breaths.by_lung_index
    if len(lungs) > 1:
        for name, index in lungs.items():
            of_lung = np.zeros(len(breaths), bool)
            of_lung[index] = True
            parts[f"lung {name}"] = inspiration & of_lung[:, None]
    ids = tuple(int(i) for i in breaths.breath_id[held_out])
    groups = {name: by_stage(mask) for name, mask in parts.items() if mask.any()}
    scatter = 0.0
    if scatter_error is not None:
        scatter = float(np.sqrt(np.mean(scatter_error[inspiration] ** 2)))
    error = np.where(inspiration, breaths.pressure - pressures["after"], np.nan)[held_out]
    usual = _usual_error(error)
    return OpenLoopComparison(
        ids, whole["before"], whole["refit"], whole["after"], noise_floor, groups, scatter, usual,
        sensor,
    )  # fmt: skip


def _usual_error(error: Floats) -> float:
    """Root mean square of errors ``(n, T)`` without the breaths that err most."""
    squares, counts = np.nansum(error**2, axis=1), np.isfinite(error).sum(axis=1)
    order = np.argsort(squares / np.maximum(counts, 1))
    kept = order[: len(order) - math.ceil(_SET_ASIDE * len(order))] if len(order) > 2 else order
    total = counts[kept].sum()
    return float(np.sqrt(squares[kept].sum() / total)) if total else float("nan")


def is_unexplained(
    errors: OpenLoopComparison, settings: CorrectionSettings = DEFAULT.correction
) -> bool:
    """Whether the corrected simulator errs far more than the measurement and gains scatter."""
    return bool(
        min(errors.after.rmse, errors.usual) > settings.unexplained_ratio * errors.least_error
        and errors.unexplained > settings.unexplained_error
    )


def sensor_noise(breaths: Breaths) -> float:
    """Standard deviation of the sensor, cmH2O, by quiet readings alone; NaN if nothing is quiet.

    Late in an expiration hardly anything moves, so that the scatter about a parabola shows the
    sensor. A converter hides the scatter of a quiet signal; its step's own scatter is a floor.
    """
    late = (breaths.u_out == 1) & breaths.valid & np.isfinite(breaths.pressure)
    scatter = []
    for time, pressure, u_in, use in zip(
        breaths.time, breaths.pressure, breaths.u_in, late, strict=True
    ):
        if use.sum() < _QUIET_SAMPLES:
            continue
        use = use & (time > time[use][0] + _QUIET_AFTER)
        use &= np.abs(u_in - np.median(u_in[use]) if use.any() else u_in) < EDGE_SIZE
        if use.sum() >= _QUIET_SAMPLES:
            left = pressure[use] - np.polyval(np.polyfit(time[use], pressure[use], 2), time[use])
            scatter.append(1.4826 * np.median(np.abs(left)))
    if not scatter:
        return float("nan")
    step = np.diff(np.unique(breaths.pressure[late])).min(initial=np.inf) / np.sqrt(12.0)
    return max(float(np.median(scatter)), float(step), _LEAST_NOISE)


def noise_floor(noise_sd: float, sensor: float) -> float:
    """Standard deviation of the measurement, cmH2O, which no simulator can beat.

    The noise of a model that fits badly contains the model's own slow errors; the floor is never
    more than a few times the scatter of the sensor.

    Args:
        noise_sd: standard deviation of the noise that the identified model leaves, cmH2O.
        sensor: that of :func:`sensor_noise`; NaN if unknown.
    """
    return float(np.fmin(noise_sd, _QUIET_FACTOR * sensor))


def flow_and_volume(breaths: Breaths, fit: Fit, pressure: Floats) -> tuple[Floats, Floats]:
    """Flow into the lung, mL/s, and volume above that of the first sample, mL, both ``(n, T)``.

    The flow is that of the inspiratory valve of the base model, minus what leaves through the
    expiratory valve at the simulated pressure. Each sample has what flowed just before it.

    Args:
        breaths: n breaths.
        fit: gives the gain of the valve, expiratory resistance and PEEP.
        pressure: simulated, cmH2O, ``(n, T)``.
    """
    gain, out, peep = (float(np.median(fit.column(name))) for name in ("gain", "R_ex", "PEEP"))
    flow = np.zeros_like(pressure)
    vented = np.maximum(pressure[:, 1:] - peep, 0.0) / out * 1e3
    flow[:, 1:] = gain * breaths.u_in[:, :-1] - np.where(breaths.u_out[:, :-1] == 1, vented, 0.0)
    volume = np.zeros_like(flow)
    volume[:, 1:] = np.cumsum(np.nan_to_num(flow[:, 1:]) * breaths.dt[:, :-1], axis=1)
    return flow, volume


def locate(
    breaths: Breaths,
    refit: Floats,
    noise_sd: float,
    flow: Floats | None = None,
    volume: Floats | None = None,
    *,
    settings: ResidualSettings = DEFAULT.residuals,
    least: float = 0.0,
    seed: int = 0,
) -> tuple[ErrorRegion, ...]:
    """Find the ranges of phase, command, pressure and other quantities in which a simulator errs.

    There are two tests for each range, over breaths: whether the mean error is zero, and whether
    the squared error exceeds that outside the range, which catches errors whose sign changes from
    breath to breath. The p-values are corrected for all ranges of all axes and for both tests: if
    nothing is missing, the probability that any region is returned is ``settings.level``.

    Args:
        breaths: n breaths of T samples.
        refit: pressure of the refitted simulator, cmH2O, ``(n, T)``.
        noise_sd: standard deviation of the measurement, cmH2O; NaN to take it from the errors.
        flow: flow of the refitted simulator, mL/s, ``(n, T)``, or None.
        volume: volume of the refitted simulator, mL, ``(n, T)``, or None.
        settings: ranges and levels.
        least: root-mean-square error, cmH2O, that a mean error must add to the noise.
        seed: seed of the random sign flips.

    Returns:
        Regions; first those with a p-value of at most ``settings.certain``, each group by its share
        of the error. Neighbouring ranges with errors of one sign are merged.
    """
    error, usable = errors(breaths, refit)
    all_axes = axes(breaths, refit, flow, volume)
    if len(breaths) < settings.min_breaths or not all_axes or not usable.any():
        return ()
    columns = [_test_columns(axis, error, usable) for axis in all_axes]
    mean, excess, outside = (np.concatenate(part, axis=1) for part in zip(*columns, strict=True))
    variance = _noise_variance(noise_sd, error, usable)
    by_mean = p_values(mean, two_sided=True, seed=seed, settings=settings)
    by_square = p_values(
        excess, two_sided=False, seed=seed + 1, weight=outside[0], settings=settings
    )
    with np.errstate(invalid="ignore"):
        is_material = _nanmean(excess) > MIN_EXCESS * variance
        by_square = np.where(is_material, by_square, 1.0)
        adds = np.hypot(np.sqrt(variance), _nanmean(mean)) - np.sqrt(variance)
        by_mean = np.where(adds >= least, by_mean, 1.0)
    by_mean = by_mean / _MEAN_SHARE
    p_value = np.minimum(1.0, np.minimum(by_mean, by_square / (1.0 - _MEAN_SHARE)))
    sign = np.where(by_mean <= settings.level, np.sign(np.nan_to_num(_nanmean(mean))), 0.0)

    regions: list[ErrorRegion] = []
    squares = np.where(usable, error**2 - variance, 0.0)
    offset = 0
    for axis in all_axes:
        own = slice(offset, offset + len(axis))
        offset += len(axis)
        for first, last in _runs(p_value[own] <= settings.level, sign[own], axis.merge):
            if axis.merge and len(axis) > 1 and _is_whole_axis(axis, usable, first, last):
                continue  # the whole of an axis is no place
            inside = usable & (axis.bins >= first) & (axis.bins <= last)
            share = squares[inside].sum() / max(float(squares.sum()), 1e-12)
            regions.append(
                ErrorRegion(
                    axis=axis.name,
                    low=float(axis.edges[first]) + (axis.name == "breath number"),
                    high=float(axis.edges[last + 1]),
                    unit=axis.unit,
                    mean_error=_mean_over_breaths(error, inside),
                    p_value=float(p_value[own][first : last + 1].min()),
                    share=float(np.clip(share, 0.0, 1.0)),
                )
            )
    return tuple(
        sorted(regions, key=lambda region: (region.p_value > settings.certain, -region.share))
    )


def profiles(
    breaths: Breaths,
    refit: Floats,
    flow: Floats | None = None,
    volume: Floats | None = None,
    *,
    simulated: Floats | None = None,
) -> tuple[Profile, ...]:
    """Mean errors along all axes but the lungs, for charts.

    Args:
        breaths: n breaths of T samples.
        refit: pressure that assigns samples to ranges, cmH2O, ``(n, T)``.
        flow: see :func:`locate`.
        volume: see :func:`locate`.
        simulated: pressure whose errors are wanted, cmH2O, ``(n, T)``; ``refit`` if not given.
    """
    error, usable = errors(breaths, refit if simulated is None else simulated)
    result = []
    for axis in axes(breaths, refit, flow, volume):
        if not axis.merge:
            continue
        mean = _breath_means(axis, error, usable)
        count = np.isfinite(mean).sum(axis=0)
        spread = np.sqrt(_nanmean((mean - _nanmean(mean)) ** 2))
        half = 1.96 * spread / np.sqrt(np.maximum(count - 1, 1))
        half = np.where(count > 1, half, np.nan)
        result.append(Profile(axis, _nanmean(mean), half, count))
    return tuple(result)


def errors(breaths: Breaths, simulated: Floats) -> tuple[Floats, Bools]:
    """Recorded minus simulated pressure, cmH2O, zero where unknown; and where it is known."""
    difference = breaths.pressure - np.asarray(simulated, float)
    usable = breaths.valid & np.isfinite(difference)
    return np.where(usable, difference, 0.0), usable


def statistic(
    values: Floats,
    weight: Floats | None = None,
    min_breaths: int = DEFAULT.residuals.min_breaths,
) -> Floats:
    """Sum over breaths divided by the root of the sum of squares: t without its heavy tails.

    It rises with Student's t, ``t = z sqrt((n - 1) / (n - z^2))``, but never exceeds ``sqrt(n)``:
    a range that few breaths have cannot outdo all others by chance.

    Args:
        values: values of each breath and range, NaN where there is none, ``(n, k)``.
        weight: factor on each range's statistic, ``(k,)``.
        min_breaths: fewest breaths that a range must have.

    Returns:
        Shape ``(k,)``; zero for ranges with fewer breaths.
    """
    filled, scale = _scaled(values, weight, min_breaths)
    return filled.sum(axis=0) * scale


def p_values(
    values: Floats,
    *,
    two_sided: bool,
    seed: int,
    weight: Floats | None = None,
    settings: ResidualSettings = DEFAULT.residuals,
) -> Floats:
    """Probability that chance alone gives any range as large a statistic, ``(k,)``.

    Args:
        values: values of each breath and range, NaN where there is none, ``(n, k)``.
        two_sided: whether large negative statistics count too.
        seed: seed of the sign flips.
        weight: factor on each range's observed statistic, ``(k,)``; not applied to the flips.
        settings: number of flips, and fewest breaths of a range.
    """
    flips, min_breaths = settings.flips, settings.min_breaths
    filled, scale = _scaled(values, None, min_breaths)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(flips, len(values)))
    flipped, observed = (signs @ filled) * scale, statistic(values, weight, min_breaths)
    if two_sided:
        flipped, observed = np.abs(flipped), np.abs(observed)
    largest = np.sort(flipped.max(axis=1, initial=0.0))
    above = flips - np.searchsorted(largest, observed * (1.0 - 1e-12), side="left")
    return np.where(scale > 0, (1.0 + above) / (1.0 + flips), 1.0)


def _scaled(values: Floats, weight: Floats | None, min_breaths: int) -> tuple[Floats, Floats]:
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    norm = np.sqrt(np.sum(filled**2, axis=0))
    enough = (known.sum(axis=0) >= min_breaths) & (norm > 0)
    scale = np.divide(1.0, norm, out=np.zeros_like(norm), where=enough)
    return filled, scale if weight is None else scale * weight


def _mean_over_breaths(error: Floats, inside: Bools) -> float:
    """Mean over breaths of each breath's mean error, as in :class:`Profile`.

    A long stay of one breath in a range counts no more than a short one of another: breaths are the
    independent unit of the tests.
    """
    count = inside.sum(axis=1)
    known = count > 0
    return float(np.mean(np.where(inside, error, 0.0).sum(axis=1)[known] / count[known]))


def _breath_means(axis: Axis, values: Floats, usable: Bools) -> Floats:
    """Mean over the samples of each breath and range, NaN where there is none, ``(n, k)``."""
    total, count = _sums(axis, values, usable)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _sums(axis: Axis, values: Floats, usable: Bools) -> tuple[Floats, Floats]:
    n, k = len(values), len(axis)
    inside = usable & (axis.bins >= 0)
    cell = (np.arange(n)[:, None] * k + axis.bins)[inside]
    total = np.asarray(np.bincount(cell, values[inside], n * k), float)
    count = np.asarray(np.bincount(cell, minlength=n * k), float)
    return total.reshape(n, k), count.reshape(n, k)


def _test_columns(axis: Axis, error: Floats, usable: Bools) -> tuple[Floats, Floats, Floats]:
    """Mean error, and excess of the mean square over that outside, by breath and range; weights.

    "Outside" is the rest of the same breath or, if the range is the whole breath, other breaths.
    The mean of the others is as uncertain as the range's own, for which a weight below one makes
    the statistic smaller.
    """
    square = np.where(usable, error**2, 0.0)
    total, count = _sums(axis, square, usable)
    inside = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    all_count = usable.sum(axis=1, keepdims=True)
    rest = all_count - count
    outside = np.divide(
        square.sum(axis=1, keepdims=True) - total,
        rest,
        out=np.full(total.shape, np.nan),
        where=rest > 0,
    )
    weight = np.ones((1, len(axis)))
    for k in range(len(axis)):
        have = count[:, k] > 0
        if have.any() and not (rest[have, k] > 0).any():
            others = ~have & (all_count[:, 0] > 0)
            level = square[others].sum() / max(usable[others].sum(), 1)
            outside[:, k] = level if others.any() else np.nan
            weight[0, k] = np.sqrt(others.sum() / max(others.sum() + have.sum(), 1))
    return _breath_means(axis, error, usable), inside - outside, weight


def _nanmean(values: Floats) -> Floats:
    """Mean over the first axis without NaN; unlike NumPy's it does not warn of empty columns."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0).sum(axis=0), known.sum(axis=0)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _noise_variance(noise_sd: float, error: Floats, usable: Bools) -> float:
    """Variance of the noise; if not given, the median of the samples' mean squares over breaths."""
    if np.isfinite(noise_sd) and noise_sd > 0:
        return float(noise_sd) ** 2
    count = usable.sum(axis=0)
    return float(np.median((error**2).sum(axis=0)[count > 0] / count[count > 0]))


def _runs(significant: Bools, sign: Floats, merge: bool) -> list[tuple[int, int]]:
    """First and last index of runs of neighbours with one sign."""
    runs: list[tuple[int, int]] = []
    for k in np.flatnonzero(significant).tolist():
        if merge and runs and runs[-1][1] == k - 1 and sign[k] == sign[k - 1]:
            runs[-1] = (runs[-1][0], k)
        else:
            runs.append((k, k))
    return runs


def _is_whole_axis(axis: Axis, usable: Bools, first: int, last: int) -> bool:
    used = axis.bins[usable & (axis.bins >= 0)]
    return bool(used.size) and first <= used.min() and last >= used.max()
