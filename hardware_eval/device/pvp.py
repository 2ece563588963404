"""The People's Ventilator as hardware: pigpio for the valves, an ADS1015 on I2C for the pressure.

Nothing of this module has run on a ventilator yet; its tests replace ``pigpio`` and ``smbus2`` by
stand-ins that check registers and duty cycles. Both are imported only when the hardware is opened.

Pins, addresses and the sensor's conversion are those of the ventilator's own configuration
(github.com/CohenLabPrinceton/pvp, ``pvp/io/config/devices.ini``): sensor at A0, (V - 2.2 V) / 2 V x
70.3 cmH2O, which at 2 mV a step is the 0.0703 cmH2O of the public recordings. ADS1015 registers:
Texas Instruments, SBAS473E, tables 3 to 8.
"""

from __future__ import annotations

import hashlib
import importlib
import math
import statistics
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware_eval.device.program import Identity, Sample
from hardware_eval.wire.messages import Capability
from ventbench.base.errors import InputError

#: Registers of the ADS1015, and its configuration: continuous, 3300 samples/s, +-4.096 V, no alert.
_CONVERSION, _CONFIGURATION = 0x00, 0x01
_SINGLE_ENDED, _RANGE_4V, _FASTEST, _NO_ALERT = 0b100 << 12, 0b001 << 9, 0b110 << 5, 0b11

#: One step of the converter in that range, V, and its last one.
STEP, LAST = 0.002, 2047

#: Conversions of which one sample is the median, against spikes; 0.3 ms each.
_MEDIAN_OF = 3

#: Share of its range at which a sensor is at its end: some clip a little early.
_SATURATED = 0.99

#: Full duty of pigpio's hardware PWM.
_FULL_DUTY = 1_000_000


@dataclass(frozen=True)
class PvpConfiguration:
    """Wiring and calibration of one ventilator; every field is a key of its TOML file."""

    name: str = "PVP"  #: what people call it.
    device_id: str = "00" * 8  #: its own number, 16 hexadecimal digits.
    i2c_bus: int = 1  #: bus of the converter.
    adc_address: int = 0x48  #: address of the converter.
    adc_channel: int = 0  #: input of the pressure sensor, 0..3.
    offset_voltage: float = 2.2  #: sensor at ambient pressure, V.
    cmH2O_per_volt: float = 35.15  #: slope of the sensor.
    #: largest pressure that the sensor can tell, cmH2O; 20 inH2O are 50.8.
    highest_pressure: float = 50.8
    #: GPIO of the proportional valve; one with hardware PWM (12, 13, 18, 19).
    inspiratory_pin: int = 12
    pwm_frequency: int = 20_000  #: Hz.
    expiratory_pin: int = 17  #: GPIO of the on/off valve.
    #: whether that valve is open without current. The PVP's own is closed without current: with it,
    #: a device without power does not vent.
    expiratory_normally_open: bool = False
    #: GPIO of the monostable's trigger, which moves with every order to the valves; -1 for none.
    heartbeat_pin: int = -1
    #: CSV of the proportional valve with columns u_in (%, 0 to 100, increasing), opening, closing
    #: (duty cycle, 0..1); beside the TOML file.
    valve_table: str = "valve.csv"


@dataclass(frozen=True, eq=False)
class ValveTable:
    """Duty cycle of the proportional valve by opening, apart for opening and closing."""

    u_in: NDArray[np.float64]  #: %, increasing from 0 to 100, ``(n,)``.
    opening: NDArray[np.float64]  #: duty cycle when the command rises, 0..1, ``(n,)``.
    closing: NDArray[np.float64]  #: duty cycle when it falls, ``(n,)``.

    def duty(self, u_in: float, rising: bool) -> float:
        """Duty cycle of a command, 0..1; exactly 0 for a closed valve."""
        if u_in <= 0.0:
            return 0.0
        return float(np.interp(u_in, self.u_in, self.opening if rising else self.closing))


def load_configuration(path: Path) -> tuple[PvpConfiguration, ValveTable, bytes]:
    """Read a ventilator's configuration.

    Returns:
        Configuration, valve table, and the SHA-256 of the calibration: of the sensor's conversion
        and the table.

    Raises:
        InputError: if a file cannot be read, or holds what cannot be.
    """
    try:
        values = tomllib.loads(path.read_text("utf-8"))
        known = set(PvpConfiguration.__dataclass_fields__)
        if unknown := sorted(set(values) - known):
            raise ValueError(f"there is no key {unknown[0]!r}; keys: {', '.join(sorted(known))}")
        configuration = PvpConfiguration(**values)
        _check(configuration)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error
    table_path = path.parent / configuration.valve_table
    try:
        rows = np.loadtxt(table_path, delimiter=",", skiprows=1, ndmin=2)
        table = ValveTable(*(np.ascontiguousarray(column) for column in rows.T))
        _check_table(table)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{table_path}: {error}; it needs a line of names, then u_in,opening,closing with u_in "
            "increasing from 0 to 100 and duty cycles within 0..1"
        ) from error
    sensor = f"{configuration.offset_voltage!r} {configuration.cmH2O_per_volt!r}\n".encode()
    digest = hashlib.sha256(sensor + rows.astype("<f8").tobytes()).digest()
    return configuration, table, digest


