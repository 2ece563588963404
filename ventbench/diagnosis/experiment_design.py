"""Choice of the breaths to record next: those that distinguish best between hypotheses.

They are of families of commands, each of which stresses one part of the physics. What new breaths
would say of two hypotheses is computed by linear theory around both fits, in nats of log-likelihood
ratio. Only breaths that are safe under all hypotheses are proposed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.linear import inverse, solve
from ventbench.diagnosis.findings import BreathRequest
from ventbench.system_id.data import Data, Noise
from ventbench.system_id.fit import Fit
from ventbench.system_id.predictor import START, Predictor
from ventbench.system_id.problem import GIVEN, Problem, parameter_of
from ventbench.task.lungs import Lung

#: Breaths that are proposed; and expected log-likelihood ratio, nats, below which nothing is.
_BREATHS, _LEAST = 5, 1.0

#: Pressures, cmH2O, within which every hypothesis must predict a breath (the noise of a start may
#: go below zero), the factor by which one that is not safe is weakened, and how often.
_LIMITS, _WEAKER, _ATTEMPTS = (-1.0, 50.0), 0.75, 3

#: Share of the diagonal that keeps a Hessian invertible where data say nothing.
_RIDGE = 1e-9

#: Iterations of a refit with the weights of robust noise.
_REFITS = 4


#: Breaths of each family, and largest command of the inspiratory valve, %.
_VARIANTS, _MOST = 5, 100.0

#: Length of most inspirations, of fast and of slow inflations, of a hold with both valves shut, and
#: of the interruptions of an expiration, s.
_INSPIRATION, _FAST, _SLOW, _HOLD, _SHUTTER = 1.0, 0.35, 1.5, 2.0, 0.16


def request_breaths(chosen: Fit, alternatives: Sequence[Fit], noise: Noise) -> BreathRequest | None:
    """Find the breaths to record next.

    The value of a family of breaths, or of a mix of two, is the log-likelihood that is expected to
    be lost if one hypothesis is true and another is refitted to recorded and new breaths together.
    It is computed both ways for each alternative, and the smallest counts.

    Args:
        chosen: the best hypothesis, on the recorded breaths.
        alternatives: hypotheses to distinguish it from.
        noise: model of the measurement noise.

    Returns:
        Commands with what to do in words, or None if no safe breaths would distinguish them.
    """
    if not alternatives:
        return None
    data = chosen.problem.data
    recorded = data.weight[:, 0].any(axis=1)
    lungs = (np.flatnonzero((data.lung == lung) & recorded) for lung in np.unique(data.lung))
    designs = [_best_on_lung(chosen, alternatives, noise, rows) for rows in lungs if rows.size]
    best = max(filter(None, designs), key=lambda design: design.nats, default=None)
    if best is None or best.nats < _LEAST:
        return None
    return _worded(best, (chosen, *alternatives), float(np.median(data.dt)))


@dataclass(frozen=True, eq=False)
class Forecast:
    """Prediction of m new breaths by a hypothesis."""

    white: Floats  #: predicted readings, whitened, ``(m, c T)``.
    rows: Floats  #: derivatives of the readings by the shared unknowns, ``(m, s, c T)``.
    breath_rows: Floats  #: the same by the unknowns of each breath, ``(m, o, c T)``.
    breath_precision: Floats  #: prior precision of the unknowns of each breath, ``(o,)``.
    information: Floats  #: information of the recorded breaths on the shared unknowns, ``(s, s)``.


def values_of(fitted: Fit, data: Data, lung: NDArray[np.intp], start: float) -> Floats:
    """Physical values for new breaths, taken in turn from recorded ones, ``(m, P + 1)``.

    Args:
        fitted: the hypothesis.
        data: m new breaths.
        lung: indices of recorded breaths of the lung.
        start: reading that the new breaths start from, cmH2O.
    """
    problem = fitted.problem
    rows = np.resize(lung, len(data))
    values = problem.values(fitted.minimum.x)[rows]
    columns = (*problem.predictor.names, START)
    for name in set(columns).intersection(GIVEN):
        values[:, columns.index(name)] = getattr(data, name)
    values[:, -1] = start
    return values


def forecast(
    fitted: Fit,
    data: Data,
    predictor: Predictor,
    lung: NDArray[np.intp],
    start: float,
    noise: Noise,
) -> Forecast:
    """Predict new breaths with derivatives; for the arguments see :func:`values_of`."""
    problem = fitted.problem
    layout = problem.unknowns
    values = values_of(fitted, data, lung, start)
    predicted, slopes = predictor.derivatives(values, problem.columns)
    slopes = slopes * layout.slopes(values[:, list(problem.columns)])[:, :, None, None]
    rows = noise.whiten(slopes, data.weight).reshape(len(data), len(layout.paths), -1)
    white = noise.whiten(predicted, data.weight).reshape(len(data), -1)
    mine = np.array([_is_breathwise(problem, column) for column in range(len(layout.paths))])
    index = layout.index[lung[0]]
    information = _information(fitted.minimum.hessian, index[~mine])
    return Forecast(
        white, rows[:, ~mine], rows[:, mine], problem.precision[index[mine]], information
    )


@dataclass(frozen=True, eq=False)
class Contrast:
    """Difference of two hypotheses in m new breaths, if one is true and the other is refitted.

    Each breath's own unknowns are eliminated: rows and differences are what their refit leaves.
    """

    difference: Floats  #: whitened, ``(m, k)``.
    rows: Floats  #: derivatives by the shared unknowns of the refitted hypothesis, ``(m, s, k)``.
    information: Floats  #: information of the recorded breaths on the shared unknowns, ``(s, s)``.
    noise: Noise  #: model of the measurement noise.

    def nats(self, which: NDArray[np.intp]) -> float:
        """Log-likelihood that the refitted hypothesis is expected to lose in some breaths."""
        return self.refit(which)[0]

    def refit(self, which: NDArray[np.intp]) -> tuple[float, Floats]:
        """The same, and by how much the refit moves the shared unknowns, ``(s,)``."""
        rows, difference = self.rows[which], self.difference[which]
        residual, step = difference, np.zeros(len(self.information))
        for _ in range(_REFITS):
            weighted = rows * self.noise.influence(residual)[:, None]
            hessian = self.information + np.matmul(weighted, rows.swapaxes(1, 2)).sum(axis=0)
            gradient = np.matmul(weighted, difference[:, :, None])[:, :, 0].sum(axis=0)
            step = solve(_regular(hessian), gradient)
            residual = difference - np.einsum("msk,s->mk", rows, step)
        return float(np.sum(self.noise.loss(residual)) + 0.5 * step @ self.information @ step), step


def contrast(truth: Forecast, refitted: Forecast, noise: Noise) -> Contrast:
    """Contrast of two hypotheses, if the first is true and the second is refitted."""
    count, extra = len(truth.white), len(refitted.breath_precision)
    no_difference = np.zeros((count, extra))
    difference = np.concatenate([truth.white - refitted.white, no_difference], axis=1)
    rows = np.concatenate([refitted.rows, np.zeros((*refitted.rows.shape[:2], extra))], axis=2)
    # The prior of a breath's own unknowns counts as further readings of them.
    before = np.broadcast_to(np.diag(np.sqrt(refitted.breath_precision)), (count, extra, extra))
    nuisance = np.concatenate([refitted.breath_rows, before], axis=2)
    both = project_out(np.concatenate([rows, difference[:, None]], axis=1), nuisance)
    return Contrast(both[:, -1], both[:, :-1], refitted.information, noise)


def project_out(columns: Floats, nuisance: Floats) -> Floats:
    """What a refit of each breath's own unknowns leaves of whitened columns, ``(m, q, k)``.

    Args:
        columns: readings, or derivatives of these, ``(m, q, k)``.
        nuisance: derivatives by the breath's own unknowns, ``(m, o, k)``.
    """
    inner = np.matmul(nuisance, nuisance.swapaxes(1, 2))
    share = solve(_regular(inner), np.matmul(nuisance, columns.swapaxes(1, 2)))
    return columns - np.matmul(share.swapaxes(1, 2), nuisance)


def _is_breathwise(problem: Problem, column: int) -> bool:
    """Whether a free parameter has a value of its own in each breath."""
    path = problem.unknowns.paths[column]
    if path in ("R", "C"):
        return False
    breathwise = len(np.unique(problem.unknowns.index[:, column])) == len(problem.data) > 1
    return breathwise or path == START or parameter_of(path).scope == "breath"


def _information(hessian: Floats, which: Ints) -> Floats:
    """Information of a Hessian on some unknowns, all others refitted."""
    covariance = inverse(_regular(hessian))
    return inverse(_regular(covariance[np.ix_(which, which)]))


def _regular(matrix: Floats) -> Floats:
    """Return the matrix with a slightly larger diagonal, which can be inverted, ``(..., k, k)``."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    most = np.max(diagonal, axis=-1, keepdims=True, initial=1e-300)
    extra = _RIDGE * np.maximum(diagonal, _RIDGE * most)
    return matrix + extra[..., None] * np.eye(matrix.shape[-1])


