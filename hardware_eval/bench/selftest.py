"""The self-test before a session: sensor, valves, tubes, clock, and whether the lung is as told.

Every breath of it is closed-loop or small, and watched by the same checks as a session, so that a
wrongly set lung cannot be hurt by the test that finds it. What is measured is compared with limits
that stand in :data:`LIMITS` with their reasons; the sheet says go or no-go.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware_eval.bench.drive import Commands, Driven, drive
from hardware_eval.bench.identity import identified
from hardware_eval.bench.loop import ON_TIME_S, Bench
from hardware_eval.bench.safety import VALVE_GAIN
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics.open_loop import mae

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Limit:
    """What a measured value must be.

    Attributes:
        low: least value.
        high: largest value.
        unit: of both.
        reason: why.
    """

    low: float
    high: float
    unit: str
    reason: str


LIMITS: dict[str, Limit] = {
    "sensor_zero": Limit(
        protocol.PEEP - 1.5, protocol.PEEP + 1.5, "cmH2O",
        "A vented lung rests at PEEP; an offset would go into every score.",
    ),
    "sensor_noise": Limit(
        0.0, 0.5, "cmH2O", "Standard deviation at rest; the recordings have 0.1 to 0.3.",
    ),
    "leak": Limit(
        -3.0, 3.0, "cmH2O/s",
        "Fall of a closed lung filled towards 20 cmH2O; tight benches show less than 1.5, with "
        "relaxation. Counts beyond 2.6 standard errors of the noise at rest.",
    ),
    "valve_sweep": Limit(
        1.0, 1.0, "of steps up",
        "Each larger opening must give a quarter of the nominal valve's further rise at least, "
        "within 2.6 standard errors of the noise at rest, and the largest one a rise beyond them; "
        "else the valve sticks or is unplugged.",
    ),
    "valve_gain": Limit(
        0.4, 2.0, "of nominal",
        "Flow of the valve against 22.8 mL/s per %: measured, or what makes C the label's.",
    ),
    "resistance": Limit(
        0.0, 3.0, "of label", "More is an occluded or pinched tube.",
    ),
    "lung": Limit(
        0.0, 1.15, "of the best lung's error",
        "Open-loop error of the label's frozen simulator against that of the lung that fits best; "
        "decides where R and C do not.",
    ),
    "identity": Limit(
        1.0, 1.0, "label held",
        "R and C by pressure and flow, measured or of a calibrated valve, with 95 % intervals: the "
        "label holds within the tolerance of test lungs. Simulators have no say in it.",
    ),
    "on_time": Limit(
        0.98, 1.0, "of steps", "Share of steps that begin within 2 ms of their deadline.",
    ),
    "latest_step": Limit(
        0.0, 0.010, "s", "The latest step; a third of the control step.",
    ),
    "round_trip": Limit(
        0.0, 0.010, "s", "Median time from a message to its answer; two of them fit into a step.",
    ),
    "interruptions": Limit(
        0.0, math.inf, "parts repeated",
        "A part that a busy host or a slow line ends, or of which a step is too late, says nothing "
        "of the lung and is repeated; ten times in a row are a no-go.",
    ),
    "safety": Limit(
        0.0, 0.0, "trips", "No safety check may trip in a test this gentle.",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """One line of the sheet.

    Attributes:
        name: what was measured; a key of :data:`LIMITS`.
        value: measured value; NaN if it could not be measured.
        ok: whether it is within its limit.
        text: what it means, for a person.
    """

    name: str
    value: float
    ok: bool
    text: str

    @property
    def limit(self) -> Limit:
        """What the value must be."""
        return LIMITS[self.name]


@dataclass(frozen=True)
class Sheet:
    """The go/no-go sheet.

    Attributes:
        lung: label that was tested.
        findings: all of them.
        errors: open-loop error of each lung's frozen simulator on the probes, cmH2O.
        R, C: least-squares estimates, cmH2O/(L/s) and mL/cmH2O; by the nominal valve where no flow
            is measured, and then no better than that.
    """

    lung: str
    findings: tuple[Finding, ...]
    errors: dict[str, float] = field(default_factory=dict)
    R: float = math.nan
    C: float = math.nan

    @property
    def go(self) -> bool:
        """Whether everything is within its limits."""
        return all(finding.ok for finding in self.findings)

    @property
    def nearest(self) -> str:
        """The lung whose simulator fits the probes best; empty if there were none."""
        return min(self.errors, key=lambda lung: self.errors[lung], default="")

    def problems(self) -> list[str]:
        """What is not within its limits, in words."""
        return [f"{x.name.replace('_', ' ')}: {x.text}" for x in self.findings if not x.ok]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "lung": self.lung,
            "go": self.go,
            "nearest": self.nearest,
            "R": _number(self.R),
            "C": _number(self.C),
            "errors": {lung: _number(error) for lung, error in self.errors.items()},
            "findings": [
                {
                    "name": x.name, "ok": x.ok, "value": _number(x.value), "unit": x.limit.unit,
                    "limits": [x.limit.low, _number(x.limit.high)], "text": x.text,
                    "reason": x.limit.reason,
                }
                for x in self.findings
            ],
        }  # fmt: skip

    def __str__(self) -> str:
        lines = [f"self-test of {self.lung}: {'GO' if self.go else 'NO-GO'}"]
        for x in self.findings:
            limit = f"{x.limit.low:g} to {x.limit.high:g} {x.limit.unit}"
            lines.append(f"  {'ok   ' if x.ok else 'NO-GO'} {x.name:13s} {x.text} ({limit})")
        return "\n".join(lines)


def _number(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


#: Integrating probes reach these pressures, cmH2O, with these gains (P, I), %/cmH2O: gentle on
#: every lung, and slow enough that a stiff lung under a soft label does not overshoot.
_PROBES = ((15.0, 1.0, 2.0), (25.0, 1.0, 2.0), (15.0, 3.0, 1.0), (25.0, 0.3, 4.0))

#: Openings of the sweep, %, for :data:`_PUFF` steps each.
_SWEEP = (5.0, 10.0, 20.0, 40.0)
_PUFF = 3

#: Steps at rest before a puff, with both valves closed after it, and of those that count.
_LEAD, _STILL, _SETTLED = 10, 10, 7

#: Least share of the nominal valve's rise.
_LEAST_RISE = 0.25

#: Standard errors beyond which a value counts: of a right lung one in 200 is.
_SIGMAS = 2.6

#: Rest before each part: time constants of the labelled lung behind valve and hose, whose
#: resistance together may be this, cmH2O/(L/s); and its bounds, s.
_TIME_CONSTANTS, _OUTLET, _REST = 5.0, 10.0, (3.0, 8.0)

#: Pressure at which the closed lung is watched, cmH2O, and the steps of filling and of watching.
_HELD, _FILL, _WATCH = 20.0, 25, 45


#: Attempts at a part of the test that a busy host or a slow line ends.
_ATTEMPTS = 10

#: Share of a part's steps that may lack an answer; none of a puff, which a late command shortens.
_MISSED = 0.05


def selftest(
    bench: Bench, lung: str, *, simulator: Any = "frozen",
    valve: tuple[float, float, float] | None = None,
) -> Sheet:  # fmt: skip
    """Test a bench with a mounted lung.

    Takes about 40 s; longer where host or line are held up, as a part that they end is repeated.

    Args:
        bench: device, clock, safety, operator.
        lung: its label.
        simulator: the simulators that know the lungs; see :func:`ventbench.load_simulators`.
        valve: calibrated flow of the valve and its range, mL/s per %; used where the device
            measures no flow.

    Raises:
        EmergencyStop: if the operator pressed the key.
        LinkError: if the device is lost.
    """
    label = parse_lung(lung)
    empties = _TIME_CONSTANTS * 1e-3 * label.C * (label.R + _OUTLET)
    bench = replace(bench, rest=float(np.clip(empties, *_REST)))
    driven: list[Driven] = []
    repeated = 0

    def run(make: Callable[[], Commands], steps: int, pip: float) -> Driven:
        nonlocal repeated
        for attempt in range(_ATTEMPTS):
            done = drive(bench, lung, make(), steps, pip=pip)
            late = bool(np.any(done.late > LIMITS["latest_step"].high))
            many = done.missed > _MISSED * steps
            if not (done.held_up or late or many) or attempt == _ATTEMPTS - 1:
                break
            repeated += 1
        driven.append(done)
        return done

    findings, noise = _at_rest(run(lambda: lambda step, pressure: (0.0, 1), 34, 10.0))
    if not any(x.trips for x in driven):
        findings += _closed(run(_fill_and_hold, _FILL + _WATCH, 30.0), noise)
    if not any(x.trips for x in driven):
        steps = _LEAD + _PUFF + _STILL
        puffs = [run(partial(_puff, u), steps, 30.0) for u in (0.0, *_SWEEP)]
        findings += _sweep(puffs, noise, label.C)
    probes: list[Driven] = []
    for pip, P, I in _PROBES:  # noqa: E741 - the field's names
        if any(x.trips for x in driven):
            break
        probes.append(run(partial(_probe, pip, P, I), protocol.BREATH_STEPS, pip))
    errors: dict[str, float] = {}
    R = C = math.nan
    if probes and not any(x.trips for x in driven):
        errors = _errors(probes, simulator)
        R, C, gain = _mechanics(probes, lung)
        holds, alone, told = identified(probes, lung, valve)
        known = math.nan if holds is None else float(holds)
        findings.append(Finding("identity", known, holds is not False, told))
        findings += _lung(lung, errors, R, C, gain, alone)
    busy = any(x.held_up for x in driven)
    findings.append(
        Finding(
            "interruptions", float(repeated), not busy,
            f"{repeated} part{'s' * (repeated != 1)} repeated: host or line was held up"
            + ("; close other programs, or run with real-time priority" if busy else ""),
        )
        if repeated
        else _finding("interruptions", 0.0, "neither host nor line was held up")
    )  # fmt: skip
    trips = [text for x in driven if not x.held_up for text in x.trips]
    findings.append(
        Finding("safety", float(len(trips)), not trips, "; ".join(trips) or "nothing tripped")
    )
    findings += _clock(driven, bench)
    return Sheet(lung, tuple(findings), errors, R, C)


def _finding(name: str, value: float, text: str) -> Finding:
    limit = LIMITS[name]
    return Finding(name, value, bool(limit.low - 1e-12 <= value <= limit.high + 1e-12), text)


def _at_rest(rest: Driven) -> tuple[list[Finding], float]:
    """Findings, and the standard deviation of the noise, cmH2O."""
    settled = rest.pressure[len(rest.pressure) // 2 :]
    if not settled.size or not np.isfinite(settled).all():
        return [Finding("sensor_zero", math.nan, False, "the sensor gives no pressure")], 0.0
    noise = float(np.std(np.diff(settled)) / math.sqrt(2.0))
    mean = float(settled.mean())
    return [
        _finding("sensor_zero", mean, f"{mean:.2f} cmH2O at rest"),
        _finding("sensor_noise", noise, f"{noise:.2f} cmH2O of noise"),
    ], noise


def _fill_and_hold() -> Commands:
    total = 0.0

    def commands(step: int, pressure: float) -> tuple[float, int]:
        nonlocal total
        if step >= _FILL:
            return 0.0, 0
        total += 0.06 * (_HELD - pressure - total)
        return max(1.0 * (_HELD - pressure) + 2.0 * total, 0.0), 0

    return commands


def closed_lung() -> tuple[Commands, int, int]:
    """Commands that fill a lung and close it; the step from which it is still; and all steps."""
    return _fill_and_hold(), _FILL + 15, _FILL + _WATCH


def _closed(held: Driven, noise: float) -> list[Finding]:
    watched = held.pressure[_FILL + 15 :]
    if len(watched) < 10:
        return [Finding("leak", math.nan, False, "the lung could not be filled")]
    time = held.time[_FILL + 15 :]
    fall = -float(np.polyfit(time, watched, 1)[0])
    error = noise / math.sqrt(float(np.sum((time - time.mean()) ** 2)))
    told = (
        f"falls by {fall:.2f} (SE {error:.2f}) cmH2O/s from {watched.max():.1f} cmH2O when closed"
    )
    beyond = abs(fall) - _SIGMAS * error > LIMITS["leak"].high
    return [Finding("leak", fall, not beyond, told)]


def _puff(u_in: float) -> Commands:
    def commands(step: int, pressure: float) -> tuple[float, int]:
        return (u_in if _LEAD <= step < _LEAD + _PUFF else 0.0), int(step < _LEAD)

    return commands


def _sweep(puffs: list[Driven], noise: float, C: float) -> list[Finding]:
    """Compare the rises of the puffs, of no opening and of :data:`_SWEEP`, with the noise."""
    if not all(puff.pressure.size == _LEAD + _PUFF + _STILL for puff in puffs):
        return [Finding("valve_sweep", math.nan, False, "the sweep was stopped")]
    rises = [
        float(puff.pressure[-_SETTLED:].mean() - puff.pressure[1:_LEAD].mean()) for puff in puffs
    ]
    error = noise * math.sqrt(2.0 * (1.0 / _SETTLED + 1.0 / (_LEAD - 1)))  # of a difference of two
    nominal = VALVE_GAIN * np.diff([0.0, *_SWEEP]) * _PUFF * protocol.DT / C
    further = np.diff(rises) > _LEAST_RISE * nominal - _SIGMAS * error
    opens = rises[-1] - rises[0] > _SIGMAS * error
    text = ", ".join(f"{u:g} % {rise:+.2f}" for u, rise in zip(_SWEEP, rises[1:], strict=True))
    share = float(np.mean([*further, opens]))
    return [_finding("valve_sweep", share, f"{text} cmH2O (SE {error / math.sqrt(2.0):.2f})")]


def _probe(pip: float, P: float, I: float) -> Commands:  # noqa: E741 - the field's names
    total = 0.0

    def commands(step: int, pressure: float) -> tuple[float, int]:
        nonlocal total
        if step >= protocol.INSPIRATION_STEPS:
            return 0.0, 1
        total += 0.0566 * (pip - pressure - total)
        return max(P * (pip - pressure) + I * total, 0.0), 0

    return commands


def _errors(probes: list[Driven], simulator: Any) -> dict[str, float]:
    """Open-loop error of each lung's simulator over the inspirations of the probes, cmH2O."""
    from ventbench.plants.catalog import load_simulators

    # The reference rig of each lung: a clock of exactly 30 ms tells no rig from another.
    simulators = load_simulators(simulator)
    # What comes after is not compared; and equal lengths are compiled once.
    inspiration = slice(protocol.INSPIRATION_STEPS + 1)
    errors = {}
    for lung in LUNGS:
        each = []
        for probe in probes:
            dt = np.diff(probe.time, append=2 * probe.time[-1] - probe.time[-2])
            simulated = simulators.respond(
                lung.id, probe.u_in[inspiration], probe.u_out[inspiration], dt[inspiration],
                initial_pressure=float(probe.pressure[0]),
            )  # fmt: skip
            each.append(float(mae(probe.pressure[inspiration], simulated)))
        errors[lung.id] = float(np.mean(each))
    return errors


