"""The frames, byte by byte."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ventbench.sandbox.child import wire
from ventbench.sandbox.child.cell import ROW
from ventbench.sandbox.child.wire import COMMAND, FAILED, READY, Reply, WireError

GOOD = b"VBr1" + struct.pack("<IHHd", 7, COMMAND, 0, 42.5)


def test_an_observation_is_128_bytes():
    row = np.arange(ROW, dtype="<f8")
    frame = wire.pack_observation(7, row.tobytes())
    assert frame == b"VBo1" + struct.pack("<I", 7) + struct.pack("<15d", *range(15))
    assert len(frame) == 128
    assert wire.unpack_observation(frame, 7) == tuple(map(float, range(15)))


@pytest.mark.parametrize("frame", [b"", b"VBo1", bytes(128), b"VBr1" + bytes(124), bytes(129)])
def test_other_observations_are_refused(frame):
    with pytest.raises(WireError):
        wire.unpack_observation(frame, 0)


def test_rows_of_another_size_are_refused():
    with pytest.raises(WireError, match="112 bytes, not 120"):
        wire.pack_observation(1, bytes(112))


def test_a_command_is_20_bytes():
    assert wire.pack_reply(7, COMMAND, 42.5) == GOOD
    assert len(GOOD) == 20
    assert wire.unpack_reply(GOOD, 7, (COMMAND,)) == Reply(COMMAND, 42.5, b"")


@pytest.mark.parametrize("size", range(20))
def test_a_part_is_waited_for(size):
    assert wire.unpack_reply(GOOD[:size], 7, (COMMAND,)) is None


@pytest.mark.parametrize("index", range(12))
def test_a_wrong_head_is_refused(index):
    data = bytearray(GOOD)
    data[index] ^= 0x80
    with pytest.raises(WireError):
        wire.unpack_reply(bytes(data), 7, (COMMAND,))
    if index < 4:  # the magic is decided on at once
        with pytest.raises(WireError):
            wire.unpack_reply(bytes(data[: index + 1]), 7, (COMMAND,))


@pytest.mark.parametrize("more", [b"\0", GOOD, GOOD[:5]])
def test_more_than_the_reply_is_refused(more):
    with pytest.raises(WireError, match=f"{len(more)} bytes came after the reply"):
        wire.unpack_reply(GOOD + more, 7, (COMMAND,))


@pytest.mark.parametrize("sequence", [0, 6, 8])
def test_early_and_repeated_replies_are_refused(sequence):
    with pytest.raises(WireError, match=f"observation 7 came, not to {sequence}"):
        wire.unpack_reply(GOOD, sequence, (COMMAND,))


def test_a_kind_that_is_not_due_is_refused():
    with pytest.raises(WireError, match="kind 2"):
        wire.unpack_reply(GOOD, 7, (READY,))


def test_a_failure_may_always_come_and_brings_text():
    data = wire.pack_reply(7, FAILED, 0.0, b"words")
    assert wire.unpack_reply(data, 7, (COMMAND,)) == Reply(FAILED, 0.0, b"words")
    assert wire.unpack_reply(data[:-1], 7, (COMMAND,)) is None
    assert len(wire.pack_reply(7, FAILED, 0.0, bytes(99_999))) == 20 + wire.TEXT_LIMIT


def test_endless_text_is_refused():
    data = b"VBr1" + struct.pack("<IHHd", 7, FAILED, 65535, 0.0)
    with pytest.raises(WireError, match="65535 bytes of text were announced"):
        wire.unpack_reply(data, 7, (COMMAND,))


@given(st.binary(max_size=64))
def test_noise_is_never_a_reply(data):
    try:
        found = wire.unpack_reply(data, 7, (COMMAND,))
    except WireError:
        return
    assert found is None or data.startswith(b"VBr1\x07\0\0\0")


@given(st.floats())
def test_floats_cross_to_the_bit(value):
    found = wire.unpack_reply(wire.pack_reply(1, COMMAND, value), 1, (COMMAND,))
    assert found is not None
    assert struct.pack("d", found.value) == struct.pack("d", value) or math.isnan(value)
