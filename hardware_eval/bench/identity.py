"""What is mounted: R and C with intervals, and leaks, by pressure and flow, without simulators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from hardware_eval.bench.drive import Driven
from hardware_eval.bench.safety import VALVE_GAIN
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval
from ventbench.mechanics import identify
from ventbench.mechanics.labels import value_text
from ventbench.recordings.breaths import make_breaths
from ventbench.task import protocol
from ventbench.task.lungs import RECORDED_LUNGS
from ventbench.task.lungs import lung as parse_lung

#: How far rigs lie from their label, standard deviations: as a share of R at 1 L/s, whose estimate
#: may be zero, and of log C: those of the population of rigs, between labels and within (R is 0.74
#: to 1.07 of the label on average, with 0.1; C 0.95 to 1.17, with 0.08). The 50 of R has no rig
#: there.
RIG_R, RIG_C = 0.2, 0.12

#: Squared distance, in standard deviations of R and C, beyond which a lung is none of a label: one
#: right lung in a thousand. Twice the logarithm of the odds from which two labels are told apart;
#: below them the simulators decide.
_FAR, _APART = 13.8, 2.0

#: Steps from a command to the sample that its flow is in: at once, and two later as in the
#: recordings.
LAGS = (1, 2, 3)


def interval(mean: Any, error: Any, freedom: Any) -> Interval:
    """The 95 % interval of a mean by Student's t; none without a degree of freedom."""
    half = float(stats.t.ppf(0.975, freedom)) * float(error) if freedom > 0 else math.nan
    return Interval(float(mean), float(mean) - half, float(mean) + half)


def identified(
    probes: Sequence[Driven], lung: str, valve: tuple[float, float, float] | None
) -> tuple[bool | None, bool, str]:
    """Judge a label by R and C, among all settings of a test lung.

    The lung is of the setting that is nearest by the spread of rigs about their labels and the
    errors of R and C. A calibrated valve gives the flow of the inspirations, as many steps late as
    explains the pressure best; its interval widens those of R and C.

    Args:
        probes: whole breaths, four at least.
        lung: the label.
        valve: flow of the valve and its range, mL/s per %; for devices without a flow.

    Returns:
        Whether the label holds, None if nothing tells; whether no other known one may; and R and C
        with their intervals, and what the lung is by them, in words.
    """
    label, count = parse_lung(lung), min(len(probe.time) for probe in probes)
    measured = all(np.isfinite(probe.flow).all() for probe in probes)
    if not measured and valve is None:
        unknown = "unknown: the device measures no flow and the valve is not calibrated"
        return None, False, unknown
    count = count if measured else protocol.INSPIRATION_STEPS + 1

    def stacked(name: str) -> Floats:
        return np.stack([getattr(probe, name)[:count] for probe in probes])

    time, wide = stacked("time"), 1.0
    flows = [stacked("flow")]
    if not measured and valve is not None:
        late = np.pad(stacked("u_in"), ((0, 0), (LAGS[-1], 0)))
        flows = [valve[0] * late[:, LAGS[-1] - lag :][:, :count] for lag in LAGS]
        wide = max(valve[0] / valve[1], valve[2] / valve[0]) if valve[1] > 0.0 else math.inf
    recorded = make_breaths(
        np.arange(len(probes)) + 1,
        [label.R] * len(probes),
        [label.C] * len(probes),
        time - time[:, :1],
        stacked("u_in"),
        stacked("u_out").astype(int),
        stacked("pressure"),
        flow=flows[0],
    )
    try:
        readings = ("pressure", "flow") if measured else ("pressure",)
        each = [identify(replace(recorded, flow=x), readings=readings)[0] for x in flows]
    except InputError as error:
        return False, False, str(error)
    found = min(each, key=lambda x: x.noise)
    if not math.isfinite(found.match.fitted_R):
        return None, False, "unknown: the flow does not explain the pressure"
    match = found.match

    R, C = match.fitted_R, match.fitted_C
    told = f"R {value_text(R, match.ci95_R)}, C {value_text(C, match.ci95_C)}"
    error_R, error_C = (
        (0.5 * (high - low) + value * math.log(wide)) / 1.96
        for value, (low, high) in ((R, match.ci95_R), (C, match.ci95_C))
    )
    if not math.isfinite(error_R + error_C) or not C > 0.0:
        return None, False, f"{told}: too wide to tell"
    away = {
        x.id: ((R - x.R) / math.hypot(RIG_R * x.R, error_R)) ** 2
        + (math.log(C / x.C) / math.hypot(RIG_C, error_C / C)) ** 2
        for x in RECORDED_LUNGS
    }
    nearest = min(away, key=lambda name: away[name])
    other = min((name for name in away if name != lung), key=lambda name: away[name])
    if away[nearest] > _FAR:
        return False, False, f"{told}: no lung that is known, {nearest} is the nearest"
    apart = away[other] - away[lung]
    if abs(apart) < _APART:
        return None, False, f"{told}: may be {lung} or {other}"
    if apart < 0.0:
        return False, False, f"{told}: it is {other}, not {lung}"
    return True, True, f"{told}: R {R / label.R:.2f} and C {C / label.C:.2f} of the label's"


def white_noise(pressure: Floats) -> float:
    """Standard deviation of the noise of pressures that change slowly, cmH2O."""
    return float(np.std(np.diff(pressure))) / math.sqrt(2.0)