@dataclass(frozen=True, eq=False)
class _Design:
    """Breaths of one or two families on one lung, with what they are expected to give."""

    nats: float
    picks: list[tuple[Family, list[int]]]  #: families, and which of their breaths.
    lung: Lung


def _best_on_lung(
    chosen: Fit,
    alternatives: Sequence[Fit],
    noise: Noise,
    recorded_rows: NDArray[np.intp],
) -> _Design | None:
    """The best design on the lung of the recorded breaths ``here``."""
    problem = chosen.problem
    values = problem.values(chosen.minimum.x)[recorded_rows]
    columns = (*problem.predictor.names, START)
    rig = Rig(*(float(np.median(values[:, columns.index(n)])) for n in ("R", "C", "gain", "PEEP")))
    start = float(np.median(values[:, -1]))
    samples, dt = problem.data.u_in.shape[1], float(np.median(problem.data.dt))
    every = (chosen, *alternatives)
    kinds = _safe(families(rig, samples, dt), every, problem.data, recorded_rows, start)
    if not kinds:
        return None
    data = _data(kinds, problem.data, recorded_rows)
    predictor = problem.predictor.of(data)
    expected = [
        forecast(hypothesis, data, predictor, recorded_rows, start, noise) for hypothesis in every
    ]
    pairs = [
        pair
        for rival in expected[1:]
        for pair in (
            contrast(expected[0], rival, noise),
            contrast(rival, expected[0], noise),
        )
    ]
    lung = Lung(float(problem.data.R[recorded_rows[0]]), float(problem.data.C[recorded_rows[0]]))
    return _best(kinds, pairs, lung)


