"""Where a simulator errs: ranges of phase, command, pressure and others, with p-values.

Breaths are the independent unit of the tests, since the samples of one breath share its noise.
Under the null hypothesis the errors of a breath are as likely with the opposite sign, in all ranges
together; so the largest statistic over all ranges under random sign flips tells how large chance
makes it (Westfall and Young, Resampling-Based Multiple Testing, 1993).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.linear import solve
from ventbench.diagnosis.findings import ErrorRegion
from ventbench.diagnosis.settings import DEFAULT, ResidualSettings
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Fit

#: Share of the extreme values at either end that the ranges of a quantity need not hold.
_EXTREME = 0.005

#: Width of the ranges of time in a phase, s; about how many ranges flow, volume and pressure are
#: divided into; parts that the recording is divided into.
_PHASE_STEP, _RANGES, _COUNT = 0.1, 10, 5

#: Ends of the ranges of the inspiratory valve's command, %, and of the time since an edge, s.
_OPENINGS = np.array(
    [0.0, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0]
)
_EDGE_TIMES = np.array([0.0, 0.035, 0.07, 0.105, 0.15, 0.2, 0.3, 0.5, 1.0, 3.0])

#: Change of the inspiratory valve's command that is an edge, percentage points.
EDGE_SIZE = 5.0

#: Time after the start of expiration from which little moves, s.
_QUIET_AFTER = 0.6

#: Distance from an end of a range, as a share of its width, within which noise decides on which
#: side a value lies.
_CLOSE = 0.1

#: Share of the samples from which a range is no place.
_MOST = 0.9

#: Random signs of innovations.
_FLIPS = 1000

#: Directions that a breath's samples tell apart by less than this share are one.
_RIDGE = 1e-3

#: Axis of the time since a valve's edge.
EDGE = "time since a valve edge"

#: Share of the chance of any range that the test of the mean gets; the test of the square, whose
#: differences are skewed, errs less often than it may.
_MEAN_SHARE = 0.8

#: Excess of the squared error that is reported, as a share of the noise's variance: noise that
#: differs a little from range to range is no missing physics.
MIN_EXCESS = 0.3


@dataclass(frozen=True, eq=False)
class Axis:
    """k neighbouring ranges of one quantity, and the range in which each sample lies."""

    name: str  #: name of the quantity, such as ``time since inspiration``.
    unit: str  #: unit of ``edges``.
    edges: Floats  #: ends of the ranges, ``(k + 1,)``.
    bins: Ints  #: index of the range of each sample, -1 for none, ``(n, T)``.
    merge: bool = True  #: whether neighbouring ranges may be merged.

    def __len__(self) -> int:
        """Number of ranges k."""
        return len(self.edges) - 1


@dataclass(frozen=True, eq=False)
class Profile:
    """Errors in the k ranges of one axis; the error is recorded minus simulated, cmH2O."""

    axis: Axis  #: axis with its ranges.
    mean: Floats  #: mean over breaths of each breath's mean error, ``(k,)``; NaN in an empty range.
    half: Floats  #: half of the 95 % interval of the mean, ``(k,)``.
    breaths: Ints  #: number of breaths with samples in the range, ``(k,)``.


def locate(
    breaths: Breaths,
    refit: Floats,
    noise_sd: float,
    flow: Floats,
    volume: Floats,
    *,
    sorted_by: Ints | None = None,
    settings: ResidualSettings = DEFAULT.residuals,
    least: float = 0.0,
) -> tuple[ErrorRegion, ...]:
    """Find the ranges of phase, command, pressure and other quantities in which a simulator errs.

    There are two tests for each range, over breaths: whether the mean error is zero, and whether
    neighbouring errors share more than outside the range, which catches errors whose sign changes
    from breath to breath. Noise that grows with flow has larger squares, but neighbours of it share
    nothing. The p-values are corrected for all ranges of all axes and for both tests: if
    nothing is missing, the probability that any region is returned is ``settings.level``.

    Args:
        breaths: n breaths of T samples.
        refit: pressure of the refitted simulator, cmH2O, ``(n, T)``.
        noise_sd: standard deviation of the measurement, cmH2O.
        flow: flow of the refitted simulator, mL/s, ``(n, T)``.
        volume: volume of the refitted simulator, mL, ``(n, T)``.
        sorted_by: breath by whose pressure, flow and volume each is sorted, ``(n,)``; itself if
            None.
        settings: ranges and levels.
        least: root-mean-square error, cmH2O, that a mean error must add to the noise.

    Returns:
        Regions; first those with a p-value of at most ``settings.certain``, each group by its share
        of the error. Neighbouring ranges with errors of one sign are merged.
    """
    error, usable = errors(breaths, refit)
    if len(breaths) < settings.min_breaths or not usable.any():
        return ()
    like = slice(None) if sorted_by is None else sorted_by
    all_axes = axes(breaths, refit[like], flow[like], volume[like])
    columns = [_test_columns(axis, error, usable) for axis in all_axes]
    mean, excess, outside = (np.concatenate(part, axis=1) for part in zip(*columns, strict=True))
    variance = noise_sd**2
    by_mean = p_values(mean, two_sided=True, seed=0, settings=settings)
    by_square = p_values(excess, two_sided=False, seed=1, weight=outside[0], settings=settings)
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
        ranges = slice(offset, offset + len(axis))
        offset += len(axis)
        for first, last in _runs(p_value[ranges] <= settings.level, sign[ranges], axis.merge):
            if axis.merge and len(axis) > 1 and _is_most_of_axis(axis, usable, first, last):
                continue  # nearly the whole of an axis is no place
            inside = usable & (axis.bins >= first) & (axis.bins <= last)
            share = squares[inside].sum() / max(float(squares.sum()), 1e-12)
            regions.append(
                ErrorRegion(
                    axis=axis.name,
                    low=float(axis.edges[first]) + (axis.name == "breath number"),
                    high=float(axis.edges[last + 1]),
                    unit=axis.unit,
                    mean_error=_mean_over_breaths(error, inside),
                    p_value=float(p_value[ranges][first : last + 1].min()),
                    share=float(np.clip(share, 0.0, 1.0)),
                )
            )
    return tuple(
        sorted(regions, key=lambda region: (region.p_value > settings.certain, -region.share))
    )


def profiles(
    breaths: Breaths,
    refit: Floats,
    flow: Floats,
    volume: Floats,
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


def quiet_samples(breaths: Breaths) -> Bools:
    """Where nothing moves: late in expiration while the inspiratory valve rests, ``(n, T)``.

    Where the recorded flow stands for the valves, expiration begins as most gas leaves.
    """
    out = (breaths.u_out == 1) & breaths.valid
    if not out.any():
        most = np.argmin(np.where(breaths.valid, breaths.u_in, np.inf), axis=1)
        out = breaths.valid & (np.arange(out.shape[1]) >= most[:, None])
    opened = np.where(out, breaths.time, np.inf).min(axis=1, keepdims=True)
    late = out & (breaths.time > opened + _QUIET_AFTER)
    rest = np.ma.median(np.ma.masked_array(breaths.u_in, ~late), axis=1).filled(0.0)
    return late & (np.abs(breaths.u_in - rest[:, None]) < EDGE_SIZE)


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
    finite = np.isfinite(values)
    filled = np.where(finite, values, 0.0)
    norm = np.sqrt(np.sum(filled**2, axis=0))
    testable = (finite.sum(axis=0) >= min_breaths) & (norm > 0)
    scale = np.divide(1.0, norm, out=np.zeros_like(norm), where=testable)
    return filled, scale if weight is None else scale * weight


def _mean_over_breaths(error: Floats, inside: Bools) -> float:
    """Mean over breaths of each breath's mean error, as in :class:`Profile`.

    A long stay of one breath in a range counts no more than a short one of another: breaths are the
    independent unit of the tests.
    """
    count = inside.sum(axis=1)
    occupied = count > 0
    return float(np.mean(np.where(inside, error, 0.0).sum(axis=1)[occupied] / count[occupied]))


def _breath_means(axis: Axis, values: Floats, usable: Bools) -> Floats:
    """Mean over the samples of each breath and range, NaN where there is none, ``(n, k)``."""
    total, count = _sums(axis, values, usable)
    return _ratio(total, count)


def _ratio(total: Floats, count: Floats) -> Floats:
    """Means of so many values, NaN of none."""
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _sums(axis: Axis, values: Floats, usable: Bools) -> tuple[Floats, Floats]:
    n, k = len(values), len(axis)
    inside = usable & (axis.bins >= 0)
    cell = (np.arange(n)[:, None] * k + axis.bins)[inside]
    total = np.asarray(np.bincount(cell, values[inside], n * k), float)
    count = np.asarray(np.bincount(cell, minlength=n * k), float)
    return total.reshape(n, k), count.reshape(n, k)


def _test_columns(axis: Axis, error: Floats, usable: Bools) -> tuple[Floats, Floats, Floats]:
    """Mean error, and excess of the shared square over that outside, by breath and range; weights.

    "Outside" is the rest of the same breath or, if the range is the whole breath, other breaths.
    The mean of the others is as uncertain as the range's own, for which a weight below one makes
    the statistic smaller.
    """
    square = np.where(usable, shared_square(error, usable), 0.0)
    total, count = _sums(axis, square, usable)
    inside = _ratio(total, count)
    all_count = usable.sum(axis=1, keepdims=True)
    rest = all_count - count
    outside = _ratio(square.sum(axis=1, keepdims=True) - total, rest)
    weight = np.ones((1, len(axis)))
    for k in range(len(axis)):
        have = count[:, k] > 0
        if have.any() and not (rest[have, k] > 0).any():
            reference = ~have & (all_count[:, 0] > 0)
            level = square[reference].sum() / max(usable[reference].sum(), 1)
            outside[:, k] = level if reference.any() else np.nan
            weight[0, k] = np.sqrt(reference.sum() / max(reference.sum() + have.sum(), 1))
    return _breath_means(axis, error, usable), inside - outside, weight


def shared_square(error: Floats, usable: Bools) -> Floats:
    """Product of each error with the mean of its neighbours, cmH2O^2, ``(n, T)``.

    Its mean is the variance of what they share, and zero for white noise of any size.
    """
    neighbours, count = np.zeros(error.shape), np.zeros(error.shape)
    filled = np.where(usable, error, 0.0)
    for ahead, behind in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        neighbours[:, ahead] += filled[:, behind]
        count[:, ahead] += usable[:, behind]
    return filled * neighbours / np.maximum(count, 1.0)


class Excess(NamedTuple):
    """What neighbouring readings of an error share beyond what those of the sensor do."""

    noise: float  #: root-mean-square of the noise, cmH2O; NaN if unknown.
    #: the same where nothing moves, which no error of a simulator can raise; NaN if unknown.
    at_rest: float
    size: float  #: root-mean-square beyond it where something moves, cmH2O.
    p_value: float  #: probability of as much by chance; 1 if it is not material.

    @property
    def outweighs_noise(self) -> bool:
        """Whether more is shared than is noise, which few breaths may show without a small p."""
        return self.size > self.noise


def excess_over_noise(error: Floats, usable: Bools, quiet: Bools) -> Excess:
    """Compare errors with the noise that neighbouring readings show.

    With the second difference ``d`` of three readings, ``d^2 / 6`` is the variance of white noise,
    whatever its tails and however it grows with flow, and ``r^2 - d^2 / 6`` has the mean zero. What
    readings share late in expiration, where nothing moves (slow noise of the sensor, hum), they may
    share everywhere: there, two coefficients of an autoregression are estimated. Beside it, the
    sign of each innovation is as likely as the other: random flips give the p-value of the sum of
    products of neighbours.

    Args:
        error: errors of n breaths of T samples, zero where unknown, cmH2O, ``(n, T)``.
        usable: where they are known.
        quiet: where nothing moves.
    """
    rows = [(error[b, mask], quiet[b, mask]) for b, mask in enumerate(usable) if mask.sum() > 2]
    if not rows:
        return Excess(float("nan"), float("nan"), 0.0, 1.0)
    now = np.concatenate([r[2:] for r, _ in rows])
    before = np.concatenate([np.stack([r[1:-1], r[:-2]]) for r, _ in rows], axis=1)
    white = (now - 2.0 * before[0] + before[1]) ** 2 / 6.0
    rests = np.concatenate([q[:-2] for _, q in rows])  # all three do
    moves = np.concatenate([~(q[2:] | q[:-2]) for _, q in rows])
    shared, memory = 0.0, np.zeros(2)
    if rests.any():
        least = max(float(white[rests].sum()), 1e-12)
        shared = max(float(np.sum(before[0, rests] ** 2)) / least - 1.0, 0.0)
        power = before[:, rests] @ before[:, rests].T
        memory = solve(power + 1e-9 * np.eye(2), before[:, rests] @ now[rests])
    expected = (1.0 + shared) * white
    noise, at_rest = (
        float(np.sqrt(expected[which].mean())) if which.any() else float("nan")
        for which in (moves | rests, rests)
    )
    if not moves.any():
        return Excess(noise, at_rest, 0.0, 1.0)
    size = float(np.mean((before[0] ** 2 - expected)[moves]))
    if size <= MIN_EXCESS * noise**2:
        return Excess(noise, at_rest, float(np.sqrt(max(size, 0.0))), 1.0)
    innovation = now - memory @ before
    pairs = moves[1:] & moves[:-1]
    pairs[np.cumsum([len(r) - 2 for r, _ in rows])[:-1] - 1] = False  # of two breaths
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(_FLIPS, len(innovation)))
    products = innovation[1:] * innovation[:-1] * pairs
    by_chance = (signs[:, 1:] * signs[:, :-1]) @ products
    above = np.count_nonzero(by_chance >= products.sum() * (1.0 - 1e-12))
    return Excess(noise, at_rest, float(np.sqrt(size)), (1.0 + above) / (1.0 + _FLIPS))


def amplitudes(error: Floats, usable: Bools, signals: Floats) -> Floats:
    """Least-squares amplitude of each signal in each breath, ``(n, k)``.

    Args:
        error: errors of n breaths, zero where unknown, cmH2O, ``(n, T)``.
        usable: where they are known.
        signals: what each breath may have of its own, ``(n, T, k)``.
    """
    weighted = np.where(usable[..., None], signals, 0.0)
    scale = np.sqrt(np.maximum((weighted**2).sum(axis=1), 1e-12))
    normal = np.einsum("nti,ntj->nij", weighted, weighted) / (scale[:, :, None] * scale[:, None])
    right = np.einsum("nti,nt->ni", weighted, error) / scale
    normal = normal + _RIDGE * np.eye(signals.shape[-1])
    return solve(normal, right[..., None])[..., 0] / scale


def of_breaths(
    breaths: Breaths, simulated: Floats, gain: Floats, start: Floats
) -> tuple[Floats, Floats, Floats]:
    """What each breath's gain, sensor zero and start make of the errors.

    Where a start never fades, as nothing leaves a lung but by a flow that is recorded, it is what a
    zero is: nothing is then left for the zero.

    Args:
        breaths: n breaths of T samples.
        simulated: pressures from the first readings, cmH2O, ``(n, T)``.
        gain: change of the pressures by the logarithm of the valve's gain, cmH2O, ``(n, T)``.
        start: change of the pressures by the pressure that a breath starts from, ``(n, T)``.

    Returns:
        Their signals ``(n, T, 3)``, sizes ``(n, 3)``, and the errors of the start, ``(n, T)``.
    """
    error, usable = errors(breaths, simulated)
    unlike = 1.0 - start * amplitudes(usable.astype(float), usable, start[..., None])
    share = _ratio(np.sum(unlike**2, axis=1, where=usable), usable.sum(axis=1))[:, None]
    zero = np.where(share > _RIDGE, np.ones_like(start), 0.0)
    signals = np.stack([gain, zero, start], axis=-1)
    sizes = amplitudes(error, usable, signals)
    return signals, sizes, start * sizes[:, 2:]


def _nanmean(values: Floats) -> Floats:
    """Mean over the first axis without NaN; unlike NumPy's it does not warn of empty columns."""
    finite = np.isfinite(values)
    total, count = np.where(finite, values, 0.0).sum(axis=0), finite.sum(axis=0)
    return _ratio(total, count)


