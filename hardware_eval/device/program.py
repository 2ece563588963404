"""The program of the ventilator's computer: a pure state machine that guards the lung.

It is stepped with the time, the bytes that arrived and the newest sample, and answers with the
valves' positions and the bytes to send. The lung is *vented* when the inspiratory valve is closed
and the expiratory valve open. It is vented whenever the device is not running a host's commands,
and the device stops running them when no acceptable command came for :data:`WATCHDOG` seconds, when
a command is out of range, when the pressure exceeds the limit or stands at the end of the sensor's
range, and when the sensor is lost, stuck or noisy. What the host says cannot change these limits,
except to lower the pressure limit.

Its clock counts whole microseconds, as the wire does, so that firmware without floating-point
numbers decides alike.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field, replace
from typing import Protocol

from hardware_eval.wire.messages import (
    CAUSES,
    PROTOCOL_VERSION,
    Arm,
    Capability,
    Command,
    Counters,
    DeviceMessage,
    Fault,
    Flag,
    Hello,
    HostMessage,
    Kept,
    Mode,
    Packet,
    Reading,
    Reason,
    Refusal,
    Statistics,
    Vent,
    Welcome,
    encode,
    feed_bytes,
    microseconds,
)
from ventbench.task import protocol

#: Version of this program: what a device tells as its firmware.
FIRMWARE = (1, 0, 0)

#: Time without an acceptable command after which the device vents, s. The lung must be vented
#: within 0.1 s of the last command; the rest is for the device's own period and its valves.
WATCHDOG = 0.080

#: Oldest reading on which a command may rest, s: a command that waited in a buffer is refused.
OLDEST_SEEN = 0.100

#: Time without a valid sample after which the device vents, s: ten samples at 5 ms.
SENSOR_TIMEOUT = 0.050

#: Time without a change of the reading after which a sensor that has noise is stuck, s.
STUCK = 0.250

#: Samples from which the noise of the sensor is estimated, and its largest standard deviation,
#: cmH2O: twice what the self-test allows, three times that of the recordings.
NOISE_WINDOW, LARGEST_NOISE = 40, 1.0

#: Standard deviation of white noise over the median absolute second difference of it.
_PER_SECOND_DIFFERENCE = 1.0 / (0.6745 * 6.0**0.5)

#: Largest step of the sequence number: a lost cable loses fewer messages than this.
SEQUENCE_WINDOW = 1 << 16

#: Period at which the program is stepped, s, besides the arrival of bytes.
PERIOD = 0.005


@dataclass(frozen=True, slots=True)
class Sample:
    """One look at the sensors."""

    time: float  #: when it was taken, s, on the clock that the program is stepped with.
    pressure: float  #: airway pressure, cmH2O; NaN if the sensor did not answer.
    flow: float = math.nan  #: flow into the lung, mL/s; NaN if it is not measured.
    saturated: bool = False  #: whether the pressure stands at the upper end of the sensor's range.
    #: whether the electronics have vented by themselves, as the program stood still.
    lapsed: bool = False


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device tells about itself."""

    name: str  #: what people call it, at most 32 bytes of UTF-8.
    device_id: bytes  #: its own number, 8 bytes.
    calibration: bytes  #: SHA-256 of its calibration, 32 bytes.
    capabilities: Capability  #: what it is and has.
    highest: float = math.inf  #: largest pressure that the sensor can tell, cmH2O.
    #: whether noise moves the sensor's readings at rest by half a digit or more, so that one that
    #: does not move is stuck.
    noisy: bool = False


class Sensor(Protocol):
    """What is read."""

    @property
    def identity(self) -> Identity:
        """What the device tells about itself."""
        ...

    def sample(self, now: float) -> Sample:
        """Read the sensors at device time ``now``, s. A sensor that fails gives NaN, no error."""
        ...


class Hal(Sensor, Protocol):
    """One ventilator: a pressure sensor and two valves.

    Both methods return within about 2 ms. When nobody calls them any more, the hardware itself
    should vent: a normally open expiratory and a normally closed inspiratory valve.
    """

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        """Set the inspiratory valve, %, 0..100, and the expiratory valve, 0 closed, 1 open."""
        ...


@dataclass(frozen=True, slots=True)
class DeviceState:
    """State between two steps."""

    own_limit: float  #: pressure above which it vents, whatever a host asks, cmH2O.
    pressure_limit: float  #: limit of the session, cmH2O.
    valid: int  #: when the last valid sample was taken, us.
    changed: int  #: when the reading last changed, us.
    stepped: int  #: time of the last step, us.
    #: the last valid pressures, oldest first, at most :data:`NOISE_WINDOW`, cmH2O.
    newest: tuple[float, ...] = ()
    kept: Kept = None  #: bytes of a frame that has not come whole.
    mode: Mode = Mode.CLOSED  #: what the device does with the valves.
    session: int | None = None  #: number of the open session, None before the first.
    sequence: int = 0  #: last sequence number of the session.
    u_in: float = 0.0  #: inspiratory valve, %.
    u_out: int = 1  #: expiratory valve, 0 or 1.
    fed: int = 0  #: when the last acceptable command or arming came, us.
    causes: Flag = Flag.NONE  #: why the device vented since it was last armed.
    counters: Counters = field(default_factory=Counters)  #: counts since the program started.


