"""Safety on the host: checks of every step that latch, and limits of every command.

Three layers keep a lung safe, each without trust in the one above: the hardware (a relief valve,
valves that vent without power), the device's program with its watchdog and pressure limit
(:mod:`hardware_eval.device.program`), and these checks, which know what the device does not: the
lung's label, the target, and what the commands of the last second should have done.

The paper's overrides are pressure or volume over a threshold, a disconnected tube and software
delay (section 2). The others are those of the People's Ventilator Project's alarms and of sensors
and valves that stop working. A check that has tripped stays tripped until the operator resumes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ventbench.base.errors import InputError
from ventbench.task import protocol
from ventbench.task.lungs import Lung
from ventbench.task.metrics.measured import worst
from ventbench.task.metrics.score import passes_safety_gate, safety_limit, time_above

#: Flow of the fully open PVP inspiratory valve, mL/s per % of command (137 L/min).
VALVE_GAIN = 22.8

#: Resistance of the expiratory valve that the volume estimate empties through, cmH2O/(L/s).
_OUTLET_RESISTANCE = 5.0

#: A reading is stuck after this even at rest, s (PVP's alarm).
_STUCK_AT_REST_S = 5.0


@dataclass(frozen=True)
class Check:
    """One safety check."""

    threshold: float  #: value beyond which the condition holds, in ``unit``.
    unit: str  #: unit of the threshold.
    duration: float  #: how long the condition must hold to trip, s; 0 for one sample.
    #: whether the bench is to blame, so that the run is repeated; else the controller is, and its
    #: run has no score.
    bench: bool
    reason: str  #: why there is such a check, and why this threshold.

    def __post_init__(self) -> None:
        if not math.isfinite(self.threshold) or not self.duration >= 0.0:
            raise ValueError(f"threshold {self.threshold} or duration {self.duration} is no limit")


@dataclass(frozen=True)
class SafetySettings:
    """All checks and limits; written into every record."""

    #: see the reasons of the checks themselves, also for those that follow.
    over_pressure: Check = Check(
        protocol.SAFETY_TIME,
        "s above min(60, PIP + 15) cmH2O",
        0.0,
        False,
        "The protocol's safety gate, by its own function: a breath may be above that limit for so "
        "long in all.",
    )
    peak_pressure: Check = Check(
        protocol.SAFETY_PRESSURE + 5.0,
        "cmH2O",
        0.0,
        False,
        "One sample is enough: the device vents at 60 itself, so this means that it did not.",
    )
    over_volume: Check = Check(
        1.5,
        "times C (limit - PEEP)",
        0.0,
        False,
        "Volume that would take the labelled lung half beyond the pressure limit has gone in. "
        "Where no flow is measured, the valve's is taken and twice as much allowed, as a leak "
        "takes its part; never more than 2.5 L, more than a test lung holds.",
    )
    disconnected: Check = Check(
        0.12,
        "of V / C",
        0.15,
        True,
        "The volume given should raise the pressure by V / C; less than this share of it says "
        "that the gas goes elsewhere. Counts once V / C exceeds 8 cmH2O.",
    )
    software_delay: Check = Check(
        0.100,
        "s late",
        0.0,
        True,
        "Paper's override: the loop stood still so long that the device has vented by itself.",
    )
    missed_deadlines: Check = Check(
        0.010,
        "s late",
        0.12,
        True,
        "A third of the control step; steps in a row that are so late no longer are 30 ms apart.",
    )
    stuck_sensor: Check = Check(
        8.0,
        "cmH2O of expected change",
        0.15,
        True,
        "The same reading to the last digit while the commands should have changed the pressure; "
        "or for 5 s at rest (PVP's alarm).",
    )
    implausible_slope: Check = Check(
        90.0,
        "cmH2O in a step",
        0.0,
        True,
        "The fully open valve into the stiffest lung gives 53 cmH2O in 30 ms; more is no pressure.",
    )
    no_reading: Check = Check(
        0.0,
        "readings",
        0.09,
        True,
        "Three steps without a number between -20 and 110 cmH2O, answered or not, as no score "
        "allows; the device, which samples more often, vents after 50 ms.",
    )
    no_answer: Check = Check(
        0.0,
        "answers",
        0.06,
        True,
        "Two steps without an answer: the host is blind, and the device's watchdog is about to "
        "vent.",
    )
    low_pressure: Check = Check(
        1.0,
        "cmH2O",
        0.5,
        True,
        "Airway near ambient or below for half a second: PEEP is lost, or the sensor's tube is "
        "off.",
    )
    expiratory_valve: Check = Check(
        0.7,
        "of the pressure above PEEP",
        0.15,
        True,
        "So much is left 0.6 s after the expiratory valve was told to open, and more than 4 cmH2O: "
        "it has not opened. The slowest lung leaves a fifth.",
    )
    inspiratory_valve: Check = Check(
        6.0,
        "cmH2O of rise",
        0.06,
        True,
        "The pressure rises with both valves told to be closed: the inspiratory one has not "
        "closed.",
    )
    applied_command: Check = Check(
        2.0,
        "% apart",
        0.1,
        True,
        "The device reports a position of the valve that it was not told.",
    )
    largest_u_in: float = protocol.U_MAX  #: commands are cut to this, %.
    #: largest rise of the command in one step, %; 100 for none, as in simulation.
    largest_rise: float = 100.0

    def __post_init__(self) -> None:
        if not 0.0 < self.largest_u_in <= protocol.U_MAX:
            raise InputError(
                f"the largest u_in is {self.largest_u_in:g} %; it must be above 0 and at most "
                f"{protocol.U_MAX:g} %"
            )
        if not 0.0 < self.largest_rise <= 100.0:
            raise InputError(
                f"the largest rise of u_in is {self.largest_rise:g} % a step; it must be above 0 "
                "and at most 100 %"
            )

    def checks(self) -> dict[str, Check]:
        """All checks by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Check)}