def _runs(significant: Bools, sign: Floats, merge: bool) -> list[tuple[int, int]]:
    """First and last index of runs of neighbours with one sign."""
    runs: list[tuple[int, int]] = []
    for k in np.flatnonzero(significant).tolist():
        if merge and runs and runs[-1][1] == k - 1 and sign[k] == sign[k - 1]:
            runs[-1] = (runs[-1][0], k)
        else:
            runs.append((k, k))
    return runs


def _is_most_of_axis(axis: Axis, usable: Bools, first: int, last: int) -> bool:
    used = axis.bins[usable & (axis.bins >= 0)]
    return bool(used.size) and bool(np.mean((used >= first) & (used <= last)) > _MOST)


def axes(breaths: Breaths, pressure: Floats, flow: Floats, volume: Floats) -> tuple[Axis, ...]:
    """All axes of a recording.

    A sample is assigned to the phase, command and edge that acted before it, because these caused
    it. Pressure, flow and volume are those of the simulator: sorted by the recorded values, noise
    alone would have a mean error in the outermost ranges.

    Args:
        breaths: n breaths of T samples.
        pressure: simulated, cmH2O, ``(n, T)``.
        flow: simulated, into the lung, mL/s, ``(n, T)``.
        volume: simulated, mL, ``(n, T)``.
    """
    acted = before(np.asarray(breaths.u_out)) == 0
    start = np.where(acted & breaths.valid, breaths.time, np.inf).min(axis=1, keepdims=True)
    # The first sample of expiration is still the end of inspiration.
    opened = np.where(
        (breaths.u_out == 1) & (breaths.time >= start) & breaths.valid, breaths.time, np.inf
    ).min(axis=1, keepdims=True)
    # A breath without the phase has no time in it.
    start, opened = (np.where(np.isfinite(time), time, np.nan) for time in (start, opened))
    u_in = before(breaths.u_in)

    def edges(values: Floats) -> Floats:
        return round_edges(values, breaths.valid)

    return (
        _phase("time since inspiration", breaths.time - start, acted & breaths.valid),
        _phase("time since expiration", breaths.time - opened, ~acted & breaths.valid),
        _axis("valve opening", "%", _OPENINGS, u_in, acted),
        _axis(EDGE, "s", _EDGE_TIMES, since_edge(breaths)),
        _axis("pressure", "cmH2O", edges(pressure), pressure),
        _axis("flow", "mL/s", edges(flow), flow),
        _axis("volume", "mL", edges(volume), volume),
        *_parts(breaths),
        *_lungs(breaths),
    )


