"""Parser of the wire: bytes in, events out. Pure, and the same on host and device.

A table of three states and three kinds of bytes finds the frames; what lies between two zero bytes
is then decoded. Whatever comes, the parser holds at most one frame's bytes, and any zero byte
brings it back in step, so that the next intact frame is always read.
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


class ByteClass(Enum):
    """What a byte is for the table."""

    ZERO = "zero"
    DATA = "data"
    #: A data byte beyond the longest frame.
    EXCESS = "excess"


class Fault(Enum):
    """What was wrong with the bytes between two zero bytes."""

    #: No frame: too long, too short, or no COBS.
    FRAMING = "framing"
    #: The CRC-32 differs.
    CHECKSUM = "checksum"
    #: Intact, but of unknown kind or wrong length.
    MALFORMED = "malformed"


class _Action(Enum):
    SKIP = "skip"
    KEEP = "keep"
    FINISH = "finish"
    DROP = "drop"


_TABLE: dict[tuple[ParserMode, ByteClass], tuple[ParserMode, _Action]] = {
    (ParserMode.HUNTING, ByteClass.ZERO): (ParserMode.BETWEEN, _Action.SKIP),
    (ParserMode.HUNTING, ByteClass.DATA): (ParserMode.HUNTING, _Action.SKIP),
    (ParserMode.HUNTING, ByteClass.EXCESS): (ParserMode.HUNTING, _Action.SKIP),
    (ParserMode.BETWEEN, ByteClass.ZERO): (ParserMode.BETWEEN, _Action.SKIP),
    (ParserMode.BETWEEN, ByteClass.DATA): (ParserMode.INSIDE, _Action.KEEP),
    (ParserMode.BETWEEN, ByteClass.EXCESS): (ParserMode.HUNTING, _Action.DROP),
    (ParserMode.INSIDE, ByteClass.ZERO): (ParserMode.BETWEEN, _Action.FINISH),
    (ParserMode.INSIDE, ByteClass.DATA): (ParserMode.INSIDE, _Action.KEEP),
    (ParserMode.INSIDE, ByteClass.EXCESS): (ParserMode.HUNTING, _Action.DROP),
}


class ParserState(NamedTuple):
    """Place in the stream and the bytes of the frame so far."""

    mode: ParserMode = ParserMode.HUNTING
    kept: bytes = b""


Event = Packet | Fault


def feed(state: ParserState, byte: int) -> tuple[ParserState, Event | None]:
    """Take one byte.

    Args:
        state: state from the byte before; ``ParserState()`` at first.
        byte: 0..255.

    Returns:
        The next state, and the event that this byte completes, if any.
    """
    if byte == 0:
        kind = ByteClass.ZERO
    else:
        kind = ByteClass.EXCESS if len(state.kept) >= LONGEST_FRAME else ByteClass.DATA
    mode, action = _TABLE[state.mode, kind]
    if action is _Action.KEEP:
        return ParserState(mode, state.kept + bytes((byte,))), None
    if action is _Action.FINISH:
        return ParserState(mode), _finished(state.kept)
    return ParserState(mode), Fault.FRAMING if action is _Action.DROP else None


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
