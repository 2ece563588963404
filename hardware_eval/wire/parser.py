"""Parser of the wire: bytes in, events out. Pure, and the same on host and device.

It finds the frames, and decodes what lies between two zero bytes. Whatever comes, it holds at most
one frame's bytes, and any zero byte brings it back in step, so that the next intact frame is always
read.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from cobs import cobs

from hardware_eval.wire.messages import (
    LONGEST_PACKET,
    MalformedPacketError,
    Packet,
    Refusal,
    checked,
    decode,
)
from ventbench.base.errors import InputError


class LinkError(InputError):
    """The base of all errors of the link."""


class PortMissingError(LinkError):
    """There is no such port."""


class PortBusyError(LinkError):
    """Another program has the port."""


class PortForbiddenError(LinkError):
    """The user may not open the port."""


class DisconnectedError(LinkError):
    """The port went away while it was open; the device vents by itself."""


class NoAnswerError(LinkError):
    """The device did not answer in time."""


class RefusedError(LinkError):
    """The device refused a message.

    Attributes:
        refusal: its answer.
    """

    def __init__(self, message: str, refusal: Refusal) -> None:
        """Keep the device's answer."""
        super().__init__(message)
        self.refusal = refusal


#: Longest frame without its zero bytes: COBS adds one byte to a packet of at most 254.
LONGEST_FRAME = LONGEST_PACKET + 1


class ParserMode(Enum):
    """Place in the stream."""

    #: Before the first zero byte, or in a frame that became too long: waits for a zero byte.
    HUNTING = "hunting"
    #: After a zero byte.
    BETWEEN = "between"
    #: Inside a frame.
    INSIDE = "inside"


class Fault(Enum):
    """What was wrong with the bytes between two zero bytes."""

    #: No frame: too long, too short, or no COBS.
    FRAMING = "framing"
    #: The CRC-32 differs.
    CHECKSUM = "checksum"
    #: Intact, but of unknown kind or wrong length.
    MALFORMED = "malformed"


class ParserState(NamedTuple):
    """Place in the stream and the bytes of the frame so far."""

    mode: ParserMode = ParserMode.HUNTING
    kept: bytes = b""


Event = Packet | Fault


def feed(state: ParserState, byte: int) -> tuple[ParserState, Event | None]:
    """Take one byte, 0..255; returns the next state, and the event that it completes, if any."""
    if byte == 0:
        ended = _finished(state.kept) if state.mode is ParserMode.INSIDE else None
        return ParserState(ParserMode.BETWEEN), ended
    if state.mode is ParserMode.HUNTING:
        return state, None
    if len(state.kept) >= LONGEST_FRAME:
        return ParserState(ParserMode.HUNTING), Fault.FRAMING
    return ParserState(ParserMode.INSIDE, state.kept + bytes((byte,))), None


def feed_bytes(state: ParserState, data: bytes) -> tuple[ParserState, list[Event]]:
    """Take bytes one by one; returns the next state and all events in order."""
    events: list[Event] = []
    for byte in data:
        state, event = feed(state, byte)
        if event is not None:
            events.append(event)
    return state, events


def _finished(frame: bytes) -> Event:
    try:
        packet = cobs.decode(frame)
    except cobs.DecodeError:
        return Fault.FRAMING
    content = checked(packet)
    if content is None:
        return Fault.CHECKSUM
    try:
        return decode(content)
    except MalformedPacketError:
        return Fault.MALFORMED
