"""The People's Ventilator as hardware: pigpio for the valves, an ADS1015 on I2C for the pressure.

Nothing of this module has run on a ventilator yet; its tests replace ``pigpio`` and ``smbus2`` by
stand-ins that check registers and duty cycles. Both are imported only when the hardware is opened.

No pin, polarity or sensor is assumed: the configuration names a revision of the hardware, of those
in ``revisions.toml`` or one that it describes itself, and whoever wrote it says how it was read off
the machine. ADS1015 registers: Texas Instruments, SBAS473E, tables 3 to 8.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import math
import statistics
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

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

#: Time until the conversion of an input that was just chosen, s: one ends, and another is whole.
_SETTLES = 0.001

#: Share of its range at which a sensor is at its end: some clip a little early.
_SATURATED = 0.99

#: Full duty of pigpio's hardware PWM.
_FULL_DUTY = 1_000_000

#: GPIOs of a Raspberry Pi that have hardware PWM, those of its header, and those of the I2C bus.
_PWM_PINS, _PINS, _BUS_PINS = (12, 13, 18, 19), range(2, 28), (2, 3)


@dataclass(frozen=True)
class Revision:
    """How a machine is wired; the tables ``revisions`` of TOML."""

    source: str  #: where this stands.
    inspiratory_pin: int  #: GPIO of the proportional valve; one with hardware PWM.
    expiratory_pin: int  #: GPIO of the on/off valve.
    pwm_frequency: int  #: Hz.
    i2c_bus: int  #: bus of the converter.
    adc_address: int  #: address of the converter.
    adc_channel: int  #: input of the pressure sensor, 0..3.
    sensor: str  #: part of the pressure sensor, a table of ``sensors``.


@dataclass(frozen=True)
class SensorPart:
    """A pressure sensor by its data sheet; the tables ``sensors`` of TOML."""

    source: str  #: where this stands.
    range: float  #: end of its range, cmH2O.
    offset_voltage: list[float]  #: least and largest voltage at ambient pressure, V.
    span_voltage: list[float]  #: least and largest further voltage at the end of the range, V.


@dataclass(frozen=True)
class FlowSensor:
    """A flow sensor on the same converter, the optional table ``flow`` of TOML.

    ``flow = largest sign(x) |x|^exponent`` with ``x = (V - offset_voltage) / span_voltage``, as the
    ventilator's own driver has it for a D-Lite with a differential pressure sensor.
    """

    source: str  #: where this stands.
    adc_channel: int  #: input, 0..3.
    offset_voltage: float  #: at no flow, V.
    span_voltage: float  #: V at the largest flow, beyond the offset; below 0 for one turned around.
    largest: float  #: L/min.
    exponent: float  #: of the voltage.

    def flow(self, counts: float) -> float:
        """Flow of a conversion, mL/s."""
        x = (counts * STEP - self.offset_voltage) / self.span_voltage
        return math.copysign(abs(x) ** self.exponent, x) * self.largest * 1000.0 / 60.0


@dataclass(frozen=True)
class PvpConfiguration:
    """Wiring and calibration of one ventilator: keys of its TOML file, all of them required."""

    name: str  #: what people call it.
    device_id: str  #: its own number, 16 hexadecimal digits.
    revision: str  #: how it is wired: a table of ``revisions``.
    source: str  #: who saw on the machine that it is so, and when.
    #: whether the expiratory valve is open without current. The PVP's own is closed without
    #: current: with it, a device without power does not vent.
    expiratory_normally_open: bool
    #: GPIO of the monostable's trigger, which moves with every order to the valves; -1 for none.
    heartbeat_pin: int
    offset_voltage: float  #: sensor at ambient pressure, measured, V.
    cmH2O_per_volt: float  #: slope of the sensor, measured.
    pressure_limit: float  #: above which the device vents, cmH2O.
    #: CSV of the proportional valve with columns u_in (%, 0 to 100, increasing), opening, closing
    #: (duty cycle, 0..1); or the ventilator's own ``.npy`` of these three. Beside the TOML file.
    valve_table: str


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


@dataclass(frozen=True, eq=False)
class Machine:
    """One ventilator, as its files describe it; see :func:`load_machine`."""

    configuration: PvpConfiguration
    wiring: Revision
    part: SensorPart
    valve: ValveTable
    flow: FlowSensor | None  #: None where none is.
    digest: bytes  #: SHA-256 of all of it but the name: who it is to a bring-up.

    def pressure(self, counts: float) -> float:
        """Pressure of a conversion, cmH2O."""
        volts = counts * STEP - self.configuration.offset_voltage
        return volts * self.configuration.cmH2O_per_volt

    @property
    def highest(self) -> float:
        """Largest pressure that sensor and converter can tell, cmH2O."""
        return min(self.part.range, self.pressure(LAST))


def load_machine(path: Path) -> Machine:
    """Read a ventilator's configuration.

    Raises:
        InputError: if a file cannot be read, lacks a key, or holds what cannot be.
    """
    try:
        known = tomllib.loads(Path(__file__).with_name("revisions.toml").read_text("utf-8"))
        values = tomllib.loads(path.read_text("utf-8"))
        for kind, tables in known.items():
            for name, table in values.pop(kind, {}).items():
                if tables.setdefault(name, table) != table:
                    raise ValueError(f"{kind}.{name} is known otherwise: give yours another name")
        measured = values.pop("flow", None)
        flow = None if measured is None else _typed(FlowSensor, measured, "flow.")
        configuration = _typed(PvpConfiguration, values, "")
        wiring = _typed(Revision, *_named(known, "revisions", configuration.revision))
        part = _typed(SensorPart, *_named(known, "sensors", wiring.sensor))
        _check(configuration, wiring, part)
        if flow is not None and (
            flow.adc_channel == wiring.adc_channel
            or not 0 <= flow.adc_channel <= 3
            or not flow.span_voltage
            or min(flow.largest, flow.exponent) <= 0.0
        ):
            raise ValueError(
                "flow: give another adc_channel than the pressure's, of 0..3, a span_voltage other "
                "than 0, and largest and exponent above 0"
            )
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error
    table_path = path.parent / configuration.valve_table
    try:
        with table_path.open("rb") as file:
            stored = file.read(6) == b"\x93NUMPY"
        rows = (
            np.asarray(np.load(table_path, allow_pickle=False), float)
            if stored
            else np.loadtxt(table_path, delimiter=",", skiprows=1, ndmin=2)
        )
        table = ValveTable(*(np.ascontiguousarray(column) for column in rows.T))
        _check_table(table)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{table_path}: {error}; it needs a line of names, then u_in,opening,closing with u_in "
            "increasing from 0 to 100 and duty cycles within 0..1"
        ) from error
    parts = [dataclasses.asdict(x) for x in (configuration, wiring, part, flow) if x is not None]
    del parts[0]["name"]
    content = json.dumps(parts, sort_keys=True).encode() + rows.astype("<f8").tobytes()
    machine = Machine(configuration, wiring, part, table, flow, hashlib.sha256(content).digest())
    if configuration.pressure_limit >= machine.highest:
        raise InputError(
            f"{path}: the pressure_limit of {configuration.pressure_limit:g} cmH2O lies outside "
            f"the range of {wiring.sensor}, up to {machine.highest:.4g}: nothing could trip it"
        )
    return machine


_TableT = TypeVar("_TableT", PvpConfiguration, Revision, SensorPart, FlowSensor)


def _named(known: Mapping[str, Any], kind: str, name: str) -> tuple[dict[str, Any], str]:
    if name not in known[kind]:
        raise ValueError(
            f"{kind} has no {name!r}, but {', '.join(known[kind])}; describe yours in a table "
            f'[{kind}."{name}"], as revisions.toml does'
        )
    return known[kind][name], f'{kind}."{name}": '


def _typed(table: type[_TableT], values: Mapping[str, Any], where: str) -> _TableT:
    """Make a table of TOML's values; nothing may be missing, unknown or of another type."""
    kinds = {field.name: str(field.type) for field in dataclasses.fields(table)}
    if missing := [key for key in kinds if key not in values]:
        raise ValueError(f"{where}{missing[0]} is missing; nothing about a machine is assumed")
    if unknown := sorted(set(values) - set(kinds)):
        raise ValueError(f"{where}there is no key {unknown[0]!r}; keys: {', '.join(kinds)}")
    kind_of = {"float": (int, float), "list[float]": list, "int": int, "str": str, "bool": bool}
    for key, kind in kinds.items():
        value = values[key]
        if not isinstance(value, kind_of[kind]) or (kind != "bool" and isinstance(value, bool)):
            raise ValueError(f"{where}{key} = {value!r} must be a {kind}")
        if kind == "str" and not value.strip():
            raise ValueError(f"{where}{key} is empty")
    return table(**values)