def _mechanics(probes: list[Driven], lung: str) -> tuple[float, float, float]:
    """R, C and the valve's flow over nominal, from ``p = p0 + R Q + V / C`` by least squares.

    Where no flow is measured the nominal valve's is taken, two steps delayed as in the recordings,
    and the valve's flow is what makes C the label's.
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
    solution, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(pressures), rcond=None)
    R, elastance = float(solution[0]), float(solution[1])
    C = 1000.0 / elastance if elastance > 0.0 else math.inf
    return R, C, given / max(nominal, 1e-9) if measured else parse_lung(lung).C / C


def _lung(
    lung: str, errors: dict[str, float], R: float, C: float, gain: float, alone: bool
) -> list[Finding]:
    nearest = min(errors, key=lambda name: errors[name])
    ratio = errors[lung] / max(errors[nearest], 1e-9)
    # Of two simulators that are both within the noise of a sensor neither is wrong.
    ratio = 1.0 if errors[lung] < 0.3 else ratio
    told = f"{errors[lung]:.2f} cmH2O as {lung}"
    if nearest != lung:
        told += f", {errors[nearest]:.2f} as {nearest}: is the lung set to {nearest}?"
    label = parse_lung(lung)
    decided = Finding("lung", ratio, True, told + "; R and C are the label's")
    return [
        decided if alone else _finding("lung", ratio, told),
        _finding("resistance", max(R, 0.0) / label.R, f"R {R:.1f}, C {C:.1f} by least squares"),
        _finding("valve_gain", gain, f"the valve gives {gain:.2f} of 22.8 mL/s per %"),
    ]


def _clock(driven: list[Driven], bench: Bench) -> list[Finding]:
    late = np.concatenate([x.late for x in driven])
    if not late.size:
        return []
    share, worst = float(np.mean(late <= ON_TIME_S)), float(late.max())
    trip = bench.client.statistics().round_trip_median
    return [
        _finding("on_time", share, f"{100 * share:.2f} % of {late.size} steps within 2 ms"),
        _finding("latest_step", worst, f"{1e3 * worst:.1f} ms late at worst"),
        _finding("round_trip", trip, f"{1e3 * trip:.1f} ms from message to answer"),
    ]
