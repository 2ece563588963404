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
from typing import Any, NamedTuple

import msgspec

from ventbench.base.errors import InputError
from ventbench.base.files import data_beside
from ventbench.task import protocol
from ventbench.task.lungs import Lung
from ventbench.task.metrics.measured import worst
from ventbench.task.metrics.score import passes_safety_gate, safety_limit, time_above

#: Flow of the fully open PVP inspiratory valve, mL/s per % of command (137 L/min).
VALVE_GAIN = 22.8

#: Resistance of the expiratory valve that the volume estimate empties through, cmH2O/(L/s).
_OUTLET_RESISTANCE = 5.0


@dataclass(frozen=True)
class Check:
    """One safety check; a table of ``checks.toml``, which explains the flags."""

    threshold: float  #: value beyond which the condition holds, in ``unit``.
    unit: str  #: unit of the threshold.
    duration: float  #: how long the condition must hold to trip, s; 0 for one sample.
    reason: str  #: why there is such a check, and why this threshold.
    below: bool = False
    bench: bool = False
    timing: bool = False
    medium: bool = False

    def holds(self, value: float) -> bool:
        """Whether a value is beyond the threshold; NaN never is."""
        return value < self.threshold if self.below else value > self.threshold


#: All checks by name.
CHECKS = msgspec.convert(data_beside(__file__, "checks.toml"), dict[str, Check])


@dataclass(frozen=True)
class SafetySettings:
    """What may differ between two benches."""

    largest_u_in: float = protocol.U_MAX  #: commands are cut to this, %.
    #: largest rise of the command in one step, %; 100 for none, as in simulation.
    largest_rise: float = protocol.U_MAX
    open_tube: bool = False  #: no lung is on, so that no pressure is missed.

    def __post_init__(self) -> None:
        for name in ("largest_u_in", "largest_rise"):
            if not 0.0 < (value := getattr(self, name)) <= protocol.U_MAX:
                raise InputError(
                    f"{name} is {value:g} %; it must be above 0 and at most {protocol.U_MAX:g} %"
                )

    def as_dict(self) -> dict[str, Any]:
        """These and all checks, for every record."""
        return {**{name: vars(check) for name, check in CHECKS.items()}, **vars(self)}


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


@dataclass(frozen=True)
class Trip:
    """A check that has tripped."""

    check: str  #: its name.
    time: float  #: when, s, on the loop's clock.
    value: float  #: value that was compared, in the check's unit.
    message: str  #: one sentence for a person.

    @property
    def alarm(self) -> str:
        """What the operator is told."""
        return f"{'medium' if CHECKS[self.check].medium else 'high'} priority alarm: {self.message}"


@dataclass(frozen=True)
class SafetyState:
    """State of all checks between two steps; with the lung alone, before the first, at rest."""

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


def step(settings: SafetySettings, state: SafetyState, sample: SafetySample) -> SafetyState:
    """Look at one sample; one without a reading neither ends nor begins what the last one showed.

    Args:
        settings: all thresholds.
        state: of a lung at rest, or of the step before.
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
    for name, check in CHECKS.items():
        if not check.holds(value := values[name]):
            continue
        since[name] = state.since.get(name, began if check.duration else sample.time)
        held = sample.time - since[name]
        if held >= check.duration - 1e-9 and name not in tripped:
            trips.append(
                Trip(
                    name,
                    sample.time,
                    value,
                    f"{name.replace('_', ' ')}: {value:.3g} {check.unit}, the limit is "
                    f"{check.threshold:g}"
                    + (f" for {check.duration:g} s" if check.duration else ""),
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
    given = sample.flow * dt if math.isfinite(sample.flow) else valve
    if sample.u_out:
        gone = math.exp(-dt / (1e-3 * C * (R + _OUTLET_RESISTANCE)))
        volume = state.volume * gone
    else:
        volume = state.volume + given
    begins = before.u_out == 1 and sample.u_out == 0
    delivered = 0.0 if sample.u_out else valve + (0.0 if begins else state.delivered)
    switches = before.u_out != sample.u_out
    same = sample.pressure == before.pressure
    resistive = 1e-3 * R * VALVE_GAIN * abs(sample.u_in - before.u_in)
    elastic = (volume - state.volume) / C
    # Behind an open expiratory valve the airway shows PEEP, whatever the lung still holds.
    expected = state.expected + (0.0 if sample.u_out else abs(elastic) + resistive)
    shut = sample.u_in <= 0.0 and sample.u_out == 0
    since = sample.time if math.isnan(state.closed) else state.closed
    closed = since if shut else math.nan
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
) -> dict[str, float]:
    """Value of each check; NaN where it has nothing to compare.

    ``number``: whether the sample has a reading, else it shows the last one. ``jump``: change of
    the reading, cmH2O a step.
    """
    pressure, C, inspires, nan = sample.pressure, state.lung.C, not sample.u_out, math.nan
    limit = float(safety_limit(sample.pip))
    # At or below the limit no breath that was safe becomes unsafe.
    readings = worst(state.breath) if pressure > limit else ()
    passes = passes_safety_gate(readings, sample.pip, protocol.DT)
    above_limit = float(time_above(readings, sample.pip, protocol.DT))
    rise = state.delivered / C
    volume = CHECKS["over_volume"].threshold
    allowed = volume * (1.0 if math.isfinite(sample.flow) else 2.0)
    largest = min(allowed * C * (limit - protocol.PEEP), _LARGEST_VOLUME)
    still = sample.time - state.unchanged
    # A tube that is off shows ambient pressure; any other that does not move is frozen.
    frozen = still > _FROZEN_S and pressure > CHECKS["low_pressure"].threshold
    above = pressure - protocol.PEEP
    opened = not inspires and sample.time - state.switched > _OPENS_S
    settled = sample.time - state.closed >= _SETTLES_S
    return {
        # A sample above the gate's cap is more than any time, however short.
        "over_pressure": (
            nan if passes else max(above_limit, math.nextafter(protocol.SAFETY_TIME, 1.0))
        ),
        "peak_pressure": pressure,
        "over_volume": volume * state.volume / largest if inspires else nan,
        "disconnected": (
            (pressure - state.start) / rise if inspires and rise > _SHOWS and not frozen else nan
        ),
        "software_delay": sample.late,
        "missed_deadlines": sample.late,
        "stuck_sensor": state.expected if still > 0.0 else nan,
        "still_sensor": still,
        "implausible_slope": jump,
        "no_reading": float(not number),
        "no_answer": float(not sample.answered),
        "low_pressure": nan if settings.open_tube else pressure,
        "expiratory_valve": (
            above / max(state.switched_pressure - protocol.PEEP, 1.0)
            if opened and above > _LEAST_LEFT
            else nan
        ),
        "inspiratory_valve": pressure - state.closed_pressure if settled else nan,
        "applied_command": abs(sample.applied - sample.u_in),
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