def before(values: NDArray) -> NDArray:
    """Value that acted on each sample: that of the sample before, ``(n, T)``.

    The first sample has its own value.
    """
    return np.concatenate([values[:, :1], values[:, :-1]], axis=1)


def since_edge(breaths: Breaths) -> Floats:
    """Time since either valve's last edge before each sample, s; NaN before any, ``(n, T)``."""
    u_in, u_out = breaths.u_in, np.asarray(breaths.u_out, float)
    is_edge = np.zeros(u_in.shape, bool)
    is_edge[:, 0] = u_in[:, 0] > EDGE_SIZE  # a breath begins with the valve shut
    is_edge[:, 1:] = (np.abs(np.diff(u_in)) > EDGE_SIZE) | (np.diff(u_out) != 0)
    at = np.maximum.accumulate(np.where(is_edge, breaths.time, -np.inf), axis=1)
    earlier = np.concatenate([np.full((len(at), 1), -np.inf), at[:, :-1]], axis=1)
    return np.where(np.isfinite(earlier), breaths.time - earlier, np.nan)


def round_edges(values: Floats, valid: Bools) -> Floats:
    """Ends of about ten ranges at round numbers or half-way between, without extreme values."""
    inside = values[valid & np.isfinite(values)]
    if inside.size == 0:
        return np.array([0.0, 1.0])
    low, high = np.quantile(inside, [_EXTREME, 1.0 - _EXTREME])
    width = max((high - low) / _RANGES, 1e-6)
    scale = 10.0 ** np.floor(np.log10(width))
    step = scale * next(x for x in (1.0, 2.0, 5.0, 10.0) if x * scale >= 0.999 * width)
    # An edge through values that repeat, as the pressure between breaths, would sort them by noise:
    # twice as many lie there as of values that are spread evenly.
    apart = np.abs(inside / step - np.rint(inside / step))
    shift = 0.5 if np.mean(apart < _CLOSE) > 4.0 * _CLOSE else 0.0
    first = np.floor(low / step - shift)
    last = max(np.ceil(high / step - shift), first + 1)
    return np.round(step * (shift + np.arange(first, last + 1)), 9)


