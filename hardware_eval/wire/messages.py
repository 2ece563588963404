"""Messages of the wire protocol: types, units, scaling, and their coding to frames and back.

Pure, and the same on host and device. A *packet* is kind, session, sequence number, body and
CRC-32; a *frame* is a packet in COBS between zero bytes. ``PROTOCOL.md`` has the layouts.

The parser finds the frames, and decodes what lies between two zero bytes. Whatever comes, it holds
at most one frame's bytes, and any zero byte brings it back in step, so that the next intact frame
is always read.
"""

from __future__ import annotations

import math
import struct
from binascii import crc32
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import Enum, IntEnum, IntFlag
from typing import Any

from cobs import cobs

#: Version of the wire protocol; host and device must have the same.
PROTOCOL_VERSION = 1

#: Longest packet, bytes: COBS then adds one byte of overhead, and a parser needs no more memory.
LONGEST_PACKET = 254

#: Units of the wire: steps in 1 % of u_in, in 1 cmH2O, in 1 mL/s and in 1 s of the watchdog.
U_IN_STEPS, PRESSURE_STEPS, FLOW_STEPS, WATCHDOG_STEPS = 100, 100, 1, 1000

_HEADER = struct.Struct("<BII")  # kind, session, sequence
_CRC = struct.Struct("<I")
_NO_VALUE = -32768  # a pressure or flow that is not known
_OWN_LIMIT = 0xFFFF  # a host that asks for no lower pressure limit
_NAME_BYTES = 32


class Mode(IntEnum):
    """What the device does with the valves."""

    #: No session since the device started: vented.
    CLOSED = 0
    #: A session is open, and no run: vented.
    READY = 1
    #: Commands move the valves and feed the watchdog.
    RUNNING = 2
    #: Vented by a fault or by the host until the host arms again.
    VENTED = 3


class Flag(IntFlag):
    """Why the device vented, and what it measures; the causes stay until the host arms again."""

    NONE = 0
    #: No acceptable command arrived within the watchdog's time.
    COMMANDS_STOPPED = 1
    #: A command was outside the valves' range.
    OUT_OF_RANGE = 2
    #: The pressure exceeded the limit of the device or of the session.
    OVERPRESSURE = 4
    #: The sensor gave no valid pressure for too long.
    SENSOR_LOST = 8
    #: The host asked for it.
    HOST_VENTED = 16
    #: The device's own loop ran too late to guard the lung.
    DEVICE_LATE = 32
    #: The pressure of this reading is at the end of the sensor's range.
    SATURATED = 64
    #: The reading did not move for too long, though the sensor's noise should move it.
    SENSOR_STUCK = 128
    #: The readings scatter too much to be a pressure.
    SENSOR_NOISY = 256


#: Flags that name a cause of venting: all but that of the reading's range.
CAUSES = Flag(sum(Flag)) ^ Flag.SATURATED


class Reason(IntEnum):
    """Why the device refuses a message."""

    #: Another protocol version.
    VERSION = 1
    #: The message belongs to another session.
    SESSION = 2
    #: The sequence number is not above that of the last message, or too far above it.
    SEQUENCE = 3
    #: A command while the device is not armed.
    NOT_ARMED = 4
    #: The command rests on a reading that is too old.
    STALE = 5
    #: A value outside its range; the device vents.
    OUT_OF_RANGE = 6
    #: The device cannot be armed while a cause of venting lasts.
    UNSAFE = 7
    #: The session's pressure limit lies outside the sensor's range, where nothing could trip it.
    SENSOR_RANGE = 8


class Capability(IntFlag):
    """What a device is and has."""

    NONE = 0
    #: No hardware: a simulated lung.
    SIMULATED = 1
    #: Readings hold a flow.
    FLOW = 2


@dataclass(frozen=True, slots=True)
class Hello:
    """Open a session; the device vents and answers with :class:`Welcome`."""

    version: int = PROTOCOL_VERSION  #: protocol version of the host.
    #: pressure at which the device shall vent, cmH2O, if that is below its own limit; None for the
    #: device's own.
    pressure_limit: float | None = None


