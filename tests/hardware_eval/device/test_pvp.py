"""The ventilator's own hardware, with stand-ins for its two packages; and the board's program."""

from __future__ import annotations

import math
import os
import re
import select
import socket
import subprocess
import sys
import threading
import time
import tomllib
import tty
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hardware_eval.device import __main__ as board
from hardware_eval.device.guard import Guard
from hardware_eval.device.program import DeviceService
from hardware_eval.device.pvp import LAST, PvpSensor, PvpValves, load_machine
from hardware_eval.wire.client import Client, Link
from hardware_eval.wire.messages import PROTOCOL_VERSION, Capability, Hello, Mode, Packet, encode
from hardware_eval.wire.port import Port
from tests.hardware_eval.stand_in import Bench
from ventbench.base.errors import InputError

CONFIGURATION = """\
name = "bench 3"
device_id = "0123456789abcdef"
revision = "test rig"
source = "wired for this test"
expiratory_normally_open = false
heartbeat_pin = -1
offset_voltage = 2.2
cmH2O_per_volt = 35.15
pressure_limit = 50.0
valve_table = "valve.csv"
"""
RIG = """
[revisions."test rig"]
source = "this file"
inspiratory_pin = 12
expiratory_pin = 17
pwm_frequency = 20000
i2c_bus = 1
adc_address = 0x48
adc_channel = 1
sensor = "1 PSI-D-4V-MINI"
"""
TABLE = """\
u_in,opening,closing
0,0.30,0.20
50,0.50,0.40
100,0.90,0.80
"""


class FakePi:
    """Keeps what pigpio was told: modes, levels, and duty cycles."""

    connected = True

    def __init__(self) -> None:
        self.levels: dict[int, int] = {}
        self.duties: list[tuple[int, int, int]] = []
        self.told: list[str] = []
        self.stopped = False

    def set_mode(self, pin: int, mode: int) -> None:
        assert pin in (17, 27)
        assert mode == 1

    def write(self, pin: int, level: int) -> None:
        self.levels[pin] = level
        self.told.append("expiratory")

    def hardware_PWM(self, pin: int, frequency: int, duty: int) -> None:
        self.duties.append((pin, frequency, duty))
        self.told.append("inspiratory")

    def stop(self) -> None:
        self.stopped = True


class FakeBus:
    """An ADS1015 whose conversions a test sets, in counts."""

    def __init__(self, number: int) -> None:
        assert number == 1
        self.counts: list[int] = [1100]
        self.configured: list[int] = []
        self.broken = False

    def write_i2c_block_data(self, address: int, register: int, data: list[int]) -> None:
        assert (address, register) == (0x48, 1)
        self.configured = data

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        assert (address, register, length) == (0x48, 0, 2)
        if self.broken:
            raise OSError(121, "Remote I/O error")
        counts = self.counts[0] if len(self.counts) == 1 else self.counts.pop(0)
        word = (counts << 4) & 0xFFFF
        return [word >> 8, word & 0xFF]

    def close(self) -> None:
        pass


@pytest.fixture
def configuration(tmp_path: Path) -> Path:
    (tmp_path / "pvp.toml").write_text(CONFIGURATION + RIG)
    (tmp_path / "valve.csv").write_text(TABLE)
    return tmp_path / "pvp.toml"


