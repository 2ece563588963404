"""A device in the same process on a virtual clock: the same program, without a wire."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import count

from hardware_eval.device.program import PERIOD, DeviceService, DeviceSettings, Hal
from hardware_eval.emulation.faults import Line
from hardware_eval.realtime import VirtualClock
from hardware_eval.wire.client import DisconnectedError


@dataclass(frozen=True, slots=True)
class Actuation:
    """A change of the valves: device time, s; inspiratory valve, %; expiratory valve, 0 or 1."""

    time: float
    u_in: float
    u_out: int


class LoopbackDevice:
    """A transport whose other end is a device; time passes only while somebody waits.

    Attributes:
        clock: the clock of host and device.
        start: time at which the device started, s.
        service: program and hardware of the device.
        latency: time that bytes take each way, s; may be changed while it runs.
        line: what the line does to bytes; its faults may be changed while it runs.
        actuations: every change of the valves.
        plugged: whether the cable is in; :meth:`unplug` and :meth:`plug` change it.
    """

    def __init__(
        self, hal: Hal, settings: DeviceSettings | None = None,
        clock: VirtualClock | None = None, latency: float = 0.001, line: Line | None = None,
    ) -> None:  # fmt: skip
        """Start the device on a clock, its own if none is given."""
        self.line = line or Line()
        self.clock = clock or VirtualClock()
        self.start = self.clock.now()
        self.latency = latency
        self.service = DeviceService(hal, settings or DeviceSettings(), self.start)
        self.actuations = [Actuation(self.start, 0.0, 1)]
        self.plugged = True
        self._next = self.start + PERIOD
        self._order = count()
        self._incoming: list[tuple[float, int, bytes]] = []
        self._outgoing: list[tuple[float, int, bytes]] = []
        self.clock.carry(self._run_until)

    def write(self, data: bytes) -> None:
        """Send bytes to the device; DisconnectedError if the cable is out."""
        self._require_cable()
        arrival = self.clock.now() + self.latency
        data = self.line.to_device(self.clock.now() - self.start, data)
        if data:
            heapq.heappush(self._incoming, (arrival, next(self._order), data))

    def read(self, timeout: float) -> bytes:
        """Wait for bytes from the device; empty if none come within ``timeout``, s."""
        deadline = self.clock.now() + timeout
        while True:
            self._require_cable()
            now, ready = self.clock.now(), b""
            while self._outgoing and self._outgoing[0][0] <= now:
                ready += heapq.heappop(self._outgoing)[2]
            if ready or now >= deadline:
                return ready
            coming = [self._next, deadline]
            coming += [queue[0][0] for queue in (self._incoming, self._outgoing) if queue]
            self.clock.sleep_until(max(min(coming), now + 1e-6))

    def close(self) -> None:
        """Nothing to release; the device goes on."""

    def reopen(self) -> None:
        """Connect again; DisconnectedError if the cable is still out."""
        self._require_cable()

    def unplug(self) -> None:
        """Pull the cable; what is on the way is lost."""
        self.plugged = False
        self._incoming.clear()
        self._outgoing.clear()

    def plug(self) -> None:
        """Put the cable back."""
        self.plugged = True

    def _require_cable(self) -> None:
        if not self.plugged:
            raise DisconnectedError("the cable to the device is out")

    def _run_until(self, instant: float) -> None:
        while True:
            arrival = self._incoming[0][0] if self._incoming else float("inf")
            now = min(self._next, arrival)
            if now > instant:
                return
            data = b""
            while self._incoming and self._incoming[0][0] <= now:
                data += heapq.heappop(self._incoming)[2]
            if self._next <= now:
                self._next += PERIOD
            answers = self.service.step(now, data)
            if answers and self.plugged:
                due, answers = self.line.to_host(now - self.start, answers)
                due += self.start + self.latency
                heapq.heappush(self._outgoing, (due, next(self._order), answers))
            state, last = self.service.state, self.actuations[-1]
            if (state.u_in, state.u_out) != (last.u_in, last.u_out):
                self.actuations.append(Actuation(now, state.u_in, state.u_out))
