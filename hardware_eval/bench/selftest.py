"""The self-test before a session: sensor, valves, tubes, clock, and whether the lung is as told.

Every breath of it is closed-loop or small, and watched by the same checks as a session, so that a
wrongly set lung cannot be hurt by the test that finds it. What is measured is compared with limits
that stand in ``limits.toml`` with their reasons; the sheet says go or no-go.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from hardware_eval.bench.drive import Driven, Program, drive, in_turn, towards
from hardware_eval.bench.identity import (
    Baseline,
    KnownLung,
    identified,
    leak,
    measured_lung,
    white_noise,
)
from hardware_eval.bench.loop import ON_TIME_S, Bench
from hardware_eval.bench.safety import VALVE_GAIN
from ventbench.base.errors import InputError
from ventbench.base.files import data_beside
from ventbench.task import protocol
from ventbench.task.lungs import LUNGS
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics.open_loop import mae


@dataclass(frozen=True)
class Limit:
    """What a measured value must be."""

    low: float  #: least value.
    high: float  #: largest value.
    unit: str  #: of both.
    reason: str  #: why.

    def holds(self, value: float) -> bool:
        """Whether a value is within it, but for rounding."""
        return bool(self.low - 1e-12 <= value <= self.high + 1e-12)


#: Limits of bring-up, self-test and calibration by what is measured.
LIMITS = msgspec.convert(data_beside(__file__, "limits.toml"), dict[str, Limit])


@dataclass(frozen=True)
class Finding:
    """One line of the sheet."""

    name: str  #: what was measured; a key of :data:`LIMITS`.
    value: float  #: measured value; NaN if it could not be measured.
    ok: bool  #: whether it is within its limit.
    text: str  #: what it means, for a person.

    @property
    def limit(self) -> Limit:
        """What the value must be."""
        return LIMITS[self.name]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "name": self.name,
            "ok": self.ok,
            "value": _number(self.value),
            "unit": self.limit.unit,
            "limits": [self.limit.low, _number(self.limit.high)],
            "text": self.text,
            "reason": self.limit.reason,
        }

    def __str__(self) -> str:
        limit = f"{self.limit.low:g} to {self.limit.high:g} {self.limit.unit}"
        return f"  {'ok   ' if self.ok else 'NO-GO'} {self.name:13s} {self.text} ({limit})"


@dataclass(frozen=True)
class Sheet:
    """The go/no-go sheet.

    Attributes:
        lung: label that was tested.
        findings: all of them.
        errors: open-loop error of each lung's frozen simulator on the probes, cmH2O.
        R, C: least-squares estimates, cmH2O/(L/s) and mL/cmH2O; by the nominal valve where no flow
            is measured, and then no better than that.
        skipped: parts that were left out, of :data:`PARTS`; nothing is known of them.
    """

    lung: str
    findings: tuple[Finding, ...]
    errors: dict[str, float] = field(default_factory=dict)
    R: float = math.nan
    C: float = math.nan
    skipped: tuple[str, ...] = ()

    @property
    def go(self) -> bool:
        """Whether everything is within its limits."""
        return all(finding.ok for finding in self.findings)

    def problems(self) -> list[str]:
        """What is not within its limits, in words."""
        return [f"{x.name.replace('_', ' ')}: {x.text}" for x in self.findings if not x.ok]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "lung": self.lung,
            "go": self.go,
            "skipped": list(self.skipped),
            "R": _number(self.R),
            "C": _number(self.C),
            "errors": {lung: _number(error) for lung, error in self.errors.items()},
            "findings": [x.as_dict() for x in self.findings],
        }

    def __str__(self) -> str:
        lines = [f"self-test of {self.lung}: {'GO' if self.go else 'NO-GO'}"]
        lines += map(str, self.findings)
        lines += [f"  left out: {part}" for part in self.skipped]
        return "\n".join(lines)


def _number(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


#: Integrating probes reach these pressures, cmH2O, with these gains (P, I), %/cmH2O: gentle on
#: every lung, and slow enough that a stiff lung under a soft label does not overshoot.
_PROBES = ((15.0, 1.0, 2.0), (25.0, 1.0, 2.0), (15.0, 3.0, 1.0), (25.0, 0.3, 4.0))

#: Openings of the sweep, %, for :data:`_PUFF` steps each.
_SWEEP = (5.0, 10.0, 20.0, 40.0)

#: Resistance up to which openings and P are these, cmH2O/(L/s). Of a lung with more they are as
#: much smaller, so that no puff comes near the limit of pressure, nor a loop in which P is several
#: times what the resistance allows, and which rings.
_MEANT_RESISTANCE = 20.0
_PUFF = 3

#: Steps at rest before a puff, and with both valves closed after it.
_LEAD, _STILL = 10, 10

#: Least share of the nominal valve's rise.
_LEAST_RISE = 0.25

#: Standard errors beyond which a value counts: of a right lung one in 200 is.
_SIGMAS = 2.6

#: Rest before each part: time constants of the labelled lung behind valve and hose, whose
#: resistance together may be this, cmH2O/(L/s); and its bounds, s.
_TIME_CONSTANTS, _OUTLET, _REST = 5.0, 10.0, (3.0, 16.0)

#: Pressure towards which the lung is filled, cmH2O; time constants of filling, behind a valve whose
#: feedback acts as this resistance, cmH2O/(L/s), and their bounds, s. Steps until a closed lung is
#: still; standard error of its leak, mL/s, that decides how long it is watched, and bounds, s.
_HELD, _FILLING, _FEEDBACK, _FILL = 20.0, 3.0, 15.0, (5.0, 7.0)
_STILL_AFTER, _LEAK_ERROR, _WATCH = 15, 0.2, (4.0, 10.0)


_NO_BASELINE = Baseline()

#: Attempts at a part of the test that a busy host or a slow line ends.
_ATTEMPTS = 10

#: Share of a part's steps that may lack an answer; none of a puff, which a late command shortens.
_MISSED = 0.05


#: Parts that can be left out one by one. The sensor is read in any case: the others need its noise.
PARTS = ("sensor", "leak", "sweep", "lung")


def chosen_parts(skip: Collection[str]) -> tuple[str, ...]:
    """Parts to leave out, in the order of :data:`PARTS`.

    Raises:
        InputError: if there is no such part.
    """
    if unknown := sorted(set(skip) - set(PARTS)):
        raise InputError(f"the self-test has no part {unknown[0]!r}; choose of {', '.join(PARTS)}")
    return tuple(part for part in PARTS if part in skip)


def programs(lung: str, noise: float = 0.0) -> dict[str, list[Program]]:
    """What each part does, the lung vented and at rest before each.

    Args:
        lung: the label.
        noise: standard deviation of the sensor's, cmH2O, which decides how long a leak takes.
    """
    (openings, puff), (closed, steps) = _openings(lung), hold(lung, noise)
    # The target rises, or a sensor without noise would seem to be stuck.
    rising = np.linspace(_HELD - 4.0, _HELD, closed - _STILL_AFTER)
    return {
        "sensor": [in_turn(10.0, (34, 0.0, 1))],
        "leak": [Program(towards(rising.tolist(), 1.0, 2.0, 0), steps, 30.0)],
        "sweep": [
            in_turn(30.0, (_LEAD, 0.0, 1), (puff, u_in, 0), (_STILL, 0.0, 0))
            for u_in in (0.0, *openings)
        ],
        "lung": [
            Program(
                towards([pip] * protocol.INSPIRATION_STEPS, _share(lung) * P, rate, 1),
                protocol.BREATH_STEPS,
                pip,
            )
            for pip, P, rate in _PROBES
        ],
    }


def rest_before(lung: str) -> float:
    """Rest before each program, s: until the labelled lung has emptied."""
    label = parse_lung(lung)
    return float(np.clip(_TIME_CONSTANTS * 1e-3 * label.C * (label.R + _OUTLET), *_REST))


def selftest(
    bench: Bench,
    lung: str,
    *,
    simulator: Any = "frozen",
    baseline: Baseline = _NO_BASELINE,
    skip: Collection[str] = (),
) -> Sheet:
    """Test a bench with a mounted lung.

    Takes a minute; longer where host or line are held up, as a part that they end is repeated.

    Args:
        bench: device, clock, safety, operator.
        lung: its label.
        simulator: the simulators that know the lungs; see :func:`ventbench.load_simulators`.
        baseline: what calibration told of the bench; its valve where no flow is measured.
        skip: parts to leave out, of :data:`PARTS`.

    Raises:
        InputError: if there is no such part.
        EmergencyStop: if the operator pressed the key.
        LinkError: if the device is lost.
    """
    left_out = chosen_parts(skip)
    bench = replace(bench, rest=rest_before(lung))
    driven: dict[str, list[Driven]] = {}
    everything: list[Driven] = []
    repeated, noise = 0, 0.0
    for part in PARTS:
        if part in left_out and part != "sensor":
            continue
        driven[part] = []
        for program in programs(lung, noise)[part]:
            if any(x.trips for x in everything):
                break
            for attempt in range(_ATTEMPTS):
                done = drive(bench, lung, program)
                late = bool(np.any(done.late > LIMITS["latest_step"].high))
                many = done.missed > _MISSED * program.steps
                if not (done.held_up or late or many) or attempt == _ATTEMPTS - 1:
                    break
                repeated += 1
            everything.append(done)
            driven[part].append(done)
        if part == "sensor" and driven[part]:
            noise = _at_rest(driven[part][0])[1]
    sheet = judge(lung, driven, simulator=simulator, baseline=baseline, skipped=left_out)
    findings = list(sheet.findings)
    busy = any(x.held_up for x in everything)
    told = f"{repeated} part{'s' * (repeated != 1)} repeated: host or line was held up"
    told += "; close other programs, or run with real-time priority" * busy
    told = told if repeated else "neither host nor line was held up"
    findings.append(Finding("interruptions", float(repeated), not (busy and repeated), told))
    trips = [text for x in everything if not x.held_up for text in x.trips]
    findings.append(
        Finding("safety", float(len(trips)), not trips, "; ".join(trips) or "nothing tripped")
    )
    findings += _clock(everything, bench)
    return replace(sheet, findings=tuple(findings))


def judge(
    lung: str,
    driven: Mapping[str, Sequence[Driven]],
    *,
    simulator: Any = "frozen",
    baseline: Baseline = _NO_BASELINE,
    skipped: tuple[str, ...] = (),
) -> Sheet:
    """Judge what the programs of the parts brought; of the clock and the checks says nothing.

    Args:
        lung: the label.
        driven: of each part, in the order of its programs; shorter where a check ended it.
        simulator: see :func:`selftest`; None to ask none.
        baseline: see there.
        skipped: parts that were left out.
    """
    findings, noise = _at_rest(driven["sensor"][0], baseline.peep)
    findings = [] if "sensor" in skipped else findings
    if driven.get("leak"):
        findings.append(_closed(driven["leak"][0], lung, baseline.leak))
    if driven.get("sweep"):
        findings += _sweep(driven["sweep"], noise, lung)
    probes = list(driven.get("lung", ()))
    if not probes or any(probe.trips for probe in probes):
        return Sheet(lung, tuple(findings), skipped=skipped)
    errors = {} if simulator is None else _errors(probes, simulator)
    found, R, C, gain = measured_lung(probes, lung, noise)
    holds, told = identified(probes, lung, baseline.valve)
    label = math.nan if holds is None else float(holds)
    findings.append(Finding("identity", label, holds is not False, told))
    findings += _lung(lung, errors, R, C, gain, holds is None and lung in errors)
    findings.append(span_finding(found, baseline.lung))
    return Sheet(lung, tuple(findings), errors, R, C, skipped)


def judged(name: str, value: float, text: str) -> Finding:
    """Hold a value against its limit."""
    return Finding(name, value, LIMITS[name].holds(value), text)


def unknown(name: str, why: str) -> Finding:
    """What could not be measured is not within its limit."""
    return Finding(name, math.nan, False, why)


def _at_rest(rest: Driven, peep: float | None = None) -> tuple[list[Finding], float]:
    """Findings, and the standard deviation of the noise, cmH2O; PEEP as calibrated, if it was."""
    settled = rest.pressure[len(rest.pressure) // 2 :]
    if not settled.size or not np.isfinite(settled).all():
        return [unknown("sensor_zero", "the sensor gives no pressure")], 0.0
    noise = white_noise(settled)
    mean = float(settled.mean())
    return [
        judged("sensor_zero", mean, f"{mean:.2f} cmH2O at rest")
        if peep is None
        else judged("peep", mean - peep, f"{mean:.2f} cmH2O at rest, {peep:.2f} when calibrated"),
        judged("sensor_noise", noise, f"{noise:.2f} cmH2O of noise"),
    ], noise


def hold(lung: str, noise: float) -> tuple[int, int]:
    """The step from which a lung that was filled and closed has settled, and all steps.

    The standard error of a slope falls with the time to the power of 3/2.
    """
    label = parse_lung(lung)
    filling = np.clip(_FILLING * 1e-3 * label.C * (label.R + _FEEDBACK), *_FILL)
    error = math.sqrt(12.0 * protocol.DT) * noise * label.C  # after one second
    watching = np.clip((error / _LEAK_ERROR) ** (2.0 / 3.0), *_WATCH)
    closed = round(float(filling) / protocol.DT) + _STILL_AFTER
    return closed, closed + round(float(watching) / protocol.DT)


def _closed(held: Driven, lung: str, calibrated: float = 0.0) -> Finding:
    closed, _ = hold(lung, 0.0)
    if len(held.pressure) < closed + 10:
        return unknown("leak", "the lung could not be filled")
    allowed = LIMITS["leak"].high + calibrated
    flow, sigmas = leak(held, closed, parse_lung(lung).C, allowed)
    told = f"loses {flow:.1f} mL/s at {held.pressure[closed:].mean():.1f} cmH2O when closed"
    if beyond := sigmas > _SIGMAS:
        told += f": {sigmas:.1f} standard errors beyond {allowed:g} mL/s and creep"
    return Finding("leak", flow, not beyond, told)


def _share(lung: str) -> float:
    """Share of openings and gains that suits a labelled lung; see :data:`_MEANT_RESISTANCE`."""
    return min(1.0, _MEANT_RESISTANCE / parse_lung(lung).R)


def _openings(lung: str) -> tuple[tuple[float, ...], int]:
    """Openings of the sweep of a labelled lung, %, and steps of each puff."""
    scale = _share(lung)
    return tuple(scale * opening for opening in _SWEEP), math.ceil(_PUFF / scale)


def _sweep(puffs: Sequence[Driven], noise: float, lung: str) -> list[Finding]:
    """Compare the rises of the puffs, of no opening and of :func:`_openings`, with the noise.

    A rise is the mean from a puff's first command on, against that at rest. Of a soft lung hardly
    anything remains of it after the puff, while its resistance shows in it.
    """
    openings, steps = _openings(lung)
    whole = [puff.pressure.size == _LEAD + steps + _STILL for puff in puffs]
    if whole != [True] * (1 + len(openings)):
        return [unknown("valve_sweep", "the sweep was stopped")]
    rises = [
        float(puff.pressure[_LEAD + 1 :].mean() - puff.pressure[1:_LEAD].mean()) for puff in puffs
    ]
    counted = steps + _STILL - 1
    error = noise * math.sqrt(2.0 * (1.0 / counted + 1.0 / (_LEAD - 1)))  # of a difference of two
    nominal = VALVE_GAIN * np.diff([0.0, *openings]) * steps * protocol.DT / parse_lung(lung).C
    further = np.diff(rises) > _LEAST_RISE * nominal - _SIGMAS * error
    opens = rises[-1] - rises[0] > _SIGMAS * error
    text = ", ".join(f"{u:g} % {rise:+.2f}" for u, rise in zip(openings, rises[1:], strict=True))
    share = float(np.mean([*further, opens]))
    return [judged("valve_sweep", share, f"{text} cmH2O (SE {error / math.sqrt(2.0):.2f})")]


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
                lung.id,
                probe.u_in[inspiration],
                probe.u_out[inspiration],
                dt[inspiration],
                initial_pressure=float(probe.pressure[0]),
            )
            each.append(float(mae(probe.pressure[inspiration], simulated)))
        errors[lung.id] = float(np.mean(each))
    return errors


def span_finding(found: KnownLung, known: KnownLung | None) -> Finding:
    """Compare a lung with itself: the span of the pressure scales R and 1/C alike.

    The noise moves both of a fit together, so that the surest mean of their changes weighs them by
    the inverse of their covariance.
    """
    if known is None or known.lung != found.lung:
        return Finding("sensor_span", math.nan, True, "unknown: this lung was not calibrated")
    apart = np.subtract(found.logarithms, known.logarithms)
    together = np.array([[1.0, found.correlation], [found.correlation, 1.0]])
    covariance = together * sum(np.outer(x.errors, x.errors) for x in (found, known))
    use = np.isfinite(apart) & (np.diag(covariance) > 0.0)
    if not use.any():
        return unknown("sensor_span", "neither R nor C could be measured")
    weights = np.linalg.inv(covariance[np.ix_(use, use)]).sum(axis=0)
    change, error = float(np.average(apart[use], weights=weights)), float(weights.sum()) ** -0.5
    beyond = abs(change) - _SIGMAS * error > math.log(LIMITS["sensor_span"].high)
    told = f"R and 1/C are {math.exp(change):.3f} (SE {error:.3f}) of those calibrated"
    told += ": calibrate sensor and flow, or is it another lung?" if beyond else ""
    return Finding("sensor_span", math.exp(change), not beyond, told)


def _lung(
    lung: str, errors: dict[str, float], R: float, C: float, gain: float, asked: bool
) -> list[Finding]:
    label, ratio, told = parse_lung(lung), math.nan, f"no simulator of {lung} was asked"
    if lung in errors:
        nearest = min(errors, key=lambda name: errors[name])
        # Of two simulators that are both within the noise of a sensor neither is wrong.
        ratio = 1.0 if errors[lung] < 0.3 else errors[lung] / max(errors[nearest], 1e-9)
        told = f"{errors[lung]:.2f} cmH2O as {lung}"
        if nearest != lung:
            told += f", {errors[nearest]:.2f} as {nearest}: is the lung set to {nearest}?"
    return [
        judged("lung", ratio, told) if asked else Finding("lung", ratio, True, told),
        judged("resistance", max(R, 0.0) / label.R, f"R {R:.1f}, C {C:.1f} by least squares"),
        judged("valve_gain", gain, f"the valve gives {gain:.2f} of 22.8 mL/s per %"),
    ]


def _clock(driven: list[Driven], bench: Bench) -> list[Finding]:
    late = np.concatenate([x.late for x in driven])
    if not late.size:
        return []
    share, worst = float(np.mean(late <= ON_TIME_S)), float(late.max())
    trip, _ = bench.client.round_trips()
    return [
        judged("on_time", share, f"{100 * share:.2f} % of {late.size} steps within 2 ms"),
        judged("latest_step", worst, f"{1e3 * worst:.1f} ms late at worst"),
        judged("round_trip", trip, f"{1e3 * trip:.1f} ms from message to answer"),
    ]