def _check(configuration: PvpConfiguration, wiring: Revision, part: SensorPart) -> None:
    if len(bytes.fromhex(configuration.device_id)) != 8:
        raise ValueError(f"device_id = {configuration.device_id!r} must have 16 hexadecimal digits")
    if not 0.0 < configuration.pressure_limit <= 100.0:
        raise ValueError(f"pressure_limit = {configuration.pressure_limit:g} is outside 0..100")
    pins = {key: getattr(wiring, key) for key in ("inspiratory_pin", "expiratory_pin")}
    if configuration.heartbeat_pin >= 0:
        pins["heartbeat_pin"] = configuration.heartbeat_pin
    for key, pin in pins.items():
        same = [x for x, other in pins.items() if other == pin and x != key]
        if same:
            raise ValueError(f"{key} and {same[0]} are both GPIO {pin}: one of them is wrong")
        if pin not in _PINS or pin in _BUS_PINS:
            raise ValueError(f"{key} = {pin} is no free GPIO of the header (4 to 27)")
    if wiring.inspiratory_pin not in _PWM_PINS:
        raise ValueError(
            f"inspiratory_pin = {wiring.inspiratory_pin} has no hardware PWM; "
            f"{', '.join(map(str, _PWM_PINS))} have"
        )
    if not 0 <= wiring.adc_channel <= 3:
        raise ValueError(f"adc_channel = {wiring.adc_channel} is outside 0..3")
    slopes = [part.range / span for span in reversed(part.span_voltage)]
    for key, (low, high) in {
        "offset_voltage": part.offset_voltage,
        "cmH2O_per_volt": slopes,
    }.items():
        if not low <= (value := getattr(configuration, key)) <= high:
            raise ValueError(
                f"{key} = {value:g} is not of a {wiring.sensor} ({low:.4g} to {high:.4g}: "
                f"{part.source}): is another sensor in, or was it measured wrongly?"
            )


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
        self._machine = machine = load_machine(Path(path))
        pigpio = _imported("pigpio")
        self._pi: Any = pigpio.pi()
        if not self._pi.connected:
            raise InputError("pigpiod does not run: start it with `sudo pigpiod`")
        for pin in (machine.wiring.expiratory_pin, machine.configuration.heartbeat_pin):
            if pin >= 0:
                self._pi.set_mode(pin, pigpio.OUTPUT)
        self._set: tuple[float, int] | None = None
        self._rising, self._beat = True, 0
        self.actuate(0.0, 1)

    def actuate(self, u_in: float, u_out: int) -> None:
        """Set the valves; the expiratory one first, so that air finds its way out."""
        configuration, wiring = self._machine.configuration, self._machine.wiring
        before = self._set[0] if self._set else 0.0
        if configuration.heartbeat_pin >= 0:
            self._beat = 1 - self._beat
            self._pi.write(configuration.heartbeat_pin, self._beat)
        if (u_in, u_out) == self._set:
            return
        energised = u_out == 0 if configuration.expiratory_normally_open else u_out == 1
        self._pi.write(wiring.expiratory_pin, int(energised))
        if u_in != before:
            self._rising = u_in > before
        duty = self._machine.valve.duty(u_in, self._rising)
        self._pi.hardware_PWM(
            wiring.inspiratory_pin, wiring.pwm_frequency, round(duty * _FULL_DUTY)
        )
        self._set = u_in, u_out

    def close(self) -> None:
        """Vent and release the hardware."""
        self._set = None
        self.actuate(0.0, 1)
        self._pi.stop()