def _best(kinds: tuple[Family, ...], pairs: Sequence[Contrast], lung: Lung) -> _Design:
    """The family or mix of two whose smallest nats are the largest."""
    ends = np.cumsum([len(kind.u_in) for kind in kinds])
    firsts = ends - [len(kind.u_in) for kind in kinds]

    def design(*chosen: int) -> _Design:
        counts = [_BREATHS] if len(chosen) == 1 else [_BREATHS - _BREATHS // 2, _BREATHS // 2]
        members = [
            np.linspace(0, len(kinds[i].u_in) - 1, count).round().astype(int)
            for i, count in zip(chosen, counts, strict=True)
        ]
        which = np.concatenate([firsts[i] + m for i, m in zip(chosen, members, strict=True)])
        picks = [(kinds[i], m.tolist()) for i, m in zip(chosen, members, strict=True)]
        return _Design(min(pair.nats(which) for pair in pairs), picks, lung)

    single = [design(i) for i in range(len(kinds))]
    mixed = [design(*both) for both in combinations(range(len(kinds)), 2)]
    return max([*single, *mixed], key=lambda design: design.nats)


def _safe(
    kinds: tuple[Family, ...],
    hypotheses: Sequence[Fit],
    recorded: Data,
    recorded_rows: NDArray[np.intp],
    start: float,
) -> tuple[Family, ...]:
    """Breaths that every hypothesis predicts within the pressure limits, weakened where needed."""
    low, high = _LIMITS
    for attempt in range(_ATTEMPTS + 1):
        data = _data(kinds, recorded, recorded_rows)
        safe = np.ones(len(data), bool)
        for hypothesis in hypotheses:
            predictor = hypothesis.problem.predictor.of(data)
            pressure = predictor.predict(values_of(hypothesis, data, recorded_rows, start))[:, 0]
            inside = (pressure >= low) & (pressure <= high)  # False where it is not finite
            safe &= inside.all(axis=1)
        parts = np.split(safe, np.cumsum([len(kind.u_in) for kind in kinds])[:-1])
        if safe.all() or attempt == _ATTEMPTS:
            break
        kinds = tuple(
            kind.scaled(np.where(part, 1.0, _WEAKER))
            for kind, part in zip(kinds, parts, strict=True)
        )
    parts_within = (kind.select(part) for kind, part in zip(kinds, parts, strict=True))
    return tuple(kind for kind in parts_within if len(kind.u_in))


def _data(kinds: Sequence[Family], recorded: Data, recorded_rows: NDArray[np.intp]) -> Data:
    """Breaths of all families as data without readings, on the lung of recorded breaths."""
    u_in = np.concatenate([kind.u_in for kind in kinds])
    u_out = np.concatenate([kind.u_out for kind in kinds])
    count, channels = len(u_in), recorded.measured.shape[1]
    shape = (count, channels, u_in.shape[1])
    weight = np.ones(shape)
    weight[:, 1:, 0] = 0.0
    ones: Floats = np.ones(count)
    return Data(
        u_in,
        u_out,
        np.full(u_in.shape, float(np.median(recorded.dt))),
        np.zeros(shape),
        weight,
        recorded.R[recorded_rows[0]] * ones,
        recorded.C[recorded_rows[0]] * ones,
        ones,
        0.0 * ones,
    )


def _worded(design: _Design, hypotheses: Sequence[Fit], dt: float) -> BreathRequest:
    parts = [f"{len(members)} x {kind.title}" for kind, members in design.picks]
    u_in = np.concatenate([kind.u_in[members] for kind, members in design.picks])
    u_out = np.concatenate([kind.u_out[members] for kind, members in design.picks])
    acts = [set(hypothesis.names) for hypothesis in hypotheses]
    common = acts[0].intersection(*acts[1:])
    names = [" + ".join(sorted(terms - common)) or "no further mechanism" for terms in acts]
    return BreathRequest(
        f"{'; '.join(parts)} (lung {design.lung.id})",
        tuple(dict.fromkeys(names)),
        design.nats,
        u_in,
        u_out,
        np.full(u_in.shape, dt),
    )


@dataclass(frozen=True)
class Rig:
    """Rough values of lung and valve; only the size of the commands depends on them."""

    R: float  #: resistance, cmH2O/(L/s).
    C: float  #: compliance, mL/cmH2O.
    gain: float  #: gain of the inspiratory valve, mL/s per %.
    peep: float  #: expiratory pressure, cmH2O.


@dataclass(frozen=True, eq=False)
class Family:
    """k breaths of one kind."""

    title: str  #: what to do on the rig, in words.
    u_in: Floats  #: commands of the inspiratory valve, %, ``(k, T)``.
    u_out: Floats  #: commands of the expiratory valve, 0/1, ``(k, T)``.

    def scaled(self, by: Floats) -> Family:
        """Return the family with each inspiration scaled by a factor, ``(k,)``."""
        return Family(self.title, self.u_in * by[:, None], self.u_out)

    def select(self, which: Bools) -> Family:
        """Return some of the breaths, by mask ``(k,)``."""
        return Family(self.title, self.u_in[which], self.u_out[which])


#: Makes commands ``u_in`` (of any size) and ``u_out``, ``(k, T)``, and peak pressures, cmH2O,
#: ``(k,)``, from times, s, ``(k, T)``.
_Shape = Callable[[Rig, Floats], tuple[Floats, Floats, Floats]]


def families(rig: Rig, samples: int, dt: float) -> tuple[Family, ...]:
    """Make all families, sized so that an R-C lung stays at or below 35 cmH2O.

    Args:
        rig: lung and valve that the breaths are for.
        samples: number of samples of a breath.
        dt: time between samples, s.
    """
    times = np.arange(samples, dtype=np.float64) * dt
    t = np.broadcast_to(times, (_VARIANTS, samples))
    result = []
    for title, shape in _KINDS:
        u_in, u_out, peaks = shape(rig, t)
        result.append(Family(title, _sized(rig, dt, u_in, peaks), u_out))
    return tuple(result)


def _sized(rig: Rig, dt: float, u: Floats, peaks: Floats) -> Floats:
    """Scale inspirations to the peak pressures, cmH2O, that an R-C lung would reach."""
    flow = rig.gain * u
    rise = np.cumsum(flow, axis=1) * dt / rig.C + rig.R * flow / 1000.0
    rise_limit = np.maximum(peaks - rig.peep, 2.0)
    return np.clip(u * (rise_limit / rise.max(axis=1))[:, None], 0.0, _MOST)


def _opens(t: Floats, at: float) -> Floats:
    return (t >= at - 1e-9).astype(float)


def _levels(t: Floats, low: float, high: float) -> Floats:
    return np.linspace(high, low, len(t))


def _pressure_steps(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Flow of a controller that steps the pressure: it falls with the lung's time constant."""
    slow = max(rig.R * rig.C / 1000.0, 0.05)
    u = np.exp(-t / slow) * (1.0 - np.exp(-(t + 0.03) / 0.06)) + 0.02
    return u * (t < _INSPIRATION), _opens(t, _INSPIRATION), _levels(t, 12.0, 32.0)


def _pulses(peak: float, seed: int) -> _Shape:
    def shape(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Valve positions that last 2 to 5 samples, a third of them shut."""
        rng, samples = np.random.default_rng(seed), t.shape[1]
        u = np.zeros(t.shape)
        for row in u:
            at = int(rng.integers(1, 3))
            while at < samples:
                length = int(rng.integers(2, 6))
                shut = at > 3 and rng.uniform() < 0.35
                row[at : at + length] = 0.0 if shut else rng.uniform(0.15, 1.0)
                at += length
        return u * (t < _INSPIRATION), _opens(t, _INSPIRATION), np.full(len(t), peak)

    return shape


def _hold(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = (t < _FAST).astype(float)
    return u, _opens(t, _FAST + _HOLD), _levels(t, 12.0, 32.0)


def _ramp(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = np.clip(t / _SLOW, 0.0, 1.0) * (t < _SLOW)
    return u, _opens(t, _SLOW), _levels(t, 12.0, 32.0)


def _staircase(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Small steps up, down and up again, so that the valve turns round."""
    heights = np.array([1.0, 2.0, 3.0, 4.0, 2.5, 1.0, 3.0, 0.5])
    step = np.minimum(t / (_SLOW / len(heights)), len(heights) - 1).astype(int)
    return heights[step] * (t < _SLOW), _opens(t, _SLOW), _levels(t, 10.0, 25.0)


def _long_expiration(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    u = (t < _FAST).astype(float)
    return u, _opens(t, _FAST), _levels(t, 15.0, 35.0)


def _shutters(rig: Rig, t: Floats) -> tuple[Floats, Floats, Floats]:
    """Open and shut the expiratory valve in turn, at another pace in each breath."""
    u = (t < _FAST).astype(float)
    pace = _SHUTTER * np.linspace(0.7, 1.6, len(t))[:, None]
    since_end = t - _FAST
    out = (since_end >= -1e-9) & ((since_end // pace).astype(int) % 2 == 0)
    return u, out.astype(float), _levels(t, 20.0, 32.0)


_KINDS = (
    ("raise the pressure in one step and let it settle", _pressure_steps),
    ("pulse the inspiratory valve at random, strongly", _pulses(30.0, 1)),
    ("pulse the inspiratory valve at random, gently", _pulses(16.0, 2)),
    ("inflate fast, then hold 2 s with both valves shut, then exhale", _hold),
    ("open the inspiratory valve slowly and steadily", _ramp),
    ("move the inspiratory valve in small steps, up and down", _staircase),
    ("inflate fast, then exhale for a long time", _long_expiration),
    ("inflate fast, then open and shut the expiratory valve in turn", _shutters),
)
