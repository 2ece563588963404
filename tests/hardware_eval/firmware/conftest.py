"""The core under the address and undefined-behaviour sanitizers, compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hardware_eval.firmware.core import SANITIZED, compiled


@pytest.fixture(scope="session")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("core") / "harness", "harness.c", *SANITIZED)
