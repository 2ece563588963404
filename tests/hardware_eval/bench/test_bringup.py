"""The bring-up on a ventilator whose wiring is what a test says, whatever its files say."""

from __future__ import annotations

import datetime
import json
import sys
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest

from hardware_eval.bench import bringup, dated
from hardware_eval.bench.bringup import bring_up, load
from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.selftest import Finding
from hardware_eval.device.program import Sample
from hardware_eval.device.pvp import PvpSensor, PvpValves
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.results import evaluate
from hardware_eval.wire.client import Client, UnconfirmedError
from hardware_eval.wire.messages import Mode
from tests.hardware_eval.device.test_pvp import CONFIGURATION, RIG, TABLE
from ventbench.base.errors import InputError

DAY = datetime.datetime(2026, 1, 10, tzinfo=datetime.UTC)

#: A sensor that nobody knows, whose range is of one part and whose slope of another.
MIXED = """
[sensors.mixed]
source = "two data sheets"
range = 50.8
offset_voltage = [2.15, 2.35]
span_voltage = [3.8, 4.2]
"""


class Machine:
    """A PVP of board 2: GPIO 12 drives the inspiratory valve, 17 the expiratory one.

    It stands in for pigpio and for the bus of the converter, whose channel 0 has a 1 PSI sensor.
    """

    connected = True

    def __init__(self) -> None:
        self.levels: dict[int, int] = {}
        self.duty = self.pressure = self.applied = self.peep = 0.0
        self.supply, self.lung, self.noise = False, False, 1.0
        self.moved: list[str] = []
        self.random, self.time, self.channel = Random(0), 0.0, -1

    def set_mode(self, pin: int, mode: int) -> None:
        pass

    def write(self, pin: int, level: int) -> None:
        if pin == 17 and level != self.levels.get(pin, 0):
            self.moved.append("expiratory")
        self.levels[pin] = level

    def hardware_PWM(self, pin: int, frequency: int, duty: int) -> None:
        if pin == 12 and duty != self.duty:
            self.moved.append("inspiratory")
            self.duty = duty

    def stop(self) -> None:
        pass

    def write_i2c_block_data(self, address: int, register: int, data: list[int]) -> None:
        self.channel = (data[0] >> 4 & 0b111) - 4

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        volts = 2.25 + (self.pressure + self.applied) / 35.15 if self.channel == 0 else 0.0
        counts = round(volts / 0.002 + self.noise * self.random.gauss(0.0, 1.5)) if volts else 0
        return [counts << 4 >> 8, counts << 4 & 0xFF]

    def close(self) -> None:
        pass

    def advance(self, now: float) -> None:
        """Let 20 mL/cmH2O fill at 22.8 mL/s a percent, and empty through 20 cmH2O/(L/s)."""
        inward = 2280.0 * max(self.duty / 1e6 - 0.3, 0.0) / 0.6 if self.supply else 0.0
        open_out = self.levels.get(17, 0)
        outward = 50.0 * (self.pressure - self.peep) if open_out else 0.0
        self.pressure += (now - self.time) * (inward - outward) / 20.0
        self.pressure = self.pressure if self.lung else 0.0
        self.time = now


class Hal:
    """The driver of a ventilator on a machine."""

    def __init__(self, path: Path, machine: Machine) -> None:
        self._machine = machine
        self._valves, self._sensor = PvpValves(path), PvpSensor(path)

    @property
    def identity(self) -> Any:
        return self._sensor.identity

    def sample(self, now: float) -> Sample:
        self._machine.advance(now)
        return self._sensor.sample(now)

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        self._valves.actuate(u_in, u_out)


class Person(Operator):
    """Does what is asked, and says what the machine did."""

    def __init__(self, machine: Machine, **answers: Any) -> None:
        self.machine, self.answers, self.asked = machine, answers, list[str]()

    def confirm(self, question: str) -> bool:
        self.asked.append(question)
        self.machine.applied = 0.0
        self.machine.moved.clear()
        self.machine.lung = self.machine.supply = "connect a test lung" in question
        return not any(word in question for word in self.answers.get("declines", ()))

    def number(self, question: str) -> float:
        self.asked.append(question)
        if "which valve" not in question:
            self.machine.applied = self.answers.get("applied", 20.0)
            return self.machine.applied
        moved = set(self.machine.moved)
        assert self.machine.pressure == 0.0  # the supply is off
        heard = {frozenset(): 0.0, frozenset({"inspiratory"}): 1.0, frozenset({"expiratory"}): 2.0}
        return self.answers.get("heard", heard.get(frozenset(moved), 3.0))