@dataclass(frozen=True, slots=True)
class Arm:
    """Clear the causes of venting and begin a run; the watchdog starts at once."""


@dataclass(frozen=True, slots=True)
class Command:
    """Set the valves."""

    u_in: float  #: inspiratory valve, %, 0..100.
    u_out: int  #: expiratory valve, 0 closed, 1 open.
    #: device time of the newest reading that the host had, ms, modulo 2**32. The device refuses the
    #: command when that is too long ago, so that nothing that waited in a buffer moves a valve.
    seen: int


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Ask for a reading; moves no valve and does not feed the watchdog."""


@dataclass(frozen=True, slots=True)
class Vent:
    """Vent now, until the host arms again."""


@dataclass(frozen=True, slots=True)
class Statistics:
    """Ask for the device's error counters."""


@dataclass(frozen=True, slots=True)
class Welcome:
    """Identity and limits of a device."""

    version: int  #: protocol version of the device.
    firmware: tuple[int, int, int]  #: version of the device's program, (major, minor, patch).
    capabilities: Capability  #: what the device is and has.
    watchdog: float  #: time without an acceptable command after which the device vents, s.
    pressure_limit: float  #: pressure above which the device vents in this session, cmH2O.
    device_id: bytes  #: the device's own number, 8 bytes.
    calibration: bytes  #: SHA-256 of the device's calibration (sensor and valve tables), 32 bytes.
    name: str  #: what people call the device, at most 32 bytes of UTF-8.

    @property
    def device(self) -> dict[str, str]:
        """Which device it is, wired and calibrated as it is; hexadecimal, as in files."""
        return {"device_id": self.device_id.hex(), "calibration": self.calibration.hex()}


@dataclass(frozen=True, slots=True)
class Reading:
    """State of the device; the answer to arm, command, heartbeat and vent."""

    time: float  #: time of the sample on the device's clock, s.
    pressure: float  #: airway pressure, cmH2O; NaN if the sensor gives none.
    flow: float  #: flow into the lung, mL/s; NaN if the device does not measure it.
    u_in: float  #: inspiratory valve as applied, %.
    u_out: int  #: expiratory valve as applied, 0 or 1.
    mode: Mode  #: what the device does with the valves.
    flags: Flag  #: why it vented, and remarks on the sample.


@dataclass(frozen=True, slots=True)
class Refusal:
    """The device did not do what a message asks."""

    reason: Reason  #: why.
    mode: Mode  #: what the device does with the valves.
    flags: Flag  #: as in :class:`Reading`.


@dataclass(frozen=True, slots=True)
class Counters:
    """Counts of the device since it started, each modulo 2**32."""

    frames: int = 0  #: intact packets.
    commands: int = 0  #: commands that moved the valves.
    framing: int = 0  #: runs of bytes that are no frame: bad COBS, too long.
    checksum: int = 0  #: packets with a wrong CRC, or too short to hold one.
    malformed: int = 0  #: intact packets of a kind that no host sends, or of wrong length.
    session: int = 0  #: messages of another session.
    sequence: int = 0  #: messages whose sequence number was not above the last.
    stale: int = 0  #: commands that rest on a reading too old.
    out_of_range: int = 0  #: commands outside the valves' range.
    not_armed: int = 0  #: commands while the device was not armed.
    watchdog: int = 0  #: times that the watchdog vented.
    overpressure: int = 0  #: times that the pressure limit vented.
    sensor: int = 0  #: times that the loss of the sensor vented.
    device_late: int = 0  #: times that the device's own lateness vented.


HostMessage = Hello | Arm | Command | Heartbeat | Vent | Statistics
DeviceMessage = Welcome | Reading | Refusal | Counters
Message = HostMessage | DeviceMessage