def _axis(name: str, unit: str, edges: Floats, values: Floats, inside: Bools | bool = True) -> Axis:
    """Sort values into ranges; a value beyond the ends is in none."""
    # Sums of times carry rounding errors.
    bins = np.searchsorted(edges, values + 1e-9, side="right") - 1
    with np.errstate(invalid="ignore"):
        bins[np.abs(values - edges[-1]) < 1e-6] = len(edges) - 2
        within = inside & np.isfinite(values) & (bins >= 0) & (bins < len(edges) - 1)
    return Axis(name, unit, edges, np.where(within, bins, -1))


def _phase(name: str, time: Floats, inside: Bools) -> Axis:
    step = _PHASE_STEP
    longest = np.max(time, initial=step, where=inside & np.isfinite(time))
    edges = np.round(step * np.arange(np.ceil(longest / step - 1e-6) + 1), 6)
    return _axis(name, "s", edges, time, inside)


def _parts(breaths: Breaths) -> list[Axis]:
    """Parts of the recording by the number of the breath."""
    n, count = len(breaths), min(_COUNT, len(breaths))
    cuts = np.round(np.linspace(0, n, count + 1))
    number = np.repeat(np.arange(n)[:, None], breaths.time.shape[1], axis=1)
    bins = np.where(breaths.valid, np.searchsorted(cuts, number, side="right") - 1, -1)
    # Breaths that are not here keep their numbers.
    edges = breaths.breath_id[np.maximum(cuts.astype(int) - 1, 0)].astype(float)
    edges[0] -= 1.0
    if np.any(np.diff(breaths.breath_id) < 0):  # numbers that begin anew
        edges = cuts
    return [Axis("breath number", "1", edges, bins)] if count > 1 else []


def _lungs(breaths: Breaths) -> list[Axis]:
    """One axis for each lung if there are several, over the whole breath."""
    if len(breaths.by_lung_index) < 2:
        return []
    end = float(np.max(breaths.time, initial=0.0, where=breaths.valid))
    lungs = []
    for name in breaths.by_lung_index:
        inside = (breaths.lung_ids == name)[:, None] & breaths.valid
        bins = np.where(inside, 0, -1)
        lungs.append(Axis(f"lung {name}", "s", np.array([0.0, end]), bins, merge=False))
    return lungs


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
