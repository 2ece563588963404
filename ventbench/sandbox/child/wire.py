"""The frames that cross the two pipes of a cell: pure functions between bytes and floats.

Scorer to cell, fixed size: ``magic, sequence, ROW x float64`` (an observation). Cell to scorer:
``magic, sequence, kind, size, float64`` and, for a failure only, ``size`` bytes of text. Numbers
are little-endian. The sequence number is that of the observation being answered, so that a
truncated, repeated, early or additional frame is seen.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

from .cell import ROW

#: First bytes of every frame to a cell, and of every frame from a cell.
OBSERVATION_MAGIC, REPLY_MAGIC = b"VBo1", b"VBr1"

OBSERVATION = struct.Struct(f"<4sI{ROW}d")
HEAD = struct.Struct("<4sI")
REPLY = struct.Struct("<4sIHHd")

#: What lets a cell go on once it has shown that it is locked down.
BEGIN = HEAD.pack(b"VBb1", 0)

#: Kinds of reply: locked down (the value holds the layers' bits); reset done; ``u_in``; a failure.
LOCKED, READY, COMMAND, FAILED = range(4)

#: Longest text of a failure, bytes.
TEXT_LIMIT = 4096


class WireError(ValueError):
    """Bytes that are not the frame that was due."""


class Reply(NamedTuple):
    """One frame from a cell."""

    kind: int  #: ``LOCKED``, ``READY``, ``COMMAND`` or ``FAILED``.
    value: float  #: ``u_in``, %, of a command; the layers' bits of ``LOCKED``.
    text: bytes  #: what a failure says.


def pack_observation(sequence: int, row: bytes) -> bytes:
    """Frame of one observation, ``ROW`` little-endian float64; they are counted from 1.

    Raises:
        WireError: if the row has another size.
    """
    if len(row) != OBSERVATION.size - HEAD.size:
        raise WireError(f"a row of {len(row)} bytes, not {OBSERVATION.size - HEAD.size}")
    return HEAD.pack(OBSERVATION_MAGIC, sequence) + row


def unpack_observation(frame: bytes, sequence: int) -> tuple[float, ...]:
    """The row of an observation's frame.

    Raises:
        WireError: unless it is the observation of this sequence number.
    """
    if len(frame) != OBSERVATION.size:
        raise WireError(f"an observation of {len(frame)} bytes, not {OBSERVATION.size}")
    magic, number, *row = OBSERVATION.unpack(frame)
    if magic != OBSERVATION_MAGIC or number != sequence:
        raise WireError(f"observation {number} with magic {magic!r}, not {sequence}")
    return tuple(row)


def pack_reply(sequence: int, kind: int, value: float = 0.0, text: bytes = b"") -> bytes:
    """Frame of a reply; text beyond ``TEXT_LIMIT`` bytes is cut."""
    text = text[:TEXT_LIMIT]
    return REPLY.pack(REPLY_MAGIC, sequence, kind, len(text), value) + text


def unpack_reply(data: bytes, sequence: int, due: Sequence[int]) -> Reply | None:
    """The one reply that is due of all data received since then; None while bytes are missing.

    It answers the observation of a number, and is of a kind that is due, or a failure.

    Raises:
        WireError: if the bytes cannot become that one reply and nothing else.
    """
    head = data[: REPLY.size]
    if head[:4] != REPLY_MAGIC[: len(head)]:
        raise WireError(f"the bytes {head[:4].hex()} came where a reply was due")
    if len(head) < REPLY.size:
        return None
    _, number, kind, size, value = REPLY.unpack(head)
    if number != sequence:
        raise WireError(f"a reply to observation {number} came, not to {sequence}")
    if kind != FAILED and (kind not in due or size):
        raise WireError(f"a reply of kind {kind} with {size} bytes of text came, not {due}")
    if size > TEXT_LIMIT:
        raise WireError(f"{size} bytes of text were announced, at most {TEXT_LIMIT} may come")
    if len(data) > REPLY.size + size:
        raise WireError(f"{len(data) - REPLY.size - size} bytes came after the reply")
    return Reply(kind, value, data[REPLY.size :]) if len(data) == REPLY.size + size else None