DEFAULT = SafetySettings()


class SafetySample(NamedTuple):
    """What one step of the loop knows."""

    time: float  #: of the reading, s, on the loop's clock.
    pressure: float  #: measured airway pressure, cmH2O; NaN if there is none.
    flow: float  #: measured flow into the lung, mL/s; NaN if it is not measured.
    u_in: float  #: command in force until now, %.
    u_out: int  #: expiratory valve in force until now, 0/1.
    pip: float  #: target of this breath, cmH2O.
    late: float  #: how late this step began, s.
    #: position of the inspiratory valve as the device reports it, %; NaN if unknown.
    applied: float = math.nan
    #: whether the device answered; else there is no pressure, whatever the sensor does.
    answered: bool = True


#: Checks with an alarm of medium priority, in the words of IEC 60601-1-8; the others have high.
MEDIUM = (
    "disconnected",
    "low_pressure",
    "no_answer",
    "software_delay",
    "missed_deadlines",
    "applied_command",
)

#: Checks that blame the host or the line, not the lung, its tubes or its sensor.
TIMING_CHECKS = frozenset({"no_answer", "software_delay", "missed_deadlines"})


@dataclass(frozen=True)
class Trip:
    """A check that has tripped."""

    check: str  #: its name.
    time: float  #: when, s, on the loop's clock.
    held: float  #: how long its condition had held, s.
    value: float  #: value that was compared, in the check's unit.
    message: str  #: one sentence for a person.
    bench: bool  #: see :class:`Check`.

    @property
    def alarm(self) -> str:
        """What the operator is told."""
        return f"{'medium' if self.check in MEDIUM else 'high'} priority alarm: {self.message}"


@dataclass(frozen=True)
class SafetyState:
    """State of all checks between two steps."""

    lung: Lung  #: label of the mounted lung.
    #: when each condition that holds began to hold, s.
    since: dict[str, float] = field(default_factory=dict)
    trips: tuple[Trip, ...] = ()  #: checks that have tripped, in order; they stay.
    #: sample before, with the last reading where it had none; None before the first.
    previous: SafetySample | None = None
    seen: SafetySample | None = None  #: last sample with a reading; None before the first.
    volume: float = 0.0  #: estimate of the volume above that at PEEP, mL.
    delivered: float = 0.0  #: volume given since this inspiration began, mL.
    start: float = protocol.PEEP  #: pressure when this inspiration began, cmH2O.
    breath: tuple[float, ...] = ()  #: readings of this breath, cmH2O; NaN where there was none.
    switched: float = -math.inf  #: when the expiratory valve last changed its command, s.
    switched_pressure: float = protocol.PEEP  #: pressure then, cmH2O.
    unchanged: float = -math.inf  #: since when the reading has been the same, s.
    #: pressure change that the commands should have brought since then, cmH2O.
    expected: float = 0.0
    #: since when both valves have been told to be closed, s; NaN if they are not.
    closed: float = math.nan
    closed_pressure: float = math.nan  #: pressure then, cmH2O.