@pytest.fixture
def hardware(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    parts = SimpleNamespace(pi=FakePi(), bus=FakeBus(1))
    pigpio: Any = SimpleNamespace(pi=lambda: parts.pi, OUTPUT=1)
    monkeypatch.setitem(sys.modules, "pigpio", pigpio)
    smbus2: Any = SimpleNamespace(SMBus=lambda number: parts.bus)
    monkeypatch.setitem(sys.modules, "smbus2", smbus2)
    return parts


def test_the_sensor(configuration: Path, hardware: SimpleNamespace) -> None:
    hal = PvpSensor(configuration)
    # Continuous, channel 1 against ground, +-4.096 V, 3300 samples/s, comparator off.
    assert hardware.bus.configured == [0b0101_0010, 0b1100_0011]
    assert hal.sample(1.5).pressure == pytest.approx(0.0)
    hardware.bus.counts = [1101]
    assert hal.sample(1.5).pressure == pytest.approx(0.0703)  # one step of the recordings
    hardware.bus.counts = [1500, 0, 1501]
    assert hal.sample(2.0).pressure == pytest.approx(400 * 0.0703)  # spikes are cut
    highest = hal.identity.highest  # the converter ends before the sensor, of 70.3 cmH2O
    assert highest == pytest.approx((2.047 * 2 - 2.2) * 35.15)
    hardware.bus.counts = [1100 + int(0.98 * highest / 0.0703)]
    assert not hal.sample(2.0).saturated
    hardware.bus.counts = [LAST]
    assert hal.sample(2.0).saturated
    for nothing in ([0], [-5]):
        hardware.bus.counts = nothing
        assert math.isnan(hal.sample(3.0).pressure)
    hardware.bus.broken = True
    assert math.isnan(hal.sample(4.0).pressure)


FLOW = """
[flow]
source = "devices.ini, flow_sensor_ex"
adc_channel = 2
offset_voltage = 2.25
span_voltage = 4.0
largest = 192.6426
exponent = 0.5228
"""


def test_a_flow_sensor_is_an_option(configuration: Path, hardware: SimpleNamespace) -> None:
    plain = PvpSensor(configuration)
    assert plain.identity.capabilities == Capability.NONE
    assert math.isnan(plain.sample(0.0).flow)
    configuration.write_text(CONFIGURATION + RIG + FLOW)
    hal = PvpSensor(configuration)
    assert hal.identity.capabilities == Capability.FLOW
    assert hal.identity.calibration != plain.identity.calibration
    for counts, litres in (
        (1125, 0.0),
        (1625, 192.6426 * 0.25**0.5228),
        (1025, -192.6426 * 0.05**0.5228),
    ):
        hardware.bus.counts = [1100] * 3 + [counts] * 3
        sample = hal.sample(1.0)
        assert sample.pressure == pytest.approx(0.0)
        assert sample.flow == pytest.approx(litres * 1000.0 / 60.0)
    assert hardware.bus.configured[0] >> 4 & 0b111 == 0b101  # the pressure's input is back
    configuration.write_text(CONFIGURATION + RIG + FLOW.replace("channel = 2", "channel = 1"))
    with pytest.raises(InputError, match="another adc_channel"):
        PvpSensor(configuration)


def test_the_measured_response_of_the_ventilators_valve_is_read_as_it_is(
    configuration: Path,
) -> None:
    """Its repository keeps setpoints, %, and duty cycles of both directions as numpy does."""
    rows = np.array([[0.0, 0.0, 0.0], [1.0, 0.38, 0.29], [50.0, 0.69, 0.63], [100.0, 0.96, 0.93]])
    with (configuration.parent / "SMC_response").open("wb") as file:
        np.save(file, rows)
    configuration.write_text((CONFIGURATION + RIG).replace("valve.csv", "SMC_response"))
    table = load_machine(configuration).valve
    assert table.duty(50.0, True) == pytest.approx(0.69)
    assert table.duty(25.5, False) == pytest.approx(0.46)
    assert table.duty(0.0, True) == 0.0


def test_the_valves(configuration: Path, hardware: SimpleNamespace) -> None:
    hal = PvpValves(configuration)
    pi = hardware.pi
    assert pi.levels == {17: 1}  # vented: the valve without current is closed
    assert pi.duties[-1] == (12, 20_000, 0)
    hal.actuate(50.0, 0)
    assert pi.levels == {17: 0}
    assert pi.duties[-1][2] == 500_000
    hal.actuate(75.0, 0)
    assert pi.duties[-1][2] == 700_000
    hal.actuate(25.0, 0)
    assert pi.duties[-1][2] == 300_000  # of the closing curve: 0.2 + 0.1
    pi.told.clear()
    hal.actuate(0.0, 1)
    assert pi.told == ["expiratory", "inspiratory"]
    assert pi.duties[-1][2] == 0
    hal.actuate(0.0, 1)
    assert len(pi.told) == 2  # nothing is told twice
    hal.actuate(30.0, 0)
    hal.close()
    assert (pi.levels[17], pi.duties[-1][2], pi.stopped) == (1, 0, True)


def test_a_normally_open_valve_is_turned_around(
    configuration: Path, hardware: SimpleNamespace
) -> None:
    configuration.write_text((CONFIGURATION + RIG).replace("open = false", "open = true"))
    PvpValves(configuration)
    assert hardware.pi.levels == {17: 0}


def test_the_heartbeat_pin_moves_with_every_order(
    configuration: Path, hardware: SimpleNamespace
) -> None:
    configuration.write_text((CONFIGURATION + RIG).replace("pin = -1", "pin = 27"))
    valves = PvpValves(configuration)
    levels = []
    for _ in range(4):
        valves.actuate(0.0, 1)
        levels.append(hardware.pi.levels[27])
    assert levels == [0, 1, 0, 1]


def test_systemd_is_told_that_the_program_is_ready_and_awake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert board.notifier()() is False  # without systemd
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "20000")
        awake = board.notifier()
        assert systemd.recv(100) == b"READY=1"
        for _ in range(2):
            time.sleep(0.006)
            assert awake() is False
            assert systemd.recv(100) == b"WATCHDOG=1"