def init(own_limit: float, now: float) -> DeviceState:
    """Vented, no session, at ``now``, s; vents above a limit of its own, cmH2O."""
    begun = microseconds(now)
    return DeviceState(own_limit, own_limit, valid=begun, changed=begun, stepped=begun)


def step(
    identity: Identity,
    state: DeviceState,
    now: float,
    data: bytes,
    sample: Sample,
) -> tuple[DeviceState, bytes]:
    """Guard the lung, then do what arrived.

    The guards come first: a command that arrives after the watchdog's time is too late, however
    long the device itself was held up.

    Args:
        identity: what the device tells about itself.
        state: state from ``init`` or ``step``.
        now: time, s; never less than in the step before.
        data: bytes that arrived since, in order.
        sample: newest sample of the sensors.

    Returns:
        The next state, whose ``u_in`` and ``u_out`` the valves must take at once, and the bytes to
        send.
    """
    instant, watchdog = microseconds(now), microseconds(WATCHDOG)
    held_up = instant - state.stepped
    state = replace(_sampled(state, sample), stepped=instant)
    if state.mode is Mode.RUNNING:
        causes = _dangers(identity, state, sample)
        if instant - state.fed > watchdog:
            causes |= Flag.COMMANDS_STOPPED
            causes |= Flag.DEVICE_LATE if held_up > watchdog // 2 else Flag.NONE
        if causes:
            state = _vented(state, causes)
    answers: list[bytes] = []
    if data:
        kept, events = feed_bytes(state.kept, data)
        state = replace(state, kept=kept)
        for event in events:
            if isinstance(event, Fault):
                state = _counted(state, event.value)
                continue
            if isinstance(event.message, DeviceMessage):  # an echo, or crossed wires
                state = _counted(state, Fault.MALFORMED.value)
                continue
            state, answer = _received(
                identity, _counted(state, "frames"), event, event.message, sample
            )
            answers.append(encode(Packet(event.session, event.sequence, answer)))
    return state, b"".join(answers)


def _received(
    identity: Identity,
    state: DeviceState,
    packet: Packet,
    message: HostMessage,
    sample: Sample,
) -> tuple[DeviceState, DeviceMessage]:
    """Do what one message asks; the checks are in the order of PROTOCOL.md."""
    sequence = packet.sequence
    fresh = 0 < sequence - state.sequence <= SEQUENCE_WINDOW
    ours = packet.session == state.session
    answer: DeviceMessage | Reason
    if isinstance(message, Vent):  # from whomever, and whenever: it is always safe
        state = replace(state, sequence=sequence) if ours and fresh else state
        state = _vented(state, Flag.HOST_VENTED)
        answer = _reading(state, sample)
    elif isinstance(message, Hello):
        state, answer = _opened(identity, state, packet, message, fresh or not ours)
    elif not ours:
        state, answer = _counted(state, "session"), Reason.SESSION
    elif not fresh:
        state, answer = _counted(state, "sequence"), Reason.SEQUENCE
    else:
        state = replace(state, sequence=sequence)
        if isinstance(message, Statistics):
            return state, state.counters
        state, reason = _obeyed(identity, state, message, sample)
        answer = reason or _reading(state, sample)
    if isinstance(answer, Reason):
        return state, Refusal(answer, state.mode, _flags(state, sample))
    return state, answer


def _reading(state: DeviceState, sample: Sample) -> Reading:
    return Reading(
        sample.time,
        sample.pressure,
        sample.flow,
        state.u_in,
        state.u_out,
        state.mode,
        _flags(state, sample),
    )


def _opened(
    identity: Identity,
    state: DeviceState,
    packet: Packet,
    hello: Hello,
    acceptable: bool,
) -> tuple[DeviceState, Welcome | Reason]:
    """Open a session, vented, or say why not."""
    if hello.version != PROTOCOL_VERSION:
        return state, Reason.VERSION
    if not acceptable:
        return _counted(state, "sequence"), Reason.SEQUENCE
    asked = hello.pressure_limit
    limit = state.own_limit if asked is None else min(asked, state.own_limit)
    state = replace(
        _vented(state, Flag.NONE),
        mode=Mode.READY,
        session=packet.session,
        sequence=packet.sequence,
        pressure_limit=limit,
    )
    return state, Welcome(
        PROTOCOL_VERSION,
        FIRMWARE,
        identity.capabilities,
        WATCHDOG,
        limit,
        identity.device_id,
        identity.calibration,
        identity.name,
    )