def _check(configuration: PvpConfiguration) -> None:
    default = PvpConfiguration()
    for key, value in asdict(configuration).items():
        wanted = type(getattr(default, key))
        if not isinstance(value, (int, float) if wanted is float else wanted):
            raise ValueError(f"{key} = {value!r} must be a {wanted.__name__}")
    if len(bytes.fromhex(configuration.device_id)) != 8:
        raise ValueError(f"device_id = {configuration.device_id!r} must have 16 hexadecimal digits")
    if not 0 <= configuration.adc_channel <= 3:
        raise ValueError(f"adc_channel = {configuration.adc_channel} is outside 0..3")
    for key in ("cmH2O_per_volt", "highest_pressure"):
        if not getattr(configuration, key) > 0.0:
            raise ValueError(f"{key} = {getattr(configuration, key)} must be positive")


def _check_table(table: ValveTable) -> None:
    if table.u_in[0] != 0.0 or table.u_in[-1] != 100.0 or np.any(np.diff(table.u_in) <= 0.0):
        raise ValueError("u_in does not increase from 0 to 100")
    for name in ("opening", "closing"):
        duty = getattr(table, name)
        if np.any((duty < 0.0) | (duty > 1.0)) or np.any(np.diff(duty) < 0.0):
            raise ValueError(f"{name} leaves 0..1 or decreases")


class PvpValves:
    """The ventilator's valves and its heartbeat pin, owned by the deadman's process."""

    def __init__(self, path: Path | str) -> None:
        """Open the valves, vented.

        Args:
            path: TOML file, see :class:`PvpConfiguration`.

        Raises:
            InputError: if the file is wrong, pigpio is missing, or its daemon does not run.
        """
        self._configuration, self._table, _ = load_configuration(Path(path))
        pigpio = _imported("pigpio")
        self._pi: Any = pigpio.pi()
        if not self._pi.connected:
            raise InputError("pigpiod does not run: start it with `sudo pigpiod`")
        for pin in (self._configuration.expiratory_pin, self._configuration.heartbeat_pin):
            if pin >= 0:
                self._pi.set_mode(pin, pigpio.OUTPUT)
        self._set: tuple[float, int] | None = None
        self._rising, self._beat = True, 0
        self.actuate(0.0, 1)

    def actuate(self, u_in: float, u_out: int) -> None:
        """Set the valves; the expiratory one first, so that air finds its way out."""
        configuration, before = self._configuration, self._set[0] if self._set else 0.0
        if configuration.heartbeat_pin >= 0:
            self._beat = 1 - self._beat
            self._pi.write(configuration.heartbeat_pin, self._beat)
        if (u_in, u_out) == self._set:
            return
        energised = u_out == 0 if configuration.expiratory_normally_open else u_out == 1
        self._pi.write(configuration.expiratory_pin, int(energised))
        if u_in != before:
            self._rising = u_in > before
        duty = self._table.duty(u_in, self._rising)
        self._pi.hardware_PWM(
            configuration.inspiratory_pin, configuration.pwm_frequency, round(duty * _FULL_DUTY)
        )
        self._set = u_in, u_out

    def close(self) -> None:
        """Vent and release the hardware."""
        self._set = None
        self.actuate(0.0, 1)
        self._pi.stop()


class PvpSensor:
    """The ventilator's pressure sensor; see :class:`~hardware_eval.device.deadman.Sensor`."""

    def __init__(self, path: Path) -> None:
        """Open the converter.

        Args:
            path: TOML file, see :class:`PvpConfiguration`.

        Raises:
            InputError: if the file is wrong, smbus2 is missing, or the converter does not answer.
        """
        self._configuration, _, calibration = load_configuration(path)
        smbus2 = _imported("smbus2")
        try:
            self._bus: Any = smbus2.SMBus(self._configuration.i2c_bus)
            self._configure_converter()
        except OSError as error:
            raise InputError(
                f"the pressure converter does not answer at address "
                f"0x{self._configuration.adc_address:02x} of I2C bus "
                f"{self._configuration.i2c_bus}: {error}"
            ) from error
        self._highest = min(self._configuration.highest_pressure, self._pressure(LAST))
        self.identity = Identity(
            self._configuration.name,
            bytes.fromhex(self._configuration.device_id),
            calibration,
            Capability.NONE,
            highest=self._highest,
            noisy=True,
        )

    def sample(self, now: float) -> Sample:
        """Median of three conversions; NaN if the converter does not answer."""
        try:
            counts = statistics.median(self._conversion() for _ in range(_MEDIAN_OF))
        except OSError:
            return Sample(now, math.nan)
        if counts <= 0:  # no voltage: the wire is off; ambient pressure gives 2.2 V
            return Sample(now, math.nan)
        pressure = self._pressure(counts)
        return Sample(now, pressure, saturated=pressure >= _SATURATED * self._highest)

    def close(self) -> None:
        """Release the bus."""
        self._bus.close()

    def _pressure(self, counts: float) -> float:
        """Pressure of a conversion, cmH2O."""
        volts = counts * STEP - self._configuration.offset_voltage
        return volts * self._configuration.cmH2O_per_volt

    def _configure_converter(self) -> None:
        channel = self._configuration.adc_channel << 12
        word = _SINGLE_ENDED | channel | _RANGE_4V | _FASTEST | _NO_ALERT
        self._bus.write_i2c_block_data(
            self._configuration.adc_address, _CONFIGURATION, [word >> 8, word & 0xFF]
        )

    def _conversion(self) -> int:
        """Counts of one conversion: the upper 12 bits of a signed 16-bit word."""
        high, low = self._bus.read_i2c_block_data(self._configuration.adc_address, _CONVERSION, 2)
        word = high << 8 | low
        return (word - 0x10000 if word & 0x8000 else word) >> 4


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            "the ventilator's computer needs pigpio and smbus2 (pip install pigpio smbus2): "
            f"{error}"
        ) from error
