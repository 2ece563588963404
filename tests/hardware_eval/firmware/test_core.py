"""The firmware's core and the Python device answer alike, whatever comes."""

from __future__ import annotations

import math
from binascii import crc32
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from hardware_eval.device import program
from hardware_eval.device.program import Identity, Sample
from hardware_eval.wire.client import Client
from hardware_eval.wire.messages import (
    Arm,
    Capability,
    Command,
    Flag,
    Heartbeat,
    Hello,
    HostMessage,
    Mode,
    Packet,
    Reading,
    Refusal,
    Statistics,
    Vent,
    encode,
    to_frame,
    to_packet,
)
from tests.hardware_eval.firmware.core import Core, hundredths, loopback
from tests.hardware_eval.stand_in import Bench

IDENTITY = Identity("fuzzed", b"87654321", bytes(range(32)), Capability.FLOW, 50.8, noisy=True)
SETTINGS = 50.0

#: Times between two steps, us: each limit, and a microsecond beyond it.
PAUSES = (0, 1, 999, 5000, 20_000, 30_000, 40_000, 40_001, 50_000, 50_001, 80_000, 80_001, 250_001)


class Stimuli:
    """Times, samples and frames at random, most of which a device in this state takes."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)
        self.now = 0
        self.pressure, self.spread = 1000, 0
        self.older: list[bytes] = [b"\0"]

    def next(self, state: program.DeviceState) -> tuple[int, Sample, bytes]:
        """What comes next."""
        random = self.random
        # Mostly a host that keeps pace, so that runs last; every limit is met exactly as well.
        self.now += 5000 if random.random() < 0.7 else random.choice(PAUSES)
        return self.now, self._sample(state), self._damaged(self._packet(state))

    def _sample(self, state: program.DeviceState) -> Sample:
        random = self.random
        if random.random() < 0.02:
            limit = hundredths(state.pressure_limit)
            self.pressure = random.choice((1000, 1000, limit, limit + 1, -2000, 5080))
            self.spread = random.choice((0, 0, 1, 20, 100, 230))
        pressure = round(random.gauss(self.pressure, self.spread)) / 100
        if random.random() < 0.02:
            pressure = math.nan
        taken = self.now - random.choice((0, 0, 0, 400, 51_000)) * (random.random() < 0.1)
        return Sample(
            max(taken, 0) / 1e6,
            pressure,
            random.choice((math.nan, -40.0, 1200.0)),
            saturated=random.random() < 0.003,
            lapsed=random.random() < 0.003,
        )

    def _packet(self, state: program.DeviceState) -> Packet:
        random = self.random
        session = state.session if state.session is not None else 7
        if random.random() < 0.03:
            session = random.getrandbits(32)
        step = 1 if random.random() < 0.95 else random.choice((0, -1, 2, 65_536, 65_537, -65_535))
        sequence = (state.sequence + step) & 0xFFFFFFFF
        return Packet(session, sequence, self._message(state))

    def _message(self, state: program.DeviceState) -> HostMessage | Reading | Refusal:
        random = self.random
        if state.mode is Mode.CLOSED or random.random() < 0.01:
            version = 1 if random.random() < 0.9 else random.randrange(256)
            limit = random.choice((None, 0.0, 12.5, 30.0, 50.0, 50.79, 655.34))
            return Hello(version, limit)
        if state.mode is not Mode.RUNNING and random.random() < 0.8:
            return Arm()
        seen = self.now // 1000 - random.choice((0, 0, 0, 5, 100, 101, -1))
        u_in = random.randrange(10_001) if random.random() < 0.98 else random.randrange(65_536)
        u_out = random.randrange(2) if random.random() < 0.98 else random.randrange(256)
        return random.choices(
            (
                Command(u_in / 100, u_out, seen & 0xFFFFFFFF),
                Heartbeat(),
                Statistics(),
                Vent(),
                Arm(),
                Reading(0.0, 5.0, 1.0, 2.0, 1, Mode.READY, Flag.NONE),
            ),
            (30, 5, 2, 1, 1, 1),
        )[0]

    def _damaged(self, packet: Packet) -> bytes:
        random, frame = self.random, encode(packet)
        old = random.choice(self.older)
        self.older = [*self.older[-50:], frame]
        cut = random.randrange(len(frame))
        damage = random.choices(range(len(DAMAGES)), [share for _, share in DAMAGES])[0]
        return DAMAGES[damage][0](random, packet, frame, old, cut)


def _flipped(frame: bytes, bit: int) -> bytes:
    return bytes(byte ^ (1 << bit % 8 if k == bit // 8 else 0) for k, byte in enumerate(frame))


def _odd(random: Random, packet: Packet) -> bytes:
    """An intact packet of wrong length or unknown kind."""
    content = to_packet(packet)[:-4]
    odd = random.choice((content[:-1], content + random.randbytes(3), b"\x42" + content[1:]))
    return to_frame(odd + crc32(odd).to_bytes(4, "little"))


#: What arrives instead of a frame, from the random numbers, the packet, its frame, an older one and
#: a place in it; and how often.
DAMAGES: tuple[tuple[Callable[[Random, Packet, bytes, bytes, int], bytes], int], ...] = (
    (lambda random, packet, frame, old, cut: frame, 60),
    (lambda random, packet, frame, old, cut: b"", 8),
    (lambda random, packet, frame, old, cut: frame + frame, 2),
    (lambda random, packet, frame, old, cut: frame + old, 2),
    (lambda random, packet, frame, old, cut: _flipped(frame, 8 * cut + random.randrange(8)), 4),
    (lambda random, packet, frame, old, cut: frame[:cut], 2),
    (lambda random, packet, frame, old, cut: frame[cut:], 2),
    (lambda random, packet, frame, old, cut: random.randbytes(random.randrange(600)) + frame, 1),
    (
        lambda random, packet, frame, old, cut: (
            b"\0" + bytes([random.randrange(1, 256)]) * random.randrange(250, 260) + frame
        ),
        1,
    ),
    (lambda random, packet, frame, old, cut: _odd(random, packet), 2),
    (lambda random, packet, frame, old, cut: to_frame(random.randbytes(254)), 1),
    (lambda random, packet, frame, old, cut: frame[:-1] + frame[1:], 1),
)


@pytest.mark.parametrize(
    "frames",
    [10_000, pytest.param(100_000, marks=pytest.mark.slow)],
    ids=["some", "a hundred thousand"],
)
def test_both_devices_answer_alike(harness: Path, frames: int) -> None:
    state, core = program.init(SETTINGS, 0.0), Core(harness, IDENTITY, limit=50.0)
    stimuli, batch = Stimuli(frames), 1000
    seen: dict[str, int] = {}
    for begin in range(0, frames, batch):
        steps, expected = [], []
        for _ in range(batch):
            now, sample, data = step = stimuli.next(state)
            state, answers = program.step(IDENTITY, state, now / 1e6, data, sample)
            steps.append(step)
            expected.append(
                (answers, state.mode, state.u_out, round(100 * state.u_in), state.causes)
            )
            seen[state.mode.name] = seen.get(state.mode.name, 0) + 1
        replies = core.steps(steps)
        for k, (reply, wanted) in enumerate(zip(replies, expected, strict=True)):
            assert reply == wanted, f"step {begin + k} of {frames}: {steps[k]}"
    core.end()
    counters = {name: getattr(state.counters, name) for name in state.counters.__slots__}
    assert min(counters.values()) > frames // 10_000, counters  # it has met everything
    assert seen["RUNNING"] > frames // 5, seen


@pytest.mark.parametrize("silent", [0.0, 0.0013, 0.0049])
def test_the_core_vents_a_silent_host(harness: Path, silent: float) -> None:
    bench = Bench()
    with loopback(harness, bench) as device:
        client = Client(device, device.clock)
        client.hello()
        device.clock.advance(silent)
        client.arm()
        for _ in range(3):
            client.heartbeat()
            assert client.command(12.34, 0).u_in == 12.34
            device.clock.advance(0.028)
        sent = device.clock.now() - 0.028 - device.latency
        last = max(time for time, u_in, _ in bench.valves if u_in > 0.0)
        device.clock.advance(0.2)
        vented = min(time for time, u_in, u_out in bench.valves if time > last and u_out == 1)
        assert 0.05 < vented - sent <= 0.1
        assert Flag.COMMANDS_STOPPED in client.heartbeat().flags