FILES = (CONFIGURATION + RIG).replace("_channel = 1", "_channel = 0").replace("= 2.2\n", "= 2.25\n")


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the bench of a configuration."""
    machine = Machine()
    pigpio: Any = SimpleNamespace(pi=lambda: machine, OUTPUT=1)
    monkeypatch.setitem(sys.modules, "pigpio", pigpio)
    smbus2: Any = SimpleNamespace(SMBus=lambda number: machine)
    monkeypatch.setitem(sys.modules, "smbus2", smbus2)
    monkeypatch.setattr(bringup, "SystemRandom", lambda: Random(1))
    monkeypatch.setattr(dated, "today", lambda: DAY)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "kept"))
    (tmp_path / "valve.csv").write_text(TABLE)

    def make(files: str = FILES, **answers: Any) -> Bench:
        (tmp_path / "pvp.toml").write_text(files)
        machine.__init__()
        device = LoopbackDevice(Hal(tmp_path / "pvp.toml", machine))
        client = Client(device, device.clock, emulated=False)
        client.hello()
        return Bench(client, device.clock, DEFAULT, Person(machine, **answers))

    return make


def confirmed(bench: Bench) -> tuple[dict[str, Any], list[Finding]]:
    findings = bring_up(bench)
    return bringup.keep(bench.client, "A. Name", findings), findings


def test_a_machine_that_is_as_its_files_say_is_confirmed_and_then_arms(rig: Any) -> None:
    bench = rig()
    with pytest.raises(UnconfirmedError, match="nobody has confirmed"):
        bench.client.arm()
    with pytest.raises(InputError, match="never brought up"):
        load(bench.client)
    kept, findings = confirmed(bench)
    assert kept["go"], kept
    assert [x.name for x in findings] == [
        *("room", "sensor_noise", "reference", "clicked", "clicked", "rise", "vented")
    ]
    bench.client.arm()
    bench = rig()  # the next command
    with pytest.raises(UnconfirmedError):
        bench.client.arm()
    found = load(bench.client)
    assert (found["operator"], found["date"]) == ("A. Name", DAY.isoformat())
    assert bench.client.arm().mode is Mode.RUNNING
    bench.client.hello()
    assert bench.client.arm().mode is Mode.RUNNING  # the same device, connected again


def test_it_is_stale_after_a_change_and_after_a_month_and_notices_hands(
    rig: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, _ = confirmed(rig())
    for change in (("= 17", "= 27"), ("= 2.25\n", "= 2.26\n"), ("open = false", "open = true")):
        client = rig(FILES.replace(*change)).client
        with pytest.raises(InputError, match="other settings of it"):
            load(client)
        with pytest.raises(UnconfirmedError):
            client.arm()
    client = rig().client
    with monkeypatch.context() as later:
        later.setattr(dated, "today", lambda: DAY + datetime.timedelta(days=31))
        with pytest.raises(InputError, match="31 days old"):
            load(client)
    path = bringup.place(kept["device"])
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "operator": "B. Name"}))
    with pytest.raises(InputError, match="was changed"):
        load(client)


@pytest.mark.parametrize(
    ("change", "answers", "finding", "message"),
    [
        (("= 17", "= 27"), {}, "clicked", "expiratory ordered, none clicked"),
        (("= 12\nexp", "= 13\nexp"), {}, "clicked", "inspiratory ordered, none clicked"),
        (("open = false", "open = true"), {}, "rise", "polarity"),
        (("_channel = 0", "_channel = 1"), {}, "room", "gives no pressure"),
        (("= 2.25\n", "= 2.16\n"), {}, "room", "open to the room"),
        (("", ""), {"applied": 5.0}, "reference", "tell no slope"),
        (("", ""), {"heard": 3.0}, "clicked", "both clicked"),
        (("", ""), {"declines": ("supply off, no lung",)}, "room", "not confirmed"),
        (("", ""), {"declines": ("will click",)}, "clicked", "not confirmed"),
        (("", ""), {"declines": ("test lung",)}, "rise", "not confirmed"),
    ],
)
def test_what_is_otherwise_or_not_confirmed_never_arms(
    rig: Any, change: tuple[str, str], answers: dict[str, Any], finding: str, message: str
) -> None:
    bench = rig(FILES.replace(*change), **answers)
    kept, findings = confirmed(bench)
    assert not kept["go"]
    wrong = next(x for x in findings if not x.ok)
    assert wrong.name == finding
    assert message in wrong.text
    client = bench.client
    with pytest.raises(UnconfirmedError):
        client.arm()
    with pytest.raises(InputError, match="not confirmed"):
        load(client)
    with pytest.raises(UnconfirmedError):
        client.arm()
    assert bench.operator.machine.duty == 0.0


def test_a_mixed_sensor_shows_at_a_pressure_that_a_person_applies(rig: Any) -> None:
    mixed = FILES.replace('"1 PSI-D-4V-MINI"', '"mixed"').replace("35.15", "12.7")
    bench = rig(mixed.replace("= 50.0", "= 20.0") + MIXED)
    kept, findings = confirmed(bench)
    assert not kept["go"]
    assert "7.2" in findings[-1].text  # 20 cmH2O by a slope of 12.7 instead of 35.15
    assert "another sensor's" in findings[-1].text
    assert not bench.operator.machine.moved[1:]  # no valve moved after it was vented once


def test_a_frozen_sensor_is_named(rig: Any) -> None:
    bench = rig()
    bench.operator.machine.noise = 0.0
    _, findings = confirmed(bench)
    assert "frozen" in findings[-1].text


def test_software_is_exempt_only_where_software_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    line = evaluate.connect("virtual:R20C20")
    assert line.client.simulated
    assert line.bringup == {}
    monkeypatch.setattr(evaluate, "EMULATED_PORTS", frozenset())
    with pytest.raises(InputError, match="never brought up"):
        evaluate.connect("virtual:R20C20")
