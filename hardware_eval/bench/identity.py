"""Which lung is mounted: R and C with intervals, from pressure and flow, without any simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hardware_eval.bench.drive import Driven
from hardware_eval.bench.safety import VALVE_GAIN
from ventbench.base.errors import InputError
from ventbench.mechanics import identify
from ventbench.mechanics.labels import (
    INFORMATIVE,
    Estimate,
    fits,
    matching_settings,
    value_text,
)
from ventbench.recordings.breaths import make_breaths
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung

Floats = NDArray[np.float64]

#: Steps from a command to the sample that its flow is in: at once, and two later as in the
#: recordings.
LAGS = (1, 2, 3)


def identified(
    probes: Sequence[Driven], lung: str, valve: tuple[float, float, float] | None
) -> tuple[bool | None, bool, str]:
    """Judge a label by R and C.

    A calibrated valve gives the flow of the inspirations, as many steps late as explains the
    pressure best; its interval widens those of R and C.

    Args:
        probes: whole breaths, four at least.
        lung: the label.
        valve: flow of the valve and its range, mL/s per %; for devices without a flow.

    Returns:
        Whether the label holds, None if nothing tells; whether it is the only known one that does;
        and R and C with their intervals, in words.
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
        np.arange(len(probes)) + 1, [label.R] * len(probes), [label.C] * len(probes),
        time - time[:, :1], stacked("u_in"), stacked("u_out").astype(int), stacked("pressure"),
        flow=flows[0],
    )  # fmt: skip
    try:
        each = [identify(replace(recorded, flow=flow))[0] for flow in flows]
    except InputError as error:
        return False, False, str(error)
    found = min(each, key=lambda x: x.noise)
    if not math.isfinite(found.match.fitted_R):
        return None, False, "unknown: the flow does not explain the pressure"
    match = found.match

    def widened(ends: tuple[float, float]) -> tuple[float, float]:
        return ends[0] / wide, ends[1] * wide

    R = Estimate(match.fitted_R, "cmH2O/(L/s)", widened(match.ci95_R))
    C = Estimate(match.fitted_C, "mL/cmH2O", widened(match.ci95_C))
    holds = fits(lambda flow: R, C, label)
    settings = [x.id for x in matching_settings(lambda flow: R, C)]
    told = f"R {value_text(R.value, R.ci95)}, C {value_text(C.value, C.ci95)}"
    if not match.informative or not C.ci95[1] <= INFORMATIVE * C.ci95[0]:
        return None, False, f"{told}: too wide to tell"
    if not holds:
        told += f": may be {' or '.join(settings)}" if settings else ": no lung that is known"
    return holds, holds and settings == [lung], told


@dataclass(frozen=True)
class KnownLung:
    """A lung by the probes of the self-test, to be compared with itself.

    Attributes:
        lung: its label.
        logarithms: of R, cmH2O/(L/s), and 1/C, cmH2O/L.
        errors: their standard errors, by the noise of the sensor.
    """

    lung: str
    logarithms: tuple[float, float]
    errors: tuple[float, float]


def measured_lung(
    probes: Sequence[Driven], lung: str, noise: float
) -> tuple[KnownLung, float, float, float]:
    """R, C and the valve's flow over nominal, from ``p = p0 + R Q + V / C`` by least squares.

    Where no flow is measured the nominal valve's is taken, two steps delayed as in the recordings,
    and the valve's flow is what makes C the label's.

    Args:
        probes: of the part ``lung``.
        lung: the label.
        noise: standard deviation of the sensor's, cmH2O.
    """
    steps = protocol.INSPIRATION_STEPS
    rows, pressures, given, nominal = [], [], 0.0, 0.0
    measured = all(np.isfinite(probe.flow[:steps]).all() for probe in probes)
    for index, probe in enumerate(probes):
        valve = 1e-3 * VALVE_GAIN * probe.u_in[:steps]  # L/s, from each sample to the next
        flow = 1e-3 * probe.flow[:steps] if measured else np.append([0.0, 0.0], valve[:-2])
        between = 0.5 * (flow[1:] + flow[:-1]) if measured else valve[:-1]
        volume = np.append(0.0, np.cumsum(between * protocol.DT))
        given, nominal = given + float(volume[-1]), nominal + float(valve.sum() * protocol.DT)
        own = np.zeros((steps, len(probes)))
        own[:, index] = 1.0
        rows.append(np.column_stack([flow, volume, own]))
        pressures.append(probe.pressure[:steps])
    design = np.concatenate(rows)
    solution, *_ = np.linalg.lstsq(design, np.concatenate(pressures), rcond=None)
    R, elastance = float(solution[0]), float(solution[1])
    C = 1000.0 / elastance if elastance > 0.0 else math.inf
    gain = given / max(nominal, 1e-9) if measured else parse_lung(lung).C / C
    errors = noise * np.sqrt(np.diag(np.linalg.pinv(design.T @ design))[:2])
    logs, relative = [math.nan] * 2, [math.nan] * 2
    for k, value in enumerate((R, elastance)):
        if value > 0.0:
            logs[k], relative[k] = math.log(value), float(errors[k]) / value
    return KnownLung(lung, (logs[0], logs[1]), (relative[0], relative[1])), R, C, gain