def _obeyed(
    identity: Identity, state: DeviceState, message: HostMessage, sample: Sample
) -> tuple[DeviceState, Reason | None]:
    """Arm or command, or say why not; a heartbeat changes nothing."""
    if isinstance(message, Arm):
        if state.pressure_limit >= identity.highest:
            return state, Reason.SENSOR_RANGE
        if causes := _dangers(identity, state, sample):
            return _vented(state, causes), Reason.UNSAFE
        return replace(
            state, mode=Mode.RUNNING, fed=state.stepped, u_in=0.0, u_out=1, causes=Flag.NONE
        ), None
    if not isinstance(message, Command):
        return state, None
    if message.u_in > protocol.U_MAX or message.u_out not in (0, 1):
        return _counted(_vented(state, Flag.OUT_OF_RANGE), "out_of_range"), Reason.OUT_OF_RANGE
    if state.mode is not Mode.RUNNING:
        return _counted(state, "not_armed"), Reason.NOT_ARMED
    age = (state.stepped // 1000 - message.seen) & 0xFFFFFFFF
    if age > OLDEST_SEEN * 1000.0:  # also a time ahead of the device's own
        return _counted(state, "stale"), Reason.STALE
    return replace(
        _counted(state, "commands"), u_in=message.u_in, u_out=message.u_out, fed=state.stepped
    ), None


def _sampled(state: DeviceState, sample: Sample) -> DeviceState:
    """Remember a sample, if it is valid and new."""
    taken = microseconds(sample.time)
    if sample.pressure != sample.pressure or taken <= state.valid:
        return state
    same = bool(state.newest) and sample.pressure == state.newest[-1]
    return replace(
        state,
        valid=taken,
        changed=state.changed if same else taken,
        newest=(*state.newest[1 - NOISE_WINDOW :], sample.pressure),
    )


def _dangers(identity: Identity, state: DeviceState, sample: Sample) -> Flag:
    """Causes of venting that the sensor gives."""
    causes = Flag.NONE
    if sample.pressure > state.pressure_limit or sample.saturated:
        causes |= Flag.OVERPRESSURE
    if sample.lapsed:
        causes |= Flag.DEVICE_LATE
    if state.stepped - state.valid > microseconds(SENSOR_TIMEOUT):
        causes |= Flag.SENSOR_LOST
    if identity.noisy and state.valid - state.changed > microseconds(STUCK):
        causes |= Flag.SENSOR_STUCK
    if len(state.newest) == NOISE_WINDOW and _noise(state.newest) > LARGEST_NOISE:
        causes |= Flag.SENSOR_NOISY
    return causes


def _noise(pressures: tuple[float, ...]) -> float:
    """Standard deviation of white noise, cmH2O.

    Second differences leave out what the lung does, and their median the jumps at commands.
    """
    triples = zip(pressures, pressures[1:], pressures[2:], strict=False)
    return _PER_SECOND_DIFFERENCE * statistics.median(abs(a - 2.0 * b + c) for a, b, c in triples)


_COUNTED = {
    Flag.COMMANDS_STOPPED: "watchdog",
    Flag.OVERPRESSURE: "overpressure",
    Flag.SENSOR_LOST: "sensor",
    Flag.SENSOR_STUCK: "sensor",
    Flag.SENSOR_NOISY: "sensor",
    Flag.DEVICE_LATE: "device_late",
}


def _vented(state: DeviceState, causes: Flag) -> DeviceState:
    """Close the inspiratory valve and open the expiratory valve; remember why."""
    if state.mode is Mode.RUNNING:
        for cause, name in _COUNTED.items():
            if cause in causes:
                state = _counted(state, name)
    mode = Mode.CLOSED if state.mode is Mode.CLOSED else Mode.VENTED
    return replace(state, mode=mode, u_in=0.0, u_out=1, causes=state.causes | causes)


def _counted(state: DeviceState, name: str) -> DeviceState:
    count = getattr(state.counters, name) + 1
    return replace(state, counters=replace(state.counters, **{name: count}))


def _flags(state: DeviceState, sample: Sample) -> Flag:
    return (state.causes & CAUSES) | (Flag.SATURATED if sample.saturated else Flag.NONE)


class DeviceService:
    """Steps the program, reads the sensors and sets the valves.

    Attributes:
        hal: the hardware.
        state: state of the program.
    """

    def __init__(self, hal: Hal, now: float, own_limit: float = protocol.SAFETY_PRESSURE) -> None:
        """Start vented, at ``now``, s; it vents above a limit of its own, cmH2O."""
        self.hal = hal
        self.state: DeviceState = init(own_limit, now)
        hal.actuate(now, self.state.u_in, self.state.u_out)

    def step(self, now: float, data: bytes = b"") -> bytes:
        """Guard the lung and do what arrived.

        Args:
            now: time, s.
            data: bytes that arrived.

        Returns:
            Bytes to send.
        """
        sample = self.hal.sample(now)
        self.state, answers = step(self.hal.identity, self.state, now, data, sample)
        self.hal.actuate(now, self.state.u_in, self.state.u_out)
        return answers

    def vent(self, now: float) -> None:
        """Vent whatever the program says; for the end of the process."""
        self.hal.actuate(now, 0.0, 1)
