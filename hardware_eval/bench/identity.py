"""What is mounted: R and C with intervals, and leaks, by pressure and flow, without simulators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy import stats
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import make_interp_spline
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from hardware_eval.bench.drive import Driven
from hardware_eval.bench.safety import VALVE_GAIN
from ventbench.base.arrays import Floats
from ventbench.base.interval import Interval
from ventbench.mechanics.labels import APPARATUS
from ventbench.task import protocol
from ventbench.task.lungs import RECORDED_LUNGS
from ventbench.task.lungs import lung as parse_lung

#: Standard deviations of rigs about their label: of R at 1 L/s a share, and what tubes add,
#: cmH2O/(L/s); of log C. Those of the population, between labels and within: R is 0.74 to 1.07 of
#: the label on average, with 0.1; C 0.95 to 1.17, with 0.08. The 50 of R has no rig there.
RIG_R, TUBES, RIG_C = 0.2, APPARATUS / 1.96, 0.12

#: Probability of a label, among all settings, below which it is refused, and below whose
#: complement the lung may be another one. Squared distance beyond which it is none of them: one
#: right lung in a thousand, by chi square of R and C.
_REFUSED, _FAR = 0.05, 13.8

#: Steps in which the expiratory valve closes, so that part of what the inspiratory one gives leaves
#: through it.
_CLOSING = 4

#: Times by which a flow may follow its command, s, as close as a fit can tell them apart; and half
#: of that in which a valve moves evenly.
_LATE, _MOVES = np.arange(46) * 0.002, 0.01


@dataclass(frozen=True)
class Valve:
    """Steady flow of a valve: lines between the openings of its calibration and from 0."""

    openings: tuple[float, ...]  #: %, upwards.
    flows: tuple[float, ...]  #: mL/s.
    error: float  #: standard error of all flows together, as a share.
    scatter: float = 0.0  #: standard deviation of each flow by itself, as a share.

    def flow(self, u_in: Floats) -> Floats:
        """Flows at openings ``(n,)``, %, mL/s; the last line goes on."""
        return make_interp_spline([0.0, *self.openings], [0.0, *self.flows], k=1)(u_in)


#: The valve of the paper.
NOMINAL = Valve((100.0,), (100.0 * VALVE_GAIN,), 0.0)


def interval(mean: Any, error: Any, freedom: Any) -> Interval:
    """The 95 % interval of a mean by Student's t; none without a degree of freedom."""
    half = float(stats.t.ppf(0.975, freedom)) * float(error) if freedom > 0 else math.nan
    return Interval(float(mean), float(mean) - half, float(mean) + half)


#: Coefficients, ``(m, k)``, covariances for residuals of variance 1, ``(m, k, k)``, and squared
#: residuals over their variance, ``(m,)``, at m times; and this variance, cmH2O2.
Fitted = tuple[Floats, Floats, Floats, float]


def is_measured(probes: Sequence[Driven]) -> bool:
    """Whether all flows were measured."""
    return all(np.isfinite(probe.flow).all() for probe in probes)


def fitted(probes: Sequence[Driven], valve: Valve = NOMINAL, terms: int = 3) -> Fitted:
    """Fit ``p = p0 + R Q + K (Q |Q| - Q) + V / C`` by measured flows, or a valve's curve.

    R is that at 1 L/s, cmH2O/(L/s), K in cmH2O s2/L2, 1/C in cmH2O/L. Commands tell the flow but
    for the time d by which it is late, which a stiff lung confuses with R: ``V(t - d) / C`` is
    ``V / C - d Q / C``. So all times are fitted, and each keeps its likelihood. Only the
    inspiration has that flow, and of it not the steps in which the expiratory valve closes. Where a
    flow is measured, it runs straight between samples or is held before each: half a step of time.
    The expiration helps there, with a resistance of its own. ``n`` residuals of correlation rho
    count as ``n (1 - rho) / (1 + rho)``.

    Args:
        probes: of the part ``lung``.
        valve: for devices without a flow.
        terms: how many coefficients; 2 leave out K.
    """
    steps, measured, fits = protocol.INSPIRATION_STEPS, is_measured(probes), []
    parts = [slice(0 if measured or terms < 3 else _CLOSING, steps)]
    parts += [slice(steps, None)] * measured
    for late in (0.0, 0.5 * protocol.DT) if measured else _LATE:
        rows = []
        for probe in probes:
            if measured:
                flow = 1e-3 * probe.flow
                volume = cumulative_trapezoid(flow, dx=protocol.DT, initial=0.0) + late * flow
            else:
                given = np.append(0.0, 1e-3 * np.cumsum(valve.flow(probe.u_in)) * protocol.DT)
                time = protocol.DT * np.arange(len(given))
                course = partial(np.interp, xp=time + late, fp=given)
                before, volume, after = (course(time[:-1] + x) for x in (-_MOVES, 0.0, _MOVES))
                flow = (after - before) / (2.0 * _MOVES)
            drops = np.stack([flow, flow * np.abs(flow) - flow])[: terms - 1]
            for k, part in enumerate(parts):
                columns = np.vstack([drops * (k == 0), volume, drops * k, probe.pressure])[:, part]
                rows.append(columns - columns.mean(axis=1, keepdims=True))
        *columns, pressure = np.hstack(rows)
        design = np.stack(columns, axis=1)
        inverse = np.linalg.pinv(design.T @ design)
        solution = inverse @ (design.T @ pressure)
        fits.append((solution[:terms], inverse[:terms, :terms], pressure - design @ solution))
    coefficients, inverses, residuals = map(np.stack, zip(*fits, strict=True))
    squares = np.square(residuals).sum(axis=1)
    best = residuals[squares.argmin()]
    rho = max(best[1:] @ best[:-1] / max(squares.min(), 1e-12), 0.0)
    variance = max(squares.min() / len(best), _ROUNDED**2) * (1.0 + rho) / (1.0 - rho)
    return coefficients, inverses, squares / variance, variance