def test_identity_changes_with_everything_but_the_name(
    configuration: Path, hardware: SimpleNamespace
) -> None:
    first = PvpSensor(configuration).identity
    assert (first.name, first.device_id.hex()) == ("bench 3", "0123456789abcdef")
    changes = [("bench 3", "bench 4"), ("= 17", "= 27"), ("2.2", "2.25"), ("= 12", "= 13")]
    seen = []
    for old, new in [*changes, ("open = false", "open = true"), ("20000", "1000")]:
        configuration.write_text((CONFIGURATION + RIG).replace(old, new))
        seen.append(PvpSensor(configuration).identity.calibration)
    assert seen[0] == first.calibration
    assert len(set(seen)) == len(seen)
    (configuration.parent / "valve.csv").write_text(TABLE.replace("0.90", "0.91"))
    assert PvpSensor(configuration).identity.calibration not in seen


def test_the_known_machines_are_whole(configuration: Path) -> None:
    """Each revision of the data and each sensor passes the checks of a configuration."""
    known = tomllib.loads((Path(board.__file__).parent / "revisions.toml").read_text())
    for name, wiring in known["revisions"].items():
        text = CONFIGURATION.replace("test rig", name)
        configuration.write_text(text)
        machine = load_machine(configuration)
        assert (machine.wiring.inspiratory_pin, machine.part.range) == (12, 70.3)
        assert wiring["sensor"] in known["sensors"]


@pytest.mark.parametrize("key", [*CONFIGURATION.split("\n"), *RIG.split("\n")[2:]])
def test_nothing_about_a_machine_has_a_default(
    configuration: Path, hardware: SimpleNamespace, key: str
) -> None:
    if not key:
        return
    configuration.write_text((CONFIGURATION + RIG).replace(key + "\n", ""))
    with pytest.raises(InputError, match=f"{key.split(' ')[0]} is missing"):
        PvpValves(configuration)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("= 17", "= 12", r"are both GPIO 12"),
        ("= 12", "= 17", r"are both GPIO 17"),
        ("pin = -1", "pin = 17", r"are both GPIO 17"),
        ("= 12", "= 22", "no hardware PWM"),
        ("= 17", "= 3", "no free GPIO"),
        ("_channel = 1", "_channel = 7", r"outside 0\.\.3"),
        ("_channel = 1", '_channel = "1"', "must be a int"),
        ("open = false", "open = 0", "must be a bool"),
        ('"0123456789abcdef"', '"01"', "16 hexadecimal"),
        ('"wired for this test"', '""', "source is empty"),
        ('"test rig"\n', '"other rig"\n', "describe yours in a table"),
        ('[revisions."test rig"]', '[revisions."actuators-rev2"]', "known otherwise"),
        ("name =", "colour = 1\nname =", "no key 'colour'"),
        # The sensor that earlier versions assumed: range of one part, slope of another.
        ("1 PSI-D-4V-MINI", "20 INCH-G-P4V-MINI", "offset_voltage = 2.2 is not of a 20 INCH"),
        ("35.15", "12.7", "cmH2O_per_volt = 12.7 is not of a 1 PSI"),
        ("= 50.0", "= 66.6", "nothing could trip it"),
        ("= 50.0", "= 0.0", "outside"),
        ("name =", "= 1", "pvp.toml"),
    ],
)
def test_what_cannot_be_is_refused(
    configuration: Path, hardware: SimpleNamespace, old: str, new: str, message: str
) -> None:
    assert old in CONFIGURATION + RIG
    configuration.write_text((CONFIGURATION + RIG).replace(old, new))
    with pytest.raises(InputError, match=message):
        PvpSensor(configuration)
    assert board.main(["--config", str(configuration), "--vent"]) == 2
    assert not hardware.pi.levels  # no pin was touched


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("u_in,opening,closing\n0,0,0\n90,1,1\n", "0 to 100"),
        ("u_in,opening,closing\n0,0,0\n100,1.1,1\n", "leaves"),
        ("u_in,opening\n0,0\n100,1\n", "closing"),
    ],
)
def test_a_wrong_valve_table_is_refused(configuration: Path, table: str, message: str) -> None:
    (configuration.parent / "valve.csv").write_text(table)
    with pytest.raises(InputError, match=message):
        load_machine(configuration)


