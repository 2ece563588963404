"""One emulated device on a virtual clock, compiled once; each test gets it healthy and vented."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hardware_eval.bench.loop import Bench, Operator
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.results.evaluate import Line
from hardware_eval.wire.client import Client
from tests.hardware_eval.faults import FaultyDevice, faulty_lung

LUNG = "R5C20"


@pytest.fixture
def scored_only(tmp_path: Path) -> Path:
    """A plan of scored runs alone."""
    path = tmp_path / "plan.toml"
    path.write_text("control_every = 0\ndry_run = false\nselftest = false\nrest = 0.5\n")
    return path


@pytest.fixture(scope="session")
def shared_device() -> FaultyDevice:
    return FaultyDevice(faulty_lung(LUNG, "physics"))


@pytest.fixture
def device(shared_device: FaultyDevice) -> Iterator[FaultyDevice]:
    hal: Any = shared_device.service.hal
    yield shared_device
    hal.faults = shared_device.line.faults = ()
    hal.disturb("")
    shared_device.plug()
    shared_device.clock.advance(6.0)  # the watchdog vents, and the lung empties


@pytest.fixture
def line(device: FaultyDevice) -> Line:
    client = Client(device, device.clock)
    client.hello()
    return Line(client, device.clock)


@pytest.fixture
def bench(line: Line) -> Bench:
    return Bench(line.client, line.clock, DEFAULT, Operator(), rest=2.0)
