"""Hardware of which a test says what the sensor shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random

from hardware_eval.device.program import Identity, Sample
from hardware_eval.wire.messages import Capability


@dataclass
class Bench:
    """A sensor that shows ``pressure``, cmH2O, and valves that remember: time, s, u_in, u_out.

    Its noise, of standard deviation ``noise``, cmH2O, is rounded to the ventilator's converter.
    """

    pressure: float = 5.0
    noise: float = 0.0
    saturated: bool = False
    lapsed: bool = False
    identity: Identity = field(
        default_factory=lambda: Identity("bench", b"12345678", bytes(32), Capability.SIMULATED)
    )
    random: Random = field(default_factory=lambda: Random(0))
    valves: list[tuple[float, float, int]] = field(default_factory=list)

    def sample(self, now: float) -> Sample:
        pressure = self.pressure
        if self.noise:
            pressure = round(self.random.gauss(pressure, self.noise) / 0.0703) * 0.0703
        return Sample(now, pressure, saturated=self.saturated, lapsed=self.lapsed)

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        self.valves.append((now, u_in, u_out))