def test_missing_packages_and_hardware_say_what_to_do(
    configuration: Path,
    hardware: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    hardware.pi.connected = False
    with pytest.raises(InputError, match="sudo pigpiod"):
        PvpValves(configuration)
    monkeypatch.setitem(sys.modules, "pigpio", None)
    with pytest.raises(InputError, match="pip install"):
        PvpValves(configuration)
    assert board.main(["--config", str(configuration), "--vent"]) == 2
    assert "pip install" in capsys.readouterr().err


def test_the_board_vents_once(configuration: Path, hardware: SimpleNamespace) -> None:
    assert board.main(["--config", str(configuration), "--vent"]) == 0
    assert hardware.pi.levels == {17: 1}


def test_the_board_serves_one_host_after_another() -> None:
    """What the board does when a host hangs up."""
    server = socket.create_server(("127.0.0.1", 0))
    server.setblocking(False)

    def open_line() -> int | None:
        try:
            connection, _ = server.accept()
        except BlockingIOError:
            return None
        connection.setblocking(False)
        return connection.detach()

    bench = Bench()
    service = DeviceService(bench, time.monotonic())
    stop = threading.Event()
    port = Port(open_line, os.close)
    thread = threading.Thread(target=Guard(service, port).run, args=(stop.is_set,))
    thread.start()
    url = f"socket://127.0.0.1:{server.getsockname()[1]}"
    try:
        for _ in range(2):
            client = Client(Link(url), timeout=600.0)
            assert client.hello().name == "bench"
            assert client.arm().mode is Mode.RUNNING
            client.transport.close()
    finally:
        stop.set()
        thread.join()
        port.close()
        server.close()
    assert bench.valves[-1][1:] == (0.0, 1)


def test_a_serial_line_that_is_not_there_is_waited_for(tmp_path: Path) -> None:
    assert board.open_serial(str(tmp_path / "none")) is None
    master, slave = os.openpty()
    line = board.open_serial(os.ttyname(slave))
    assert line is not None
    os.write(line, b"\0x\0")
    assert os.read(master, 10) == b"\0x\0"
    for descriptor in (line, master, slave):
        os.close(descriptor)


#: The ventilator's two packages, as files that a process of its own imports.
STAND_INS = {
    "pigpio.py": (
        "OUTPUT = 1\nclass pi:\n connected = True\n"
        " def __getattr__(self, name): return lambda *values: None\n"
    ),
    "smbus2.py": (
        "class SMBus:\n def __init__(self, number): pass\n"
        " def write_i2c_block_data(self, *values): pass\n"
        " def read_i2c_block_data(self, *values): return [0x45, 0xD0]\n"  # 1117 counts: 1.2 cmH2O
        " def close(self): pass\n"
    ),
}


def test_the_program_runs_on_the_packages_of_its_own_list_alone(
    configuration: Path, tmp_path: Path
) -> None:
    """Neither JAX nor anything else that only the benchmark needs can be imported."""
    root = Path(board.__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    names = {"cobs", "numpy", "pigpio", "pyserial", "smbus2"}
    assert {re.split("[>=]", x)[0] for x in project["dependency-groups"]["device"]} == names
    listed = (root / "hardware_eval/device/requirements.txt").read_text()
    assert set(re.findall(r"^([\w-]+)==", listed, re.M)) == names
    blocked = {re.split("[>=]", x)[0].replace("-", "_") for x in project["project"]["dependencies"]}
    blocked = (blocked | {"jaxlib", "distributed", "rerun"}) - names
    for name, text in STAND_INS.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "sitecustomize.py").write_text(
        f"import sys\nsys.modules.update(dict.fromkeys({sorted(blocked)}))\n"
    )
    master, slave = os.openpty()
    tty.setraw(master)
    words = ["--config", str(configuration), "--port", os.ttyname(slave)]
    program = subprocess.Popen(
        [sys.executable, "-m", "hardware_eval.device", *words],
        cwd=root,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{root}"},
        stderr=subprocess.PIPE,
    )
    try:
        hello = encode(Packet(7, 1, Hello(PROTOCOL_VERSION, None)))
        answer, end = b"", time.monotonic() + 60.0
        while b"bench 3" not in answer and time.monotonic() < end and program.poll() is None:
            os.write(master, hello)
            if select.select([master], [], [], 0.5)[0]:
                answer += os.read(master, 1000)
        program.terminate()
        _, said = program.communicate(timeout=60)
        assert b"bench 3" in answer, said.decode()
    finally:
        program.kill()
        program.wait()
        for descriptor in (master, slave):
            os.close(descriptor)