def identified(probes: Sequence[Driven], lung: str, valve: Valve | None) -> tuple[bool | None, str]:
    """Judge a label by R and C, among all settings of a test lung.

    The pressure alone tells ``R g`` and ``C / g`` for a valve of gain g: whatever g is, R C. The
    calibrated curve tells g, but for the meter's error, which moves R and 1/C of a setting
    together; where a flow is measured, nothing does. A flow of the curve that is off by itself
    bends the curve, and moves R, K and 1/C each in its own way: as the same fit with it says. Each
    setting is a normal distribution of R and 1/C, as rigs lie about their label, and of K, any
    share of R. Its likelihood is the mean over the times by which the flow may be late, each with
    the distribution of its fit.

    Args:
        probes: whole breaths.
        lung: the label.
        valve: as calibrated; for devices without a flow.

    Returns:
        Whether the label may hold: with a probability of 5 % at least, if all settings were alike
        before; None if nothing tells. And R and C with their intervals, and what the lung may be by
        them, in words.
    """
    if measured := is_measured(probes):
        valve = NOMINAL
    if valve is None:
        return None, "unknown: the device measures no flow and the valve is not calibrated"
    coefficients, inverses, squares, variance = fitted(probes, valve)
    # One of the curve's flows after another is off by its scatter.
    curves = np.array(valve.flows) * (1.0 + valve.scatter * np.eye(len(valve.flows)))
    moved = [fitted(probes, replace(valve, flows=tuple(x)))[0] - coefficients for x in curves]
    covariances = variance * inverses + np.einsum("jmk,jml->mkl", moved, moved)
    beyond = squares - squares.min()
    weights = np.exp(-0.5 * beyond)
    weights /= weights.sum()
    R, _, elastance = mean = weights @ coefficients
    spread = np.diagonal(covariances, axis1=1, axis2=2) + (coefficients - mean) ** 2
    R_half, _, half = 1.96 * np.sqrt(weights @ spread + (valve.error * mean) ** 2)
    likely, far = {}, math.inf
    for x in RECORDED_LUNGS:
        mean = np.array([x.R, 0.5 * x.R, 1e3 / x.C])
        of_R = math.hypot(RIG_R, TUBES / x.R)
        shared = mean * [[of_R, of_R, 0.0], [valve.error] * 3]
        alone = np.diag(np.square([0.0, x.R / 12**0.5, RIG_C * mean[2]]))
        total = covariances + alone + shared.T @ shared
        distance = _squared(coefficients - mean, total) + np.linalg.slogdet(total)[1]
        likely[x.id] = weights @ np.exp(-0.5 * distance)
        off = np.maximum(coefficients, 0.0) - mean  # R is not below 0; K is not known so far off
        far = min(far, *(_squared(off[:, ::2], total[:, ::2, ::2]) + beyond))
    nearest = max(likely, key=likely.__getitem__)
    C = 1e3 / max(elastance, 1e-3)
    told = f"R {R:.1f} (+-{R_half:.1f}), C {C:.1f} (+-{1e-3 * C * C * half:.1f})"
    if far > _FAR:
        return False, f"{told}: no lung that is known, {nearest} is the nearest"
    may = [x for x in likely if likely[x] >= _REFUSED * sum(likely.values())]
    if lung not in may:
        return False, f"{told}: it is {nearest}, not {lung}"
    if others := " or ".join(x for x in may if x != lung):
        why = "" if measured else " without a flow sensor"
        return True, f"{told}: cannot tell {lung} from {others}{why}"
    return True, f"{told}: it is {lung}"


