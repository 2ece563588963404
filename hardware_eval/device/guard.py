"""The loop of a device in real time."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Protocol

from hardware_eval.device.program import PERIOD
from hardware_eval.wire.port import Port


class Service(Protocol):
    """A program of a device with its hardware."""

    def step(self, now: float, data: bytes = b"") -> bytes:
        """Guard the lung at ``now``, s, and do what arrived; returns bytes to send."""
        ...

    def vent(self, now: float) -> None:
        """Vent whatever the program says."""
        ...


class Guard:
    """The loop of a device in real time: steps the program every period, and when bytes arrive.

    Attributes:
        service: program and hardware.
        port: line to the host.
        lateness: longest time by which a step came late, s.
    """

    def __init__(
        self, service: Service, port: Port, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Guard with a clock, s, that is the device's own time."""
        self.service = service
        self.port = port
        self.lateness = 0.0
        self._clock = clock

    def run(self, stop: Callable[[], bool]) -> None:
        """Go on until ``stop()``; then vent."""
        gc.collect()
        gc.freeze()  # what is there stays; a collection in the loop would walk over all of it
        due = self._clock() + PERIOD
        try:
            while not stop():
                data = self.port.take(due - self._clock())
                now = self._clock()
                if now >= due:
                    self.lateness = max(self.lateness, now - due)
                    due = max(due + PERIOD, now)
                self.turn(now, data)
        finally:
            self.service.vent(self._clock())

    def turn(self, now: float, data: bytes) -> None:
        """Step the program and answer."""
        if answers := self.service.step(now, data):
            self.port.send(answers)
