"""Faults of an emulated device: of its lung, valves and sensor, and of the line to the host."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ventbench.base.errors import InputError


class FaultKind(Enum):
    """What can go wrong with a lung on its ventilator; ``strength`` is in the unit given here."""

    #: The sensor keeps showing what it showed when the fault began.
    SENSOR_STUCK = "sensor_stuck"
    #: The sensor shows ``strength`` cmH2O too much.
    SENSOR_OFFSET = "sensor_offset"
    #: The sensor gives no value.
    SENSOR_LOST = "sensor_lost"
    #: The sensor scatters with a standard deviation of ``strength`` cmH2O more.
    SENSOR_NOISY = "sensor_noisy"
    #: The sensor's bus is blocked: nobody who reads it gets on.
    BUS_BLOCKED = "bus_blocked"
    #: Each sample is lost with probability ``strength``.
    SENSOR_DROPOUTS = "sensor_dropouts"
    #: The inspiratory valve stays where it was.
    VALVE_STUCK = "valve_stuck"
    #: The inspiratory valve opens to the share ``strength`` of what is commanded.
    VALVE_WEAK = "valve_weak"
    #: The expiratory valve stays closed.
    EXPIRATORY_STUCK = "expiratory_stuck"
    #: The tube is off: nothing reaches the lung, the sensor shows ambient pressure.
    DISCONNECTED = "disconnected"
    #: The airway's resistance is ``strength`` times its value (a pinched tube: 3).
    PINCHED = "pinched"
    #: The airway's resistance is a hundred times its value.
    OCCLUDED = "occluded"
    #: A leak as if the expiratory valve stood open by the share ``strength``.
    LEAK = "leak"


class LineFaultKind(Enum):
    """What can go wrong on the line; ``strength`` is in the unit given here."""

    #: The device's answers come ``strength`` seconds later.
    LATE = "late"
    #: They come later by a random time, uniform up to ``strength`` seconds, in order.
    JITTER = "jitter"
    #: Each write of either side is lost with probability ``strength``.
    LOSS = "loss"
    #: Each byte of either side has one bit flipped with probability ``strength``.
    NOISE = "noise"
    #: The device says nothing, though it goes on.
    SILENT = "silent"


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the simulated hardware or of the line."""

    kind: FaultKind | LineFaultKind  #: what goes wrong.
    start: float  #: from when, s on the device's clock.
    end: float = math.inf  #: until when, s.
    strength: float = 1.0  #: how much; see the kinds.


_TEXT = re.compile(
    r"(?P<kind>\w+)@(?P<start>[\d.]+)(?:-(?P<end>[\d.]+))?(?::(?P<strength>[-\d.]+))?"
)


def parse(text: str, now: float = 0.0) -> Fault:
    """Read a fault as people write it: ``KIND@START[-END][:STRENGTH]``, seconds from ``now`` on.

    Raises:
        InputError: if it says nothing of the kind.
    """
    kinds = {kind.value: kind for kind in (*FaultKind, *LineFaultKind)}
    match = _TEXT.fullmatch(text.strip())
    kind = kinds.get(match["kind"]) if match else None
    try:
        if match is None or kind is None:
            raise ValueError
        start, end = float(match["start"]), float(match["end"] or "inf")
        strength = float(match["strength"] or 1.0)
        if not start < end:
            raise ValueError
    except ValueError:
        raise InputError(
            f"fault {text!r}: write KIND@START[-END][:STRENGTH], times in s, such as "
            f"leak@10-13:0.1; kinds: {', '.join(kinds)}"
        ) from None
    return Fault(kind, now + start, now + end, strength)


def active(faults: Iterable[Fault], now: float) -> dict[object, Fault]:
    """Faults that act at ``now``, s, by kind; of two of one kind the later of the sequence."""
    return {fault.kind: fault for fault in faults if fault.start <= now < fault.end}


class Line:
    """What a line with faults makes of written bytes.

    Attributes:
        faults: what goes wrong; may be replaced while it runs.
    """

    def __init__(self, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        """Start with faults; ``seed`` is that of losses, flips and delays."""
        self.faults = tuple(faults)
        self._random = np.random.default_rng(seed)
        self._latest = -math.inf

    def to_device(self, now: float, data: bytes) -> bytes:
        """What arrives at the device of what the host wrote at ``now``, s."""
        if not self.faults:
            return data
        return self._damaged(active(self.faults, now), data)

    def to_host(self, now: float, data: bytes) -> tuple[float, bytes]:
        """When, s, and what leaves towards the host of what the device wrote at ``now``, s."""
        if not self.faults and self._latest <= now:
            return now, data
        kinds = active(self.faults, now)
        if LineFaultKind.SILENT in kinds:
            return now, b""
        due = now
        if LineFaultKind.LATE in kinds:
            due += kinds[LineFaultKind.LATE].strength
        if LineFaultKind.JITTER in kinds:
            due += float(self._random.uniform(0.0, kinds[LineFaultKind.JITTER].strength))
        self._latest = max(self._latest, due)  # a line keeps the order
        return self._latest, self._damaged(kinds, data)

    def _damaged(self, kinds: dict[object, Fault], data: bytes) -> bytes:
        if LineFaultKind.LOSS in kinds and self._random.uniform() < (
            kinds[LineFaultKind.LOSS].strength
        ):
            return b""
        if LineFaultKind.NOISE in kinds and data:
            array = np.frombuffer(data, np.uint8).copy()
            hit = self._random.uniform(size=len(array)) < kinds[LineFaultKind.NOISE].strength
            array[hit] ^= (1 << self._random.integers(0, 8, int(hit.sum()))).astype(np.uint8)
            return array.tobytes()
        return data
