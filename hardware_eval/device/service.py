"""The device's program on its hardware: what both the real board and the emulator run."""

from __future__ import annotations

from hardware_eval.device import program
from hardware_eval.device.hal import Hal
from hardware_eval.device.program import DeviceSettings, DeviceState


class DeviceService:
    """Steps the program, reads the sensors and sets the valves.

    Attributes:
        hal: the hardware.
        settings: limits of the device.
        state: state of the program.
    """

    def __init__(self, hal: Hal, settings: DeviceSettings, now: float) -> None:
        """Start vented, at ``now``, s."""
        self.hal = hal
        self.settings = settings
        self.state: DeviceState = program.init(settings, now)
        hal.actuate(now, self.state.u_in, self.state.u_out)

    def step(self, now: float, data: bytes = b"") -> bytes:
        """Guard the lung and do what arrived.

        Args:
            now: time, s.
            data: bytes that arrived.

        Returns:
            Bytes to send.
        """
        sample = self.hal.sample(now)
        self.state, answers = program.step(
            self.settings, self.hal.identity, self.state, now, data, sample
        )
        self.hal.actuate(now, self.state.u_in, self.state.u_out)
        return answers

    def vent(self, now: float) -> None:
        """Vent whatever the program says; for the end of the process."""
        self.hal.actuate(now, 0.0, 1)
