"""Both devices follow PROTOCOL.md, by a judge that knows neither; and its frames, byte by byte."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hardware_eval import cli
from hardware_eval.device.program import DeviceService, Identity
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.results import evaluate
from hardware_eval.wire.client import NoAnswerError
from hardware_eval.wire.conformance import CLAUSES, NOT_TRIED, Clause, conformance
from hardware_eval.wire.messages import Capability, Packet, feed_bytes
from tests.hardware_eval.firmware.core import CoreService, loopback
from tests.hardware_eval.stand_in import Bench
from ventbench.task import protocol

PROTOCOL = Path(__file__).parents[3] / "hardware_eval" / "PROTOCOL.md"


def _failed(clauses: list[Clause]) -> list[str]:
    return [str(clause) for clause in clauses if clause.holds is False]


def test_the_python_device_conforms() -> None:
    device = LoopbackDevice(Bench())
    clauses = conformance(device, device.clock)
    assert not _failed(clauses)
    tried = [clause for clause in clauses if clause.holds]
    assert len(tried) == len(CLAUSES)
    assert len(clauses) == len(CLAUSES) + len(NOT_TRIED)


def test_the_firmware_conforms(harness: Path) -> None:
    with loopback(harness, Bench()) as device:
        clauses = conformance(device, device.clock)
    assert not _failed(clauses)
    assert sum(clause.holds is True for clause in clauses) == len(CLAUSES)


def test_a_device_at_ambient_pressure_leaves_a_line_untried() -> None:
    device = LoopbackDevice(Bench(pressure=0.0))
    clauses = conformance(device, device.clock)
    assert not _failed(clauses)
    assert ["needs more than 0.5" in x.detail for x in clauses if x.holds is None].count(True) == 1


def test_nobody_there_is_an_error() -> None:
    device = LoopbackDevice(Bench())
    device.write = lambda data: None  # type: ignore[method-assign]
    with pytest.raises(NoAnswerError, match="does not answer a hello"):
        conformance(device, device.clock)


def test_the_command_says_what_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "verdict.json"
    device = LoopbackDevice(Bench())
    monkeypatch.setattr(evaluate, "carrier", lambda port: (device, device.clock))
    done = CliRunner().invoke(cli.app, ["conformance", "--port", "virtual:p", "--json", str(out)])
    assert done.exit_code == 0, done.output
    assert f"{len(CLAUSES)} hold, 0 fail, {len(NOT_TRIED)} not tried" in done.output
    verdict = json.loads(out.read_text())
    assert verdict["holds"] is True
    assert [x["text"] for x in verdict["clauses"]][: len(CLAUSES)] == [text for text, _ in CLAUSES]


def test_a_line_that_fails_is_the_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    device = LoopbackDevice(Bench(), latency=0.012)
    monkeypatch.setattr(evaluate, "carrier", lambda port: (device, device.clock))
    done = CliRunner().invoke(cli.app, ["conformance", "--port", "virtual:p"])
    assert done.exit_code == 1
    assert re.search(r"FAILS +answers come within 5 ms \(duty 6\): half of the .*", done.output)


@pytest.mark.parametrize("device", ["python", "firmware"])
def test_a_device_answers_the_table_byte_by_byte(harness: Path, device: str) -> None:
    row = r"^\| (?:host|device) \| (\w+) \| `([0-9a-f]+)` \|$"
    rows = re.findall(row, PROTOCOL.read_text("utf-8"), re.M)
    assert len(rows) == 16
    for name, frame in rows:
        _, (packet,) = feed_bytes(None, bytes.fromhex(frame))
        assert isinstance(packet, Packet)
        assert type(packet.message).__name__.lower() == name
    bench = Bench(identity=Identity("bench", b"12345678", bytes(range(32)), Capability.NONE))
    now = 1.234567
    service: DeviceService | CoreService
    if device == "python":
        service = DeviceService(bench, now)
    else:
        service = CoreService(harness, bench, now, protocol.SAFETY_PRESSURE)
    for (_, asked), (_, answered) in zip(rows[::2], rows[1::2], strict=True):
        assert service.step(now, bytes.fromhex(asked)).hex() == answered
    if isinstance(service, CoreService):
        service.core.end()