def init(lung: Lung) -> SafetyState:
    """State before the first sample, for a lung at rest."""
    return SafetyState(lung)


def step(settings: SafetySettings, state: SafetyState, sample: SafetySample) -> SafetyState:
    """Look at one sample; one without a reading neither ends nor begins what the last one showed.

    Args:
        settings: all thresholds.
        state: state from :func:`init` or from the step before.
        sample: the sample; its time is not before that of the sample before.

    Returns:
        The next state; ``trips`` is longer if a check tripped at this sample.
    """
    number = math.isfinite(sample.pressure) and _PLAUSIBLE[0] <= sample.pressure <= _PLAUSIBLE[1]
    jump = 0.0
    if state.seen is not None and math.isfinite(sample.pressure):
        steps = max((sample.time - state.seen.time) / protocol.DT, 1.0)
        jump = abs(sample.pressure - state.seen.pressure) / steps
    seen = sample if number else state.seen
    last = protocol.PEEP if seen is None else seen.pressure
    sample = sample._replace(pressure=last)
    before = state.previous
    # The reading at which an inspiration begins comes before the valve's command does.
    breath = state.breath
    if before is not None and before.u_out > sample.u_out:
        breath = (before.pressure,)
    breath = (*breath, sample.pressure if number else math.nan)
    state = replace(_estimated(state, sample), breath=breath)
    values = _values(settings, state, sample, number, jump)
    since: dict[str, float] = {}
    trips = list(state.trips)
    tripped = {trip.check for trip in trips}
    # A condition that first shows at this sample has held since the sample before, at the latest.
    began = sample.time if state.previous is None else state.previous.time
    for name, check in settings.checks().items():
        value, holds = values[name]
        if not holds:
            continue
        since[name] = state.since.get(name, began if check.duration else sample.time)
        held = sample.time - since[name]
        if held >= check.duration - 1e-9 and name not in tripped:
            trips.append(
                Trip(
                    name,
                    sample.time,
                    held,
                    value,
                    f"{name.replace('_', ' ')}: {value:.3g} {check.unit}, the limit is "
                    f"{check.threshold:g}"
                    + (f" for {check.duration:g} s" if check.duration else ""),
                    check.bench,
                )
            )
    return replace(state, since=since, trips=tuple(trips), previous=sample, seen=seen)


def _estimated(state: SafetyState, sample: SafetySample) -> SafetyState:
    """Update volumes and expectations by what was in force since the sample before."""
    before = state.previous
    if before is None:
        return replace(state, switched=sample.time, unchanged=sample.time, start=sample.pressure)
    dt = max(sample.time - before.time, 0.0)
    C, R = state.lung.C, state.lung.R
    valve = VALVE_GAIN * sample.u_in * dt  # mL
    measured = sample.flow * dt if math.isfinite(sample.flow) else math.nan
    if sample.u_out:
        gone = math.exp(-dt / (1e-3 * C * (R + _OUTLET_RESISTANCE)))
        volume = state.volume * gone
    else:
        volume = state.volume + (measured if math.isfinite(measured) else valve)
    begins = before.u_out == 1 and sample.u_out == 0
    delivered = (0.0 if begins or sample.u_out else state.delivered) + (
        0.0 if sample.u_out else valve
    )
    switches = before.u_out != sample.u_out
    same = sample.pressure == before.pressure
    resistive = 1e-3 * R * VALVE_GAIN * abs(sample.u_in - before.u_in)
    elastic = (volume - state.volume) / C
    # Behind an open expiratory valve the airway shows PEEP, whatever the lung still holds.
    expected = state.expected + (0.0 if sample.u_out else abs(elastic) + resistive)
    shut = sample.u_in <= 0.0 and sample.u_out == 0
    closed = (
        state.closed if shut and not math.isnan(state.closed) else sample.time if shut else math.nan
    )
    return replace(
        state,
        volume=volume,
        delivered=delivered,
        start=before.pressure if begins else state.start,
        switched=before.time if switches else state.switched,
        switched_pressure=before.pressure if switches else state.switched_pressure,
        unchanged=state.unchanged if same else sample.time,
        expected=expected if same else 0.0,
        closed=closed,
        closed_pressure=state.closed_pressure if closed == state.closed else sample.pressure,
    )


