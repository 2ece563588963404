"""Calibration of a bench: measured series, a weighted line through each, one dated file.

Every part is a series of readings against a reference, those of a valve reached from below and from
above, and gets the same analysis (:func:`fit`). What the wire measures is read from it; what
it does not, a person reads from an instrument. The file names the device and is refused when it is
of another one, was changed, or is stale.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from hardware_eval.bench import dated
from hardware_eval.bench.bringup import at_open_tube, vented
from hardware_eval.bench.drive import Driven, drive, in_turn
from hardware_eval.bench.identity import (
    Baseline,
    KnownLung,
    Valve,
    identified,
    interval,
    measured_lung,
    white_noise,
)
from hardware_eval.bench.loop import Bench
from hardware_eval.bench.selftest import LIMITS, hold, programs
from hardware_eval.wire.client import Correction
from hardware_eval.wire.messages import Capability
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung

FORMAT = "ventbench-calibration-1"

#: Parts that correct readings; the others were measured with what these correct.
BASE = ("zero", "span", "flow")

#: Openings of the valve, %, upwards; downwards they are the same.
OPENINGS = (5.0, 10.0, 20.0, 30.0, 40.0)

#: Means of a vented sensor that are taken one after another, and the readings of each.
_MEANS, _READINGS = 10, 30

#: Least error of a mean by rounding on the wire: cmH2O, mL/s.
_PRESSURE_ERROR, _FLOW_ERROR = 0.003, 0.3

#: Steps of a puff: at rest, at a larger opening if it comes from above, at its own; steps that
#: count. Factor of the larger opening. Steps for which one is held for a person to read.
_LEAD, _ABOVE, _OWN, _COUNT, _LARGER, _HELD = 3, 2, 3, 2, 1.5, 100


@dataclass(frozen=True)
class Fit:
    """The line through a series."""

    intercept: Interval  #: reading where the reference is 0.
    slope: Interval  #: reading per reference; NaN if the reference is the same throughout.
    residual: float  #: standard deviation of the readings about the line.


def fit(reference: Floats, reading: Floats, error: Floats) -> Fit:
    """Fit a line by least squares, weighted by the readings' errors.

    The errors count if the readings scatter no more than they say; else the scatter does.

    Args:
        reference: shape ``(n,)``.
        reading: shape ``(n,)``.
        error: standard error of each reading, shape ``(n,)``, above 0.
    """
    level = int(np.ptp(reference) == 0.0)
    line, covariance = np.polyfit(reference, reading, 1 - level, w=1.0 / error, cov="unscaled")
    residual = reading - np.polyval(line, reference)
    freedom = len(reading) - len(line)
    scatter = max(float(np.sum((residual / error) ** 2)) / max(freedom, 1), 1.0)
    *slope, intercept = (
        interval(x, math.sqrt(scatter * v), freedom)
        for x, v in zip(line, np.diag(covariance), strict=True)
    )
    spread = math.sqrt(float(residual @ residual) / max(freedom, 1))
    return Fit(intercept, slope[0] if slope else Interval(math.nan), spread)


@dataclass(frozen=True)
class Part:
    """One calibrated part.

    Attributes:
        kind: a key of :data:`PARTS`.
        date: when, UTC, ISO 8601.
        reference, reading, error: the series, see :func:`fit`; units in :data:`PARTS`.
        by_hand: whether a person read the values.
        lung: label of the mounted lung; the series of ``lung`` is the logarithms of R and 1/C.
        note: what the lung is by them, in words.
    """

    kind: str
    date: str
    reference: tuple[float, ...]
    reading: tuple[float, ...]
    error: tuple[float, ...]
    by_hand: bool
    lung: str = ""
    note: str = ""

    @property
    def fit(self) -> Fit:
        """The line through it."""
        return fit(*(np.array(x, float) for x in (self.reference, self.reading, self.error)))

    def problem(self) -> str:
        """Why no bench reads so, as a sentence; empty if one may."""
        line = self.fit
        values = {"slope": line.slope.value, "intercept": line.intercept.value}
        values["residual"] = line.residual / max(np.ptp(self.reading), 1.0)
        if self.kind == "peep":
            values["intercept"] -= self.reference[0]
        if self.kind == "leak":
            values["slope"] = lost_flow(self, self.lung).value
        for name, value in values.items():
            limit = LIMITS.get(f"{self.kind} {name}")
            if limit is not None and not limit.holds(value):
                expected = f"{limit.low:g} to {limit.high:g} ({limit.unit})"
                return f"{name} {value:.4g}, expected {expected}: {limit.reason}"
        return ""

    def __str__(self) -> str:
        if self.kind == "lung":
            R, elastance = (
                Interval(math.exp(x), math.exp(x - 1.96 * e), math.exp(x + 1.96 * e))
                for x, e in zip(self.reading, self.error, strict=True)
            )
            return f"lung: {self.lung} has R {R} cmH2O/(L/s), 1/C {elastance} cmH2O/L; {self.note}"
        own, x, y = self.fit, PARTS[self.kind].reference, PARTS[self.kind].reading
        parts = [f"{self.kind}: {own.intercept} {y} at 0 {x}"]
        if math.isfinite(own.slope.value):
            parts.append(f"{own.slope} {y} per {x}")
        return f"{'; '.join(parts)}; residual {own.residual:.2g} {y}"


#: Points of a series, each reference, reading and standard error of the reading; and a note.
Series = tuple[list[tuple[float, float, float]], str]


def _mean(values: Floats, least: float) -> tuple[float, float]:
    if not np.isfinite(values).all():
        raise InputError("the device gives no reading here; see `ventbench-hardware selftest`")
    scatter = float(values.std(ddof=1)) / math.sqrt(len(values))
    return float(values.mean()), max(scatter, least)


def measure(
    bench: Bench,
    kind: str,
    *,
    lung: str,
    reference: Sequence[float] = (),
) -> Part:
    """Measure one part; a device that moves its valves does so watched, as in a self-test.

    Args:
        bench: device, clock, safety, operator.
        kind: a key of :data:`PARTS`.
        lung: label of the mounted lung, for ``valve``, ``leak`` and ``lung``.
        reference: the reference's values: pressures of ``span``, cmH2O, flows of ``flow``, mL/s,
            openings of ``valve``, %, in the order in which they are set; PEEP by an instrument.

    Raises:
        InputError: if the device or the references cannot tell, what they tell cannot be, or a
            check or the person stops it.
        EmergencyStop: if the operator pressed the key.
        LinkError: if the device is lost.
    """
    if kind not in PARTS:
        raise InputError(f"{kind!r} cannot be calibrated; choose {', '.join(PARTS)}")
    has_flow = _has_flow(bench)
    if kind == "flow" and not has_flow:
        raise InputError("flow: this device measures none")
    by_hand = kind == "valve" and not has_flow
    if question := _METER if by_hand else PARTS[kind].question.format(lung):
        _confirmed(bench, kind, question)
    points, note = PARTS[kind].points(bench, lung, reference)
    columns = zip(*points, strict=True)
    xs, ys, errors = (tuple(round(float(x), 6) for x in column) for column in columns)
    date = dated.today().isoformat(timespec="seconds")
    label = lung if kind in ("lung", "leak") else ""
    part = Part(kind, date, xs, ys, errors, by_hand, label, note)
    if wrong := part.problem():
        raise InputError(f"{kind}: {wrong}. Nothing was kept")
    return part


def _has_flow(bench: Bench) -> bool:
    return Capability.FLOW in bench.client.identity.capabilities


def _confirmed(bench: Bench, kind: str, question: str) -> None:
    if not bench.operator.confirm(question):
        raise InputError(f"{kind}: not confirmed; nothing was measured")


def _level_points(usual: float, bench: Bench, lung: str, reference: Sequence[float]) -> Series:
    """Means of a sensor at one pressure, the usual one if none is given, cmH2O."""
    level = reference[0] if reference else usual
    rows = [_mean(vented(bench, _READINGS)[0], _PRESSURE_ERROR) for _ in range(_MEANS)]
    return [(level, *row) for row in rows], ""


def _applied_points(kind: str, bench: Bench, lung: str, reference: Sequence[float]) -> Series:
    """Readings at pressures or flows that a person applies one after another."""
    unit, flow = PARTS[kind].reference, kind == "flow"
    if len(set(reference)) < 2:
        raise InputError(f"{kind}: give two references at least, such as --reference 0,20,40")
    points = []
    for value in reference:
        what = "send" if flow else "apply"
        where = "through" if flow else "to"
        _confirmed(bench, kind, f"{what} {value:g} {unit} {where} the sensor. Steady?")
        read = vented(bench, 2 * _READINGS)[int(flow)]
        points.append((value, *_mean(read, _FLOW_ERROR if flow else _PRESSURE_ERROR)))
    return points, ""


def _valve_points(bench: Bench, lung: str, reference: Sequence[float]) -> Series:
    openings = [float(x) for x in reference] or [*OPENINGS, *OPENINGS[::-1]]
    if len(set(openings)) < 2 or min(openings) < 0.0 or max(openings) > protocol.U_MAX:
        raise InputError("valve: give two openings at least, within 0 to 100 %")
    points, has_flow = [], _has_flow(bench)
    for before, opening in zip([0.0, *openings], openings, strict=False):
        above = before > opening
        if has_flow:
            puff = _opened(bench, lung, opening, above, _LEAD, _LEAD + _ABOVE + _OWN + 1, 0)
            points.append((opening, *_mean(puff.flow[-_COUNT:], _FLOW_ERROR)))
        else:
            _opened(at_open_tube(bench), lung, opening, above, 0, _HELD, 1)
            flow = bench.operator.number(f"the meter's steady flow at {opening:g} %, mL/s: ")
            points.append((opening, flow, max(0.02 * abs(flow), 1.0)))  # as meters state it
    return points, ""


def _leak_points(bench: Bench, lung: str, reference: Sequence[float]) -> Series:
    noise = white_noise(vented(bench, _READINGS)[0])
    (program,) = programs(lung, noise)["leak"]
    still = hold(lung, noise)[0]
    closed = _watched(drive(bench, lung, program), "leak")
    time, pressure = closed.time[still:], closed.pressure[still:]
    noise = max(white_noise(pressure), _PRESSURE_ERROR)
    return [(t - time[0], p, noise) for t, p in zip(time, pressure, strict=True)], ""


def _lung_points(bench: Bench, lung: str, reference: Sequence[float]) -> Series:
    """Logarithms of R and 1/C, and what the lung is by them."""
    rest, *probes = (
        _watched(drive(bench, lung, program), "lung")
        for part in ("sensor", "lung")
        for program in programs(lung)[part]
    )
    own = measured_lung(probes, lung, max(white_noise(rest.pressure), 1e-3))[0]
    points = list(zip((0.0, 1.0), own.logarithms, own.errors, strict=True))
    if not np.isfinite(points).all():
        raise InputError("lung: neither R nor C can be measured here; see the self-test")
    holds, told = identified(probes, lung, None)
    if holds is False:
        raise InputError(f"lung: {told}. Nothing was kept")
    return points, told


_METER = "flow meter at the valve, tube open, no lung. Is it so?"
_RESTING = "set the lung to {}, PEEP valve as in use. Does it rest?"
_AMBIENT = "open the sensor's tube to air. Is it open?"
_MOUNTED = "set the lung to {} and connect it. Is it set?"


class Kind(NamedTuple):
    """What can be calibrated, and how."""

    reference: str  #: unit.
    reading: str  #: unit.
    question: str  #: what a person prepares, with a place for the lung's label; empty for nothing.
    points: Callable[[Bench, str, Sequence[float]], Series]  #: measures the series.


#: What can be calibrated, by name.
PARTS = {
    "zero": Kind("cmH2O", "cmH2O", _AMBIENT, partial(_level_points, 0.0)),
    "span": Kind("cmH2O", "cmH2O", "", partial(_applied_points, "span")),
    "peep": Kind("cmH2O", "cmH2O", _RESTING, partial(_level_points, protocol.PEEP)),
    "valve": Kind("%", "mL/s", _MOUNTED, _valve_points),
    "flow": Kind("mL/s", "mL/s", "", partial(_applied_points, "flow")),
    "leak": Kind("s", "cmH2O", _MOUNTED, _leak_points),
    "lung": Kind("", "", _MOUNTED, _lung_points),
}


def _watched(done: Driven, kind: str) -> Driven:
    if done.trips:
        raise InputError(f"{kind}: stopped by a check: {done.trips[0]}")
    return done


def _opened(
    bench: Bench, lung: str, opening: float, above: bool, lead: int, steps: int, u_out: int
) -> Driven:
    """Open the valve after some steps, from a larger opening or none, and hold it."""
    first = min(_LARGER * opening, protocol.U_MAX) if above else opening
    turns = (lead, 0.0, 1), (_ABOVE, first, u_out), (steps - lead - _ABOVE, opening, u_out)
    return _watched(drive(bench, lung, in_turn(45.0, *turns)), "valve")


@dataclass(frozen=True)
class Calibration:
    """A calibration of a device."""

    #: what the device says that it is: ``device_id`` and ``calibration``, hexadecimal.
    device: dict[str, str]
    parts: dict[str, Part]  #: by kind.
    sha256: str = ""  #: of the content; identifies the calibration in records.

    def save(self, path: Path) -> Calibration:
        """Write it; returns it with its hash."""
        parts = {
            kind: {**vars(part), "units": PARTS[kind][:2], **msgspec.to_builtins(part.fit)}
            for kind, part in self.parts.items()
        }
        content = {"format": FORMAT, "device": self.device, "parts": parts}
        return replace(self, sha256=dated.save(path, content))

    @property
    def valve(self) -> Valve | None:
        """Curve of the valve, through the means of both directions; None if not calibrated.

        Its error is that of the readings, as a meter is off by the same share everywhere; what the
        directions are apart is each opening's own. Neither is taken to average out.
        """
        if (part := self.parts.get("valve")) is None:
            return None
        series = np.array([part.reference, part.reading, part.error])
        opening, flow, error = series[:, series[0] > 0.0]
        openings = np.unique(opening)
        means = np.array([flow[opening == x].mean() for x in openings])
        near = np.interp(opening, openings, means)
        shares = np.sqrt(np.mean(np.square([error, flow - near] / near), axis=1))
        return Valve(tuple(openings.tolist()), tuple(means.tolist()), *shares.tolist())

    def _line(self, kind: str) -> Fit:
        """The line of a part; of one that was not calibrated, that of a right one."""
        part = self.parts.get(kind)
        return Fit(Interval(0.0), Interval(1.0), 0.0) if part is None else part.fit

    def correction(self) -> Correction:
        """What corrects the readings of the device."""
        zero, span, flow = map(self._line, ("zero", "span", "flow"))
        offset = zero.intercept if "zero" in self.parts else span.intercept
        error = max(_half(span.intercept), protocol.SAFETY_PRESSURE * _half(span.slope))
        if "zero" in self.parts:
            error = math.hypot(error, _half(offset))
        return Correction(
            (offset.value, span.slope.value), (flow.intercept.value, flow.slope.value), error
        )

    def baseline(self) -> Baseline:
        """What a self-test then expects of the bench."""
        lung, leak = self.parts.get("lung"), self.parts.get("leak")
        return Baseline(
            self.valve,
            None if lung is None else KnownLung(lung.lung, lung.reading, lung.error),
            self._line("peep").intercept.value if "peep" in self.parts else None,
            0.0 if leak is None else max(lost_flow(leak, leak.lung).value, 0.0),
        )

    def about(self) -> dict[str, Any]:
        """What a record says of it."""
        dates = {k: x.date for k, x in self.parts.items()}
        return {"sha256": self.sha256, "dates": dates, "readings": str(self.correction())}


def load(path: Path, device: dict[str, str], *, stale: bool = False) -> Calibration:
    """Read a calibration.

    Args:
        path: of the file.
        device: what the device says that it is, see :class:`Calibration`.
        stale: take stale parts too, to renew them one by one.

    Raises:
        InputError: if it is none, was changed, is of another device, or is stale.
    """
    content = dated.load(path, FORMAT, device, "ventbench-hardware calibrate PART --port PORT")
    try:
        parts = msgspec.convert(content["parts"], dict[str, Part])
    except (KeyError, msgspec.ValidationError) as error:
        raise InputError(f"{path} is no calibration ({error}); make one by `calibrate`") from None
    for kind, part in () if stale else parts.items():
        dated.check_age(part.date, f"{path}: {kind}", f"ventbench-hardware calibrate {kind}")
    return Calibration(content["device"], parts, content["sha256"])


def lost_flow(leak: Part, lung: str) -> Interval:
    """Leak of a closed lung by its fall of pressure and the label's C, mL/s."""
    slope, C = leak.fit.slope, parse_lung(lung).C
    return Interval(-C * slope.value, -C * slope.high, -C * slope.low)


def _half(x: Interval) -> float:
    """Half of a 95 % interval; 0 where there is none."""
    return 0.5 * (x.high - x.low) if math.isfinite(x.high - x.low) else 0.0
