"""Every state of the core is explored; exploration or conformance catches wrong cores."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from hardware_eval.wire.conformance import conformance
from tests.hardware_eval.firmware.core import FIRMWARE, SANITIZED, compiled, loopback
from tests.hardware_eval.stand_in import Bench

#: Wrong cores: name, file, what is replaced there, and by what.
MUTANTS: tuple[tuple[str, str, str, str], ...] = (
    (
        "watchdog of 160 ms",
        "device.c",
        "now - device->fed > DEVICE_WATCHDOG",
        "now - device->fed > 2 * DEVICE_WATCHDOG",
    ),
    (
        "vents with the expiratory valve closed",
        "device.c",
        "device->u_out = 1;\n    device->causes |=",
        "device->u_out = 0;\n    device->causes |=",
    ),
    (
        "vents at the limit, not above it",
        "device.c",
        "sample->pressure > (int32_t)",
        "sample->pressure >= (int32_t)",
    ),
    ("deaf to the end of the sensor's range", "device.c", " || sample->saturated)", ")"),
    (
        "deaf to a lost sensor",
        "device.c",
        "device->stepped > device->valid + DEVICE_SENSOR_TIMEOUT",
        "0",
    ),
    (
        "heartbeats feed the watchdog",
        "device.c",
        "default: answer_reading",
        "default: device->fed = device->stepped; answer_reading",
    ),
    (
        "stale commands feed the watchdog",
        "device.c",
        "device->counters[COUNT_STALE]++;",
        "device->counters[COUNT_STALE]++; device->fed = device->stepped;",
    ),
    ("old commands are obeyed", "device.c", "age > DEVICE_OLDEST_SEEN", "age > 100 * 100"),
    (
        "commands to come are obeyed",
        "device.c",
        "age > DEVICE_OLDEST_SEEN",
        "(int32_t)age > DEVICE_OLDEST_SEEN",
    ),
    ("a command out of range does not vent", "device.c", "vent(device, FLAG_OUT_OF_RANGE);", ""),
    ("any u_out will do", "device.c", "|| u_out > 1", ""),
    (
        "armed before range",
        "device.c",
        "if (u_in > DEVICE_LARGEST_U_IN || u_out > 1)",
        "if (device->mode == MODE_RUNNING && (u_in > DEVICE_LARGEST_U_IN || u_out > 1))",
    ),
    (
        "strangers may not vent",
        "device.c",
        "if (packet[0] == VENT) {",
        "if (packet[0] == VENT && known) {",
    ),
    (
        "repeated messages are obeyed",
        "device.c",
        "sequence > device->sequence &&",
        "sequence >= device->sequence &&",
    ),
    ("numbers may jump", "device.c", "<= DEVICE_SEQUENCE_WINDOW", "<= 0x7FFFFFFF"),
    (
        "a refused command keeps its number",
        "device.c",
        "device->sequence = sequence;\n    switch",
        "if (packet[0] != COMMAND || device->mode == MODE_RUNNING)\n"
        "        device->sequence = sequence;\n    switch",
    ),
    ("a host raises the limit", "device.c", "limit < identity->pressure_limit", "limit > 0"),
    (
        "a hello does not vent",
        "device.c",
        "    vent(device, 0);\n    device->mode = MODE_READY;",
        "    device->mode = MODE_READY;",
    ),
    ("arming keeps the causes", "device.c", "device->causes = 0;", ""),
    ("arms in danger", "device.c", "if (causes) {\n        vent", "if (0) {\n        vent"),
    (
        "listens before it guards",
        "device.c",
        "if (device->mode == MODE_RUNNING) {",
        "if (device->mode == MODE_RUNNING && length == 0) {",
    ),
    ("strangers may command", "device.c", "if (!known) {", "if (!known && packet[0] != COMMAND) {"),
    (
        "the version comes after the session",
        "device.c",
        "if (packet[0] == HELLO && body[0] != VERSION) {",
        "if (packet[0] == HELLO && body[0] != VERSION && !known) {",
    ),
    (
        "wrong sums are taken",
        "wire.c",
        "return sent == crc32(parser->kept, parser->length) ?",
        "return 1 || sent == crc32(parser->kept, parser->length) ?",
    ),
    (
        "half a block is a frame",
        "wire.c",
        "            return false;",
        "            code = end - from + 1;",
    ),
    (
        "a zero byte inside ends the hearing",
        "wire.c",
        "parser->place = WIRE_BETWEEN;\n    ",
        "parser->place = whole ? WIRE_HUNTING : WIRE_BETWEEN;\n    ",
    ),
    ("framing faults are not counted", "device.c", "device->counters[COUNT_FRAMING]++;", ""),
    ("bodies may be longer", "device.c", "!= body_length(packet[0])", "< body_length(packet[0])"),
)


def _mutated(folder: Path, file: str, right: str, wrong: str) -> Path:
    shutil.copytree(FIRMWARE, folder)
    source = (folder / file).read_text()
    assert source.count(right) == 1, f"{right!r} is {source.count(right)} times in {file}"
    (folder / file).write_text(source.replace(right, wrong))
    return folder


def _explored(program: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(program)], capture_output=True, text=True)


def test_every_reachable_state_vents_within_its_bound(tmp_path: Path) -> None:
    done = _explored(compiled(tmp_path / "explore", "explore.c", *SANITIZED))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "85000 us of silence, 55000 without a sensor, 5000 at its end" in done.stdout
    assert int(done.stdout.split()[0]) > 3000


@pytest.mark.slow
@pytest.mark.parametrize("mutant", MUTANTS, ids=[name for name, *_ in MUTANTS])
def test_a_wrong_core_is_caught(mutant: tuple[str, str, str, str], tmp_path: Path) -> None:
    name, file, right, wrong = mutant
    firmware = _mutated(tmp_path / "firmware", file, right, wrong)
    explorer = compiled(tmp_path / "explore", "explore.c", firmware=firmware, warn=False)
    explored = _explored(explorer)
    caught = [f"exploration ({explored.stdout.strip()})"] if explored.returncode else []
    program = compiled(tmp_path / "harness", "harness.c", firmware=firmware, warn=False)
    with loopback(program, Bench()) as device:
        clauses = conformance(device, device.clock)
    caught += [f"conformance ({x.text}: {x.detail})" for x in clauses if x.holds is False][:1]
    print(f"{name}: {'; '.join(caught)}")
    assert caught, f"nothing catches: {name}"
