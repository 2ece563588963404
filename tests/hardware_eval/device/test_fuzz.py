"""A hostile line: the valves do what was commanded, in order, or vent; nothing else, ever."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware_eval.device import program
from hardware_eval.device.program import Sample
from hardware_eval.wire.messages import (
    Arm,
    Command,
    Heartbeat,
    Hello,
    Mode,
    Packet,
    Vent,
    encode,
    milliseconds,
    to_frame,
    to_packet,
    with_crc,
)
from tests.hardware_eval.stand_in import Bench
from ventbench.task import protocol

SESSION = 0xC0FFEE
SETTINGS = protocol.SAFETY_PRESSURE
IDENTITY = Bench().identity

#: What happens to a frame: kind, and where.
damages = st.tuples(
    st.sampled_from(
        ["none"] * 6
        + ["drop", "twice", "again later", "flip", "cut", "lose a byte", "more bytes", "garbage"]
        + ["another session", "wrong check", "wrong length", "unknown kind"]
    ),
    st.integers(0, 10_000),
)


def _damaged(packet: Packet, damage: str, where: int) -> bytes:
    frame, content = encode(packet), to_packet(packet)[:-4]
    place = where % len(frame)
    if damage == "drop":
        return b""
    if damage == "twice":
        return frame + frame
    if damage == "flip":
        bit, flipped = where % (8 * len(frame)), bytearray(frame)
        flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped)
    if damage == "cut":
        return frame[:place]
    if damage == "lose a byte":
        return frame[:place] + frame[place + 1 :]
    if damage == "more bytes":
        return frame[:place] + bytes((where * k * 37) & 0xFF for k in range(3)) + frame[place:]
    if damage == "garbage":
        return bytes((where * k * 37) & 0xFF for k in range(where % 800)) + frame
    if damage == "another session":
        return encode(replace(packet, session=packet.session ^ 0x5A5A))
    if damage == "wrong check":
        return to_frame(content + where.to_bytes(4, "little"))
    if damage == "wrong length":
        return to_frame(with_crc(content + bytes(1 + where % 8)))
    if damage == "unknown kind":
        return to_frame(with_crc(bytes([7 + where % 0x79]) + content[1:]))
    return frame


steps_of_a_host = st.lists(
    st.tuples(st.integers(0, 10_000), st.integers(0, 1), damages), min_size=1, max_size=40
)


@settings(max_examples=40)
@given(steps_of_a_host)
def test_the_valves_take_sent_commands_only_and_in_order(
    steps: list[tuple[int, int, tuple[str, int]]],
) -> None:
    _obeys(steps)


@pytest.mark.slow
@settings(max_examples=1000, deadline=None)
@given(steps_of_a_host)
def test_the_valves_take_sent_commands_only_however_long_the_line_is_hostile(
    steps: list[tuple[int, int, tuple[str, int]]],
) -> None:
    _obeys(steps)


def _obeys(steps: list[tuple[int, int, tuple[str, int]]]) -> None:
    state = program.init(SETTINGS, 0.0)
    now, sequence = 0.0, 2
    sample = Sample(0.0, 5.0)
    opening = [Packet(SESSION, 1, Hello()), Packet(SESSION, 2, Arm())]
    state, _ = program.step(IDENTITY, state, now, b"".join(map(encode, opening)), sample)
    assert state.mode is Mode.RUNNING
    sent: list[tuple[float, int]] = []
    again: list[bytes] = []
    reached = -1
    for hundredths, u_out, (damage, where) in steps:
        now += 0.03
        sequence += 1
        sent.append((hundredths / 100, u_out))
        command = Command(*sent[-1], milliseconds(now))
        packet = Packet(SESSION, sequence, command)
        if damage == "again later":
            again.append(encode(packet))
        data = _damaged(packet, damage, where)
        if where % 3 == 0 and again:
            data += again[where % len(again)]  # an old frame turns up after newer ones
        state, answers = program.step(IDENTITY, state, now, data, Sample(now, 5.0))
        # What comes intact is answered: the zero before a frame ends whatever came before.
        assert answers or damage not in ("none", "twice", "garbage")
        valves = (state.u_in, state.u_out)
        if state.mode is not Mode.RUNNING:
            assert valves == (0.0, 1)
        elif valves != (0.0, 1) or reached >= 0:
            taken = state.sequence - 3
            assert taken >= reached
            assert valves == sent[taken]
            reached = taken
    # And back in step: the host arms again, and is heard at once.
    for message in (Vent(), Arm(), Heartbeat(), Command(7.0, 0, milliseconds(now))):
        sequence += 1
        data = encode(Packet(SESSION, sequence, message))
        state, answers = program.step(IDENTITY, state, now, data, Sample(now, 5.0))
        assert answers
    assert (state.mode, state.u_in, state.u_out) == (Mode.RUNNING, 7.0, 0)