#: Readings outside this are no airway pressures, cmH2O.
_PLAUSIBLE = (-20.0, 110.0)

#: Volume over compliance from which a disconnected tube shows, cmH2O.
_SHOWS = 8.0

#: How long an expiratory valve may take until the pressure must have fallen, s; and how long the
#: pressure of a closed circuit may settle, s.
_OPENS_S, _SETTLES_S = 0.6, 0.12

#: Readings that stay equal for longer, s, are of a frozen sensor; of one that moves few are.
_FROZEN_S = 0.08

#: Volume that no test lung takes, mL.
_LARGEST_VOLUME = 2500.0

#: Pressure above PEEP that an open expiratory valve may always leave, cmH2O.
_LEAST_LEFT = 4.0


def _values(
    settings: SafetySettings, state: SafetyState, sample: SafetySample, number: bool, jump: float
) -> dict[str, tuple[float, bool]]:
    """Value of each check, and whether its condition holds.

    ``number``: whether the sample has a reading, else it shows the last one. ``jump``: change of
    the reading, cmH2O a step.
    """
    pressure, C = sample.pressure, state.lung.C
    limit = float(safety_limit(sample.pip))
    # At or below the limit no breath that was safe becomes unsafe.
    readings = worst(state.breath) if pressure > limit else ()
    open_for = sample.time - state.switched if sample.u_out else 0.0
    rise = state.delivered / C
    share = (pressure - state.start) / rise if rise > _SHOWS else math.nan
    allowed = settings.over_volume.threshold * (1.0 if math.isfinite(sample.flow) else 2.0)
    largest = min(allowed * C * (limit - protocol.PEEP), _LARGEST_VOLUME)
    still = sample.time - state.unchanged
    climbed = pressure - state.closed_pressure if not math.isnan(state.closed) else 0.0
    settled = not math.isnan(state.closed) and sample.time - state.closed >= _SETTLES_S
    apart = abs(sample.applied - sample.u_in)
    left = (pressure - protocol.PEEP) / max(state.switched_pressure - protocol.PEEP, 1.0)
    return {
        "over_pressure": (
            float(time_above(readings, sample.pip, protocol.DT)),
            not passes_safety_gate(readings, sample.pip, protocol.DT),
        ),
        "peak_pressure": (pressure, pressure > settings.peak_pressure.threshold),
        "over_volume": (
            state.volume / (C * (limit - protocol.PEEP)),
            state.volume > largest and not sample.u_out,
        ),
        "disconnected": (
            share,
            not sample.u_out
            and share < settings.disconnected.threshold
            # A tube that is off shows ambient pressure; any other that does not move is frozen.
            and not (still > _FROZEN_S and pressure > settings.low_pressure.threshold),
        ),
        "software_delay": (sample.late, sample.late > settings.software_delay.threshold),
        "missed_deadlines": (sample.late, sample.late > settings.missed_deadlines.threshold),
        "stuck_sensor": (
            state.expected,
            still > 0.0
            and (state.expected > settings.stuck_sensor.threshold or still > _STUCK_AT_REST_S),
        ),
        "implausible_slope": (jump, jump > settings.implausible_slope.threshold),
        "no_reading": (0.0 if number else 1.0, not number),
        "no_answer": (0.0 if sample.answered else 1.0, not sample.answered),
        "low_pressure": (pressure, pressure < settings.low_pressure.threshold),
        "expiratory_valve": (
            left,
            open_for > _OPENS_S
            and pressure - protocol.PEEP > _LEAST_LEFT
            and left > settings.expiratory_valve.threshold,
        ),
        "inspiratory_valve": (climbed, settled and climbed > settings.inspiratory_valve.threshold),
        "applied_command": (apart, apart > settings.applied_command.threshold),
    }


def limit_command(settings: SafetySettings, previous: float, wanted: float) -> tuple[float, bool]:
    """Cut a command to what is safe.

    Args:
        settings: the limits.
        previous: command of the step before, %.
        wanted: what the controller asked for, %; finite.

    Returns:
        The command, %, and whether a limit beyond the protocol's 0..100 % changed it.
    """
    asked = min(max(wanted, 0.0), protocol.U_MAX)
    applied = min(asked, settings.largest_u_in, previous + settings.largest_rise)
    return applied, applied < asked