@dataclass(frozen=True, slots=True)
class Packet:
    """A message with its header."""

    session: int  #: number that the host drew at random for this session.
    sequence: int  #: from the host: its own count; from the device: the count that it answers.
    message: Message  #: the message.


def microseconds(time: float) -> int:
    """Device time, s, as :attr:`Reading.time` goes over the wire."""
    return round(time * 1e6)


def milliseconds(time: float) -> int:
    """Device time, s, as :attr:`Command.seen` holds it.

    By way of the microseconds of a reading, so that no rounding makes a reading newer than now.
    """
    return microseconds(time) // 1000 & 0xFFFFFFFF


def _scaled(value: float, steps: int, high: int = 65535) -> int:
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be sent")
    number = round(value * steps)
    if not 0 <= number <= high:
        raise ValueError(f"{value:g} is outside 0..{high / steps:g}")
    return number


def fixed_point(value: float, steps: int) -> int:
    """A pressure or flow as an i16 in units of the wire, steps to its unit; for NaN, not known."""
    if not math.isfinite(value):
        return _NO_VALUE
    return max(-32767, min(32767, round(value * steps)))


#: One value on the wire: its code in :mod:`struct`, and what it is there and here.
_Coded = tuple[str, Callable[[Any], Any], Callable[[Any], Any]]


def _unsigned(steps: int) -> _Coded:
    return "H", lambda value: _scaled(value, steps), lambda number: number / steps


def _signed(steps: int) -> _Coded:
    def value(number: int) -> float:
        return math.nan if number == _NO_VALUE else number / steps

    return "h", lambda value: fixed_point(value, steps), value


def _asked_limit(value: float | None) -> int:
    return _OWN_LIMIT if value is None else _scaled(value, PRESSURE_STEPS, _OWN_LIMIT - 1)


def _limit(number: int) -> float | None:
    return None if number == _OWN_LIMIT else number / PRESSURE_STEPS


_U_IN, _U8 = _unsigned(U_IN_STEPS), ("B", int, int)
_U32: _Coded = "I", lambda value: value & 0xFFFFFFFF, int
_MODE, _FLAGS = ("B", int, Mode), ("H", int, Flag)

#: Values of each message in the order of its fields; a welcome ends with the length of its name.
_LAYOUTS: dict[type[Message], tuple[_Coded, ...]] = {
    Hello: (_U8, ("H", _asked_limit, _limit)),
    Arm: (),
    Command: (_U_IN, _U8, _U32),
    Heartbeat: (),
    Vent: (),
    Statistics: (),
    Welcome: (
        _U8,
        ("3s", bytes, tuple),
        ("H", int, Capability),
        _unsigned(WATCHDOG_STEPS),
        _unsigned(PRESSURE_STEPS),
        ("8s", bytes, bytes),
        ("32s", bytes, bytes),
        ("B", len, int),
    ),
    Reading: (
        ("Q", microseconds, lambda number: number / 1e6),
        _signed(PRESSURE_STEPS),
        _signed(FLOW_STEPS),
        _U_IN,
        _U8,
        _MODE,
        _FLAGS,
    ),
    Refusal: (("B", int, Reason), _MODE, _FLAGS),
    Counters: (_U32,) * len(fields(Counters)),
}

#: Messages by the kind of their packet; the device's have the highest bit set.
KINDS: dict[int, type[Message]] = {
    0x01: Hello,
    0x02: Arm,
    0x03: Command,
    0x04: Heartbeat,
    0x05: Vent,
    0x06: Statistics,
    0x81: Welcome,
    0x82: Reading,
    0x83: Refusal,
    0x84: Counters,
}
_KIND_OF = {message: kind for kind, message in KINDS.items()}


def encode(packet: Packet) -> bytes:
    """Return the frame of a packet, ready for the wire.

    Raises:
        ValueError: if a value cannot be expressed, such as a command that is not a number.
    """
    return to_frame(to_packet(packet))


