"""Frames and messages: whatever a line does to bytes, nothing wrong is accepted, nothing hangs."""

from __future__ import annotations

import math
import struct
from binascii import crc32
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_eval.wire import messages
from hardware_eval.wire.messages import (
    KINDS,
    LONGEST_FRAME,
    LONGEST_PACKET,
    Arm,
    Capability,
    Command,
    Counters,
    Event,
    Fault,
    Flag,
    Heartbeat,
    Hello,
    Mode,
    Packet,
    Reading,
    Reason,
    Refusal,
    Statistics,
    Vent,
    Welcome,
    decode,
    encode,
    feed_bytes,
    to_frame,
    to_packet,
)

#: Enough to find what a table forgets; the benchmark of hostile frames has the million.
QUICK = settings(max_examples=40)

u8, u16, u32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32))
percent = st.integers(0, 10_000).map(lambda n: n / 100)
pressure = st.integers(-32_767, 32_767).map(lambda n: n / 100)
modes, flags = st.sampled_from(Mode), st.integers(0, 127).map(Flag)


def _message() -> st.SearchStrategy:
    known_flow = st.integers(-32_767, 32_767).map(float)
    return st.one_of(
        st.builds(Hello, u8, st.none() | st.integers(0, 65_534).map(lambda n: n / 100)),
        st.sampled_from([Arm(), Heartbeat(), Vent(), Statistics()]),
        st.builds(Command, percent, u8, u32),
        st.builds(
            Welcome,
            u8,
            st.tuples(u8, u8, u8),
            st.integers(0, 3).map(Capability),
            u16.map(lambda n: n / 1000),
            u16.map(lambda n: n / 100),
            st.binary(min_size=8, max_size=8),
            st.binary(min_size=32, max_size=32),
            st.text("abc é", max_size=16),
        ),
        st.builds(
            Reading,
            st.integers(0, 10**12).map(lambda n: n / 1e6),
            pressure,
            known_flow,
            percent,
            u8,
            modes,
            flags,
        ),
        st.builds(Refusal, st.sampled_from(Reason), modes, flags),
        st.builds(Counters, *[u32] * 14),
    )


@st.composite
def packets(draw: st.DrawFn) -> Packet:
    return Packet(draw(u32), draw(u32), draw(_message()))


def _events(data: bytes) -> list[Event]:
    return feed_bytes(None, data)[1]


@QUICK
@given(packets())
def test_every_message_comes_back(packet: Packet) -> None:
    assert _events(encode(packet)) == [packet]


def test_an_unknown_pressure_stays_unknown() -> None:
    sent = Reading(0.5, math.nan, math.inf, 0.0, 1, Mode.RUNNING, Flag.NONE)
    (event,) = _events(encode(Packet(1, 1, sent)))
    assert isinstance(event, Packet)
    assert isinstance(event.message, Reading)
    assert math.isnan(event.message.pressure)
    assert math.isnan(event.message.flow)


@pytest.mark.parametrize("u_in", [math.nan, math.inf, -0.01, 656.0])
def test_what_is_no_command_cannot_be_sent(u_in: float) -> None:
    with pytest.raises(ValueError, match=r"cannot be sent|outside"):
        encode(Packet(1, 1, Command(u_in, 0, 0)))


def test_the_bytes_of_a_command_are_those_of_the_specification() -> None:
    content = struct.pack("<BIIHBI", 0x03, 0x01020304, 7, 1234, 1, 99)
    packet = content + struct.pack("<I", crc32(content))
    assert to_packet(Packet(0x01020304, 7, Command(12.34, 1, 99))) == packet
    # COBS by hand: each zero becomes the distance to the next one.
    coded, blocks = b"", packet.split(b"\0")
    for block in blocks:
        coded += bytes([len(block) + 1]) + block
    assert encode(Packet(0x01020304, 7, Command(12.34, 1, 99))) == b"\0" + coded + b"\0"


def test_the_bytes_of_a_devices_answers_are_those_of_the_specification() -> None:
    head = struct.pack("<II", 5, 6)
    welcome = Welcome(1, (1, 2, 3), Capability.FLOW, 0.08, 60.0, b"12345678", bytes(32), "x")
    body = struct.pack("<BBBBHHH8s32sB", 1, 1, 2, 3, 2, 80, 6000, b"12345678", bytes(32), 1) + b"x"
    assert decode(b"\x81" + head + body) == Packet(5, 6, welcome)
    reading = Reading(1.5, -0.25, 30.0, 12.34, 1, Mode.VENTED, Flag.SENSOR_NOISY)
    body = struct.pack("<QhhHBBH", 1_500_000, -25, 30, 1234, 1, 3, 256)
    assert decode(b"\x82" + head + body) == Packet(5, 6, reading)
    refusal = Refusal(Reason.STALE, Mode.RUNNING, Flag.SATURATED)
    assert decode(b"\x83" + head + struct.pack("<BBH", 5, 2, 64)) == Packet(5, 6, refusal)


