"""A hostile line to the device: damaged, repeated, reordered, foreign and made-up frames.

Counts wrong actuations (valves in a position that no host commanded, or that an older command
asked for) and frames that were lost although they came intact.

Usage:

    python benchmarks/hardware_fuzz.py [--frames 1000000] [--seed 0]
"""

from __future__ import annotations

import time
from binascii import crc32
from collections import Counter

import numpy as np
import typer

from hardware_eval.device import program
from hardware_eval.device.program import Identity, Sample
from hardware_eval.wire.messages import (
    Arm,
    Capability,
    Command,
    Heartbeat,
    Hello,
    Mode,
    Packet,
    encode,
    milliseconds,
    to_frame,
    to_packet,
)

SETTINGS = program.DeviceSettings()
IDENTITY = Identity("fuzz", bytes(8), bytes(32), Capability.NONE)

#: What happens to a frame, and how often; "none" are the intact ones.
DAMAGES = (
    "none",
    "flip one bit",
    "flip many bits",
    "cut",
    "drop a byte",
    "insert a byte",
    "twice",
    "old frame again",
    "swapped with the next",
    "garbage before",
    "long garbage before",
    "another session",
    "wrong check",
    "wrong length",
    "unknown kind",
    "joined by a lost zero",
)
SHARES = np.array([0.40] + [0.04] * (len(DAMAGES) - 1))


class Damage:
    """Damages frames at random, and remembers older ones."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.older: list[bytes] = []
        self.held = b""

    def __call__(self, kind: str, packet: Packet) -> bytes:
        """Bytes that arrive instead of the packet's frame."""
        rng, frame = self.rng, encode(packet)
        self.older = [*self.older[-99:], frame]
        before, self.held = self.held, b""
        if kind == "swapped with the next":
            self.held = frame
            return before
        if kind == "flip one bit":
            frame = self._flipped(frame, 1)
        elif kind == "flip many bits":
            frame = self._flipped(frame, int(rng.integers(2, 40)))
        elif kind == "cut":
            frame = frame[: rng.integers(0, len(frame) - 1)]
        elif kind == "drop a byte":
            at = rng.integers(1, len(frame) - 1)
            frame = frame[:at] + frame[at + 1 :]
        elif kind == "insert a byte":
            at = rng.integers(1, len(frame) - 1)
            frame = frame[:at] + rng.bytes(1) + frame[at:]
        elif kind == "twice":
            frame = frame + frame
        elif kind == "old frame again":
            frame = frame + self.older[rng.integers(len(self.older))]
        elif kind == "garbage before":
            frame = rng.bytes(int(rng.integers(1, 60))) + frame
        elif kind == "long garbage before":
            frame = rng.bytes(int(rng.integers(200, 800))) + frame
        elif kind == "joined by a lost zero":
            frame = self.older[-2][:-1] + frame[1:] if len(self.older) > 1 else frame
        elif kind != "none":
            frame = self._made_up(kind, packet)
        # What was held back comes after the frame that it should have come before.
        return frame + before

    def _made_up(self, kind: str, packet: Packet) -> bytes:
        """Frame of a packet that no host sends."""
        rng, content = self.rng, to_packet(packet)[:-4]
        if kind == "another session":
            return encode(Packet(packet.session ^ 0x5A5A, packet.sequence, packet.message))
        if kind == "wrong check":
            return to_frame(content + rng.bytes(4))
        if kind == "wrong length":
            content += rng.bytes(int(rng.integers(1, 9)))
        elif kind == "unknown kind":
            content = bytes([rng.integers(7, 0x80)]) + content[1:]
        return to_frame(content + crc32(content).to_bytes(4, "little"))

    def _flipped(self, frame: bytes, bits: int) -> bytes:
        array = np.frombuffer(frame, np.uint8).copy()
        for bit in self.rng.choice(8 * len(array), min(bits, 8 * len(array)), replace=False):
            array[bit // 8] ^= 1 << bit % 8
        return array.tobytes()


#: Kinds after which the frame itself arrives intact, so that it must be answered.
INTACT = ("none", "twice", "old frame again", "garbage before", "long garbage before")


def main(frames: int = 50_000, seed: int = 0) -> None:
    """A hostile line to the device: damaged, repeated, reordered, foreign and made-up frames."""
    rng = np.random.default_rng(seed)
    damage = Damage(rng)
    kinds = rng.choice(len(DAMAGES), frames, p=SHARES / SHARES.sum())
    commands = np.stack([rng.integers(0, 10_001, frames), rng.integers(0, 2, frames)], axis=1)
    now, session, sequence = 0.0, 7, 0
    state = program.init(SETTINGS, now)
    sent: dict[int, tuple[float, int]] = {}
    count: Counter[str] = Counter()
    taken, begun = -1, time.perf_counter()
    for k in range(frames):
        now += 0.03
        sequence += 1
        kind = DAMAGES[kinds[k]]
        # A host that sees the device stopped opens a session or arms; damaged like all else.
        if state.mode is Mode.CLOSED or sequence > 60_000:
            session, sequence, taken = session + 1, 1, -1
            packet = Packet(session, sequence, Hello())
            kind = "none" if sequence > 60_000 else kind
        elif state.session != session:
            packet = Packet(session, sequence, Hello())
        elif state.mode is not Mode.RUNNING:
            packet = Packet(session, sequence, Arm())
        elif k % 10 == 0:
            packet = Packet(session, sequence, Heartbeat())
        else:
            u_in, u_out = commands[k, 0] / 100, int(commands[k, 1])
            sent[sequence] = u_in, u_out
            packet = Packet(session, sequence, Command(u_in, u_out, milliseconds(now)))
        data = damage(kind, packet)
        before = state
        state, answers = program.step(SETTINGS, IDENTITY, state, now, data, Sample(now, 10.0))
        count[f"frames: {kind}"] += 1
        if kind in INTACT and not answers:
            count["intact frames lost"] += 1
        valves = (state.u_in, state.u_out)
        if valves == (0.0, 1):
            continue
        accepted = state.counters.commands - before.counters.commands
        if accepted:
            if state.sequence <= taken or sent.get(state.sequence) != valves:
                count["wrong actuations"] += 1
            taken = state.sequence
            count["commands that moved the valves"] += accepted
        elif valves != (before.u_in, before.u_out):
            count["wrong actuations"] += 1
        sent = {s: c for s, c in sent.items() if s > sequence - 200} if k % 500 == 0 else sent
    seconds = time.perf_counter() - begun
    for name, number in sorted(count.items()):
        print(f"{name:45s} {number:>9,}")
    for name in ("wrong actuations", "intact frames lost"):
        print(f"{name.upper():45s} {count[name]:>9,}")
    print(f"device counters: {state.counters}")
    print(f"{frames:,} frames in {seconds:.0f} s: {1e6 * seconds / frames:.0f} us")
    if count["wrong actuations"] or count["intact frames lost"]:
        raise SystemExit(1)


if __name__ == "__main__":
    typer.run(main)
