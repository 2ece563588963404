"""Hardware abstraction: the little that the device's program needs of a ventilator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from hardware_eval.wire.messages import Capability


@dataclass(frozen=True, slots=True)
class Sample:
    """One look at the sensors."""

    time: float  #: when it was taken, s, on the clock that the program is stepped with.
    pressure: float  #: airway pressure, cmH2O; NaN if the sensor did not answer.
    flow: float = math.nan  #: flow into the lung, mL/s; NaN if it is not measured.
    saturated: bool = False  #: whether the pressure stands at the upper end of the sensor's range.
    #: whether the electronics have vented by themselves, as the program stood still.
    lapsed: bool = False


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device tells about itself."""

    name: str  #: what people call it, at most 32 bytes of UTF-8.
    device_id: bytes  #: its own number, 8 bytes.
    calibration: bytes  #: SHA-256 of its calibration, 32 bytes.
    capabilities: Capability  #: what it is and has.
    highest: float = math.inf  #: largest pressure that the sensor can tell, cmH2O.
    #: whether noise moves the sensor's readings at rest by half a digit or more, so that one that
    #: does not move is stuck.
    noisy: bool = False


class Hal(Protocol):
    """One ventilator: a pressure sensor and two valves.

    Both methods return within about 2 ms. When nobody calls them any more, the hardware itself
    should vent: a normally open expiratory and a normally closed inspiratory valve.
    """

    @property
    def identity(self) -> Identity:
        """What the device tells about itself."""
        ...

    def sample(self, now: float) -> Sample:
        """Read the sensors at device time ``now``, s. A sensor that fails gives NaN, no error."""
        ...

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        """Set the inspiratory valve, %, 0..100, and the expiratory valve, 0 closed, 1 open."""
        ...