class PvpSensor:
    """The ventilator's pressure sensor; see :class:`~hardware_eval.device.program.Sensor`.

    Attributes:
        identity: of the device.
        pressure_limit: of the configuration, cmH2O.
    """

    def __init__(self, path: Path) -> None:
        """Open the converter.

        Args:
            path: TOML file, see :class:`PvpConfiguration`.

        Raises:
            InputError: if the file is wrong, smbus2 is missing, or the converter does not answer.
        """
        self._machine = machine = load_machine(path)
        self._wiring = machine.wiring
        smbus2 = _imported("smbus2")
        try:
            self._bus: Any = smbus2.SMBus(self._wiring.i2c_bus)
            self._convert(self._wiring.adc_channel)
        except OSError as error:
            raise InputError(
                f"the pressure converter does not answer at address "
                f"0x{self._wiring.adc_address:02x} of I2C bus {self._wiring.i2c_bus}: {error}"
            ) from error
        self.pressure_limit = machine.configuration.pressure_limit
        self.identity = Identity(
            machine.configuration.name,
            bytes.fromhex(machine.configuration.device_id),
            machine.digest,
            Capability.NONE if machine.flow is None else Capability.FLOW,
            highest=machine.highest,
            noisy=True,
        )

    def sample(self, now: float) -> Sample:
        """Median of three conversions; NaN if the converter does not answer."""
        flow = math.nan
        try:
            counts = self._median()
            if (sensor := self._machine.flow) is not None:
                self._convert(sensor.adc_channel)
                flow = sensor.flow(self._median())
                self._convert(self._wiring.adc_channel)
        except OSError:
            return Sample(now, math.nan)
        if counts <= 0:  # no voltage: the wire is off; every part gives some at ambient pressure
            return Sample(now, math.nan)
        pressure = self._machine.pressure(counts)
        saturated = pressure >= _SATURATED * self._machine.highest
        return Sample(now, pressure, flow, saturated)

    def close(self) -> None:
        """Release the bus."""
        self._bus.close()

    def _convert(self, channel: int) -> None:
        """Convert an input from here on; the first conversion is awaited."""
        word = _SINGLE_ENDED | channel << 12 | _RANGE_4V | _FASTEST | _NO_ALERT
        self._bus.write_i2c_block_data(
            self._wiring.adc_address, _CONFIGURATION, [word >> 8, word & 0xFF]
        )
        time.sleep(_SETTLES)

    def _median(self) -> float:
        return statistics.median(self._conversion() for _ in range(_MEDIAN_OF))

    def _conversion(self) -> int:
        """Counts of one conversion: the upper 12 bits of a signed 16-bit word."""
        word = self._bus.read_i2c_block_data(self._wiring.adc_address, _CONVERSION, 2)
        return int.from_bytes(word, "big", signed=True) >> 4


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            "the ventilator's computer needs pigpio and smbus2 (pip install pigpio smbus2): "
            f"{error}"
        ) from error