def to_frame(packet: bytes) -> bytes:
    """Return a packet in COBS between zero bytes.

    The zero byte in front ends whatever garbage came before, so that it costs no frame.
    """
    return b"\0" + cobs.encode(packet) + b"\0"


def to_packet(packet: Packet) -> bytes:
    """Return header, body and CRC-32 of a packet; see :func:`encode`."""
    kind = _KIND_OF[type(packet.message)]
    return with_crc(_HEADER.pack(kind, packet.session, packet.sequence) + _body(packet.message))


def with_crc(content: bytes) -> bytes:
    """Return a packet's content with its CRC-32 behind it."""
    return content + _CRC.pack(crc32(content))


def decode(content: bytes) -> Packet:
    """Decode header and body of an intact packet.

    Raises:
        KeyError: if the kind is unknown.
        ValueError: if a value is not of its type.
        struct.error: if the length is wrong.
    """
    number, session, sequence = _HEADER.unpack_from(content)
    return Packet(session, sequence, _message(KINDS[number], content[_HEADER.size :]))


def _struct(layout: tuple[_Coded, ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(code for code, _, _ in layout))


def _body(message: Message) -> bytes:
    layout, name = _LAYOUTS[type(message)], b""
    values = [getattr(message, field.name) for field in fields(message)]
    if isinstance(message, Welcome):
        values[-1] = name = message.name.encode()[:_NAME_BYTES]
    numbers = (there(value) for (_, there, _), value in zip(layout, values, strict=True))
    return _struct(layout).pack(*numbers) + name


def _message(message: type[Message], body: bytes) -> Message:
    layout = _LAYOUTS[message]
    packed = _struct(layout)
    numbers = packed.unpack_from(body)
    values = [here(number) for (_, _, here), number in zip(layout, numbers, strict=True)]
    name, announced = body[packed.size :], values.pop() if message is Welcome else 0
    if len(name) != announced:
        raise ValueError(f"{len(name)} bytes behind its values, announced were {announced}")
    return message(*values, *[name.decode()] * (message is Welcome))


#: Longest frame without its zero bytes: COBS adds one byte to a packet of at most 254.
LONGEST_FRAME = LONGEST_PACKET + 1


class Fault(Enum):
    """What was wrong with the bytes between two zero bytes."""

    #: No frame: too long, too short, or no COBS.
    FRAMING = "framing"
    #: The CRC-32 differs.
    CHECKSUM = "checksum"
    #: Intact, but of unknown kind or wrong length.
    MALFORMED = "malformed"


#: Bytes of the frame so far; None before the first zero byte, or in a frame that became too long,
#: until a zero byte comes.
Kept = bytes | None


Event = Packet | Fault


def feed_bytes(kept: Kept, data: bytes) -> tuple[Kept, list[Event]]:
    """Take bytes; returns what is kept of the frame that has begun, and all events in order."""
    events: list[Event] = []
    for place, piece in enumerate(data.split(b"\0")):
        if place:  # a zero byte came before it
            if kept:
                events.append(_finished(kept))
            kept = b""
        if kept is not None:
            kept += piece
            if len(kept) > LONGEST_FRAME:
                events.append(Fault.FRAMING)
                kept = None
    return kept, events


def content_of(frame: bytes) -> bytes | Fault:
    """What the bytes between two zero bytes hold but their CRC-32, or what is wrong with them."""
    try:
        packet = cobs.decode(frame)
    except cobs.DecodeError:
        return Fault.FRAMING
    content, check = packet[: -_CRC.size], packet[-_CRC.size :]
    intact = len(packet) >= _HEADER.size + _CRC.size and _CRC.unpack(check)[0] == crc32(content)
    return content if intact else Fault.CHECKSUM


def _finished(frame: bytes) -> Event:
    content = content_of(frame)
    if isinstance(content, Fault):
        return content
    try:
        return decode(content)
    except (struct.error, KeyError, ValueError):
        return Fault.MALFORMED