def test_the_specification_names_every_number() -> None:
    text = (Path(messages.__file__).parents[1] / "PROTOCOL.md").read_text("utf-8")
    for kind, message in KINDS.items():
        assert f"| 0x{kind:02x} | {message.__name__.lower()} |" in text
    for reason in Reason:
        assert f"{reason.value} {reason.name.lower().replace('_', ' ')}" in text.replace(
            "protocol version", "version"
        )


@QUICK
@given(packets(), st.data())
def test_no_flipped_bit_is_accepted(packet: Packet, data: st.DataObject) -> None:
    """Up to three flipped bits: CRC-32 finds them all at this length."""
    frame = bytearray(encode(packet))
    for bit in data.draw(st.sets(st.integers(0, 8 * len(frame) - 1), min_size=1, max_size=3)):
        frame[bit // 8] ^= 1 << bit % 8
    assert all(event == packet or isinstance(event, Fault) for event in _events(bytes(frame)))


@QUICK
@given(packets(), st.data())
def test_no_truncated_frame_is_accepted_and_the_next_one_is(
    packet: Packet, data: st.DataObject
) -> None:
    frame = encode(packet)
    cut = frame[: data.draw(st.integers(0, len(frame) - 2))]
    events = _events(cut + frame)
    assert events[-1] == packet
    assert all(isinstance(event, Fault) for event in events[:-1])


@QUICK
@given(st.binary(max_size=600), packets(), st.binary(max_size=600), packets())
def test_after_any_garbage_the_next_frame_is_read(
    garbage: bytes, first: Packet, more: bytes, second: Packet
) -> None:
    events = _events(garbage + encode(first) + more + encode(second))
    read = [event for event in events if isinstance(event, Packet)]
    assert read == [first, second]


@QUICK
@given(st.lists(packets(), max_size=4), st.lists(st.integers(1, 40), max_size=60))
def test_how_bytes_are_cut_into_reads_does_not_matter(sent: list[Packet], sizes: list[int]) -> None:
    stream, kept, events = b"".join(map(encode, sent)), None, []
    for size in sizes:
        kept, more = feed_bytes(kept, stream[:size])
        events, stream = events + more, stream[size:]
    assert events + feed_bytes(kept, stream)[1] == sent


@QUICK
@given(st.binary(max_size=2000))
def test_the_parser_keeps_at_most_one_frame(garbage: bytes) -> None:
    kept, events = None, []
    for byte in garbage:
        kept, more = feed_bytes(kept, bytes([byte]))
        assert len(kept or b"") <= LONGEST_FRAME
        events += more
    assert (kept, events) == feed_bytes(None, garbage)


def test_a_frame_too_long_is_one_fault() -> None:
    assert _events(b"\0" + b"\1" * 3000 + b"\0") == [Fault.FRAMING]
    longest = bytes(LONGEST_PACKET - 4)
    sealed = longest + struct.pack("<I", crc32(longest))
    assert _events(to_frame(sealed)) == [Fault.MALFORMED]  # intact, but of no kind


@QUICK
@given(st.binary(max_size=80))
def test_an_intact_packet_of_wrong_form_is_malformed(content: bytes) -> None:
    sealed = content + struct.pack("<I", crc32(content))
    (event,) = _events(to_frame(sealed))
    if isinstance(event, Packet):
        assert decode(content) == event
        assert to_packet(event) == sealed  # then it is one of ours, in its only form
    elif len(content) >= 9:
        assert event is Fault.MALFORMED
    else:
        assert event is Fault.CHECKSUM


def test_a_reading_is_never_newer_than_now() -> None:
    """A command may rest on a reading that was taken at the moment at which it arrives."""
    for now in (0.0009999, 0.001, 12.3449996, 12.345):
        reading = Reading(now, 5.0, 0.0, 0.0, 1, Mode.RUNNING, Flag.NONE)
        (event,) = _events(encode(Packet(1, 1, reading)))
        assert isinstance(event, Packet)
        assert isinstance(event.message, Reading)
        assert messages.milliseconds(event.message.time) == messages.milliseconds(now)
