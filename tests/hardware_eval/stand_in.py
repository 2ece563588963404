"""Hardware of which a test says what the sensor shows."""

from __future__ import annotations

from dataclasses import dataclass, field

from hardware_eval.device.hal import Identity, Sample
from hardware_eval.wire.messages import Capability


@dataclass
class Bench:
    """A sensor that shows ``pressure``, cmH2O, and valves that remember: time, s, u_in, u_out."""

    pressure: float = 5.0
    identity: Identity = field(
        default_factory=lambda: Identity("bench", b"12345678", bytes(32), Capability.NONE)
    )
    valves: list[tuple[float, float, int]] = field(default_factory=list)

    def sample(self, now: float) -> Sample:
        return Sample(now, self.pressure)

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        self.valves.append((now, u_in, u_out))