@dataclass(frozen=True)
class KnownLung:
    """A lung by the probes of the self-test, to be compared with itself."""

    lung: str  #: its label.
    logarithms: tuple[float, float]  #: of R, cmH2O/(L/s), and 1/C, cmH2O/L.
    errors: tuple[float, float]  #: their standard errors, by the noise of the sensor.


@dataclass(frozen=True)
class Baseline:
    """What calibration told of a bench."""

    valve: tuple[float, float, float] | None = None  #: flow and its range, mL/s per %.
    lung: KnownLung | None = None  #: the lung that was mounted.
    peep: float | None = None  #: pressure of a lung at rest, cmH2O.
    leak: float = 0.0  #: what the bench loses with a lung at 20 cmH2O, mL/s.


def measured_lung(
    probes: Sequence[Driven], lung: str, noise: float
) -> tuple[KnownLung, float, float, float]:
    """R, C and the valve's flow over nominal, from ``p = p0 + R Q + V / C`` by least squares.

    R is that of the inspirations. Of measured flows C is that of whole breaths, with a resistance
    of the expiration of its own: volumes that come and go halve its error. Else the nominal valve's
    flow is taken, two steps delayed as in the recordings, and the valve's is what makes C the
    label's.

    Args:
        probes: of the part ``lung``.
        lung: the label.
        noise: standard deviation of the sensor's, cmH2O.
    """
    steps = protocol.INSPIRATION_STEPS
    rows, pressures, masks, given, nominal = [], [], [], 0.0, 0.0
    measured = all(np.isfinite(probe.flow).all() for probe in probes)
    for index, probe in enumerate(probes):
        valve = 1e-3 * VALVE_GAIN * probe.u_in  # L/s, from each sample to the next
        flow = 1e-3 * probe.flow if measured else np.append([0.0, 0.0], valve[:-2])
        between = 0.5 * (flow[1:] + flow[:-1]) if measured else valve[:-1]
        volume = np.append(0.0, np.cumsum(between * protocol.DT))
        given += float(volume[steps - 1])
        nominal += float(valve[:steps].sum() * protocol.DT)
        expired = np.arange(len(flow)) >= steps
        own = np.zeros((len(flow), len(probes)))
        own[:, index] = 1.0
        rows.append(np.column_stack([flow * ~expired, volume, flow * expired, own]))
        pressures.append(probe.pressure)
        masks.append(~expired)
    design, pressure, inspired = map(np.concatenate, (rows, pressures, masks))
    every = np.ones(len(design), bool) if measured else inspired
    (R, R_error), (elastance, elastance_error) = (
        _coefficient(design[used], pressure[used], column, noise)
        for column, used in enumerate((inspired, every))
    )
    C = 1000.0 / elastance if elastance > 0.0 else math.inf
    gain = given / max(nominal, 1e-9) if measured else parse_lung(lung).C / C
    logs, relative = [math.nan] * 2, [math.nan] * 2
    for k, (value, error) in enumerate(((R, R_error), (elastance, elastance_error))):
        if value > 0.0:
            logs[k], relative[k] = math.log(value), error / value
    return KnownLung(lung, (logs[0], logs[1]), (relative[0], relative[1])), R, C, gain


def _coefficient(
    design: Floats, pressure: Floats, column: int, noise: float
) -> tuple[float, float]:
    """A coefficient of a least-squares fit to pressures, cmH2O, ``(n,)``, and its error."""
    solution, *_ = np.linalg.lstsq(design, pressure, rcond=None)
    variance = np.linalg.pinv(design.T @ design)[column, column]
    return float(solution[column]), noise * float(np.sqrt(variance))


#: What a tight lung may creep: this share of its recoil relaxes, with one of these times, s. Rubber
#: bellows do 0.04, human lungs 0.05 to 0.7 (Bates, Lung Mechanics, Cambridge 2009).
CREEP, CREEP_TIMES = 0.08, (0.3, 0.8, 2.0)

#: Steps whose mean is the pressure of the filled lung; least scatter of the wire's numbers, cmH2O.
_FILLED, _ROUNDED = 10, 0.003


@dataclass(frozen=True)
class Leak:
    """What a closed lung loses."""

    flow: float  #: mL/s; below 0 where gas comes in.
    pressure: float  #: mean while it was closed, cmH2O.
    sigmas: float  #: standard errors by which the pressures contradict all that is allowed.


def leak(held: Driven, closed: int, C: float, allowed: float) -> Leak:
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
    """
    time, pressure = held.time[closed:], held.pressure[closed:]
    volume = np.cumsum(held.u_in) / max(float(np.sum(held.u_in)), 1e-9)
    recoil = volume * (float(pressure[:_FILLED].mean()) - held.pressure[0])
    within, of_any = (math.inf, 0.0), (math.inf, 0.0)
    for relaxation in CREEP_TIMES:
        kept = math.exp(-protocol.DT / relaxation)
        stress = lfilter([kept], [1.0, -kept], np.diff(recoil, prepend=0.0))[closed:]
        design = np.column_stack([np.ones_like(time), time.mean() - time, stress])

        def fitted(most: float, design: Floats = design) -> tuple[float, float]:
            bounds = [-np.inf, -most, 0.0], [np.inf, most, CREEP]
            found = lsq_linear(design, pressure, bounds, method="bvls")
            return 2.0 * float(found.cost), float(found.x[1])

        within, of_any = min(within, fitted(allowed / C)), min(of_any, fitted(np.inf))
    variance = max(of_any[0] / (len(pressure) - 3), _ROUNDED**2)
    sigmas = math.sqrt(max(within[0] - of_any[0], 0.0) / variance)
    return Leak(C * of_any[1], float(pressure.mean()), sigmas)