def _squared(off: Floats, covariances: Floats) -> Floats:
    """Squared distances of vectors ``(m, k)`` by covariances ``(m, k, k)``, ``(m,)``."""
    return np.vecdot(off, np.linalg.solve(covariances, off[..., None])[..., 0])


def white_noise(pressure: Floats) -> float:
    """Standard deviation of the noise of pressures that change slowly, cmH2O."""
    return float(np.std(np.diff(pressure))) / math.sqrt(2.0)


@dataclass(frozen=True)
class KnownLung:
    """A lung by the probes of the self-test, to be compared with itself."""

    lung: str  #: its label.
    logarithms: tuple[float, ...]  #: of R, cmH2O/(L/s), and 1/C, cmH2O/L.
    errors: tuple[float, ...]  #: their standard errors, by the noise of the sensor.
    correlation: float = 0.0  #: of these errors; by the same probes always the same.


@dataclass(frozen=True)
class Baseline:
    """What calibration told of a bench."""

    valve: Valve | None = None  #: its curve.
    lung: KnownLung | None = None  #: the lung that was mounted.
    peep: float | None = None  #: pressure of a lung at rest, cmH2O.
    leak: float = 0.0  #: what the bench loses with a lung at 20 cmH2O, mL/s.


def measured_lung(
    probes: Sequence[Driven], lung: str, noise: float
) -> tuple[KnownLung, float, float, float]:
    """R and C, to be compared with themselves, and the valve's flow over nominal.

    Where no flow is measured they are those of the nominal valve, which is never late, and its flow
    is what makes C the label's.

    Args:
        probes: of the part ``lung``.
        lung: the label.
        noise: standard deviation of the sensor's, cmH2O.
    """
    (first, *_), (inverse, *_), *_ = fitted(probes, terms=2)
    R, elastance, values = *first, np.where(first > 0.0, first, math.nan)
    of_one = np.sqrt(np.diag(inverse))
    errors, together = noise * of_one / values, inverse[0, 1] / of_one.prod()
    gain = 1e-3 * parse_lung(lung).C * elastance
    if is_measured(probes):
        gains = [np.maximum(x.flow, 0.0).sum() / max(x.u_in.sum(), 1e-9) for x in probes]
        gain = float(np.mean(gains)) / VALVE_GAIN
    known = KnownLung(lung, tuple(np.log(values).tolist()), tuple(errors.tolist()), together)
    return known, R, 1e3 / max(elastance, 1e-9), gain


#: What a tight lung may creep: this share of its recoil relaxes, with one of these times, s. Rubber
#: bellows do 0.04, human lungs 0.05 to 0.7 (Bates, Lung Mechanics, Cambridge 2009).
CREEP, CREEP_TIMES = 0.08, (0.3, 0.8, 2.0)

#: Steps whose mean is the pressure of the filled lung; least scatter of the wire's numbers, cmH2O.
_FILLED, _ROUNDED = 10, 0.003


def leak(held: Driven, closed: int, C: float, allowed: float) -> tuple[float, float]:
    """Tell a leak from the creep of a tight lung, by the pressures of one that is held closed.

    ``p(t) = p0 - flow / C t + creep S(t)``, where ``S' = P' - S / time`` is the stress of a Maxwell
    element beside the recoil P, which rises with the volume that the valve gives. Two fits by least
    squares, the flow within what is allowed or any, are compared by their likelihood ratio, with
    the scatter about the second one as noise.

    Args:
        held: a lung that is filled, then closed.
        closed: step from which the pressure has settled.
        C: compliance, mL/cmH2O.
        allowed: flow that is no leak yet, mL/s.

    Returns:
        What it loses, mL/s, below 0 where gas comes in; and the standard errors by which the
        pressures contradict all that is allowed.
    """
    time, pressure = held.time[closed:], held.pressure[closed:]
    volume = np.cumsum(held.u_in) / max(float(np.sum(held.u_in)), 1e-9)
    recoil = volume * (float(pressure[:_FILLED].mean()) - held.pressure[0])
    fits: tuple[list[tuple[float, float]], ...] = [], []
    for relaxation in CREEP_TIMES:
        kept = math.exp(-protocol.DT / relaxation)
        stress = lfilter([kept], [1.0, -kept], np.diff(recoil, prepend=0.0))[closed:]
        design = np.column_stack([np.ones_like(time), time.mean() - time, stress])
        for each, most in zip(fits, (allowed / C, np.inf), strict=True):
            bounds = [-np.inf, -most, 0.0], [np.inf, most, CREEP]
            found = lsq_linear(design, pressure, bounds, method="bvls")
            each.append((2.0 * float(found.cost), float(found.x[1])))
    within, of_any = map(min, fits)
    variance = max(of_any[0] / (len(pressure) - 3), _ROUNDED**2)
    sigmas = math.sqrt(max(within[0] - of_any[0], 0.0) / variance)
    return C * of_any[1], sigmas
