"""What every test may ask for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ventbench.recordings.read import VARIABLE, recordings_dir

#: Set by `.ci/run` where the recordings are: then no test may skip for want of them.
REQUIRED = "VENTBENCH_REQUIRE_RECORDINGS"


@pytest.fixture(scope="session")
def public_recordings() -> Path:
    """Folder of the public recordings; the test is skipped where they are not."""
    folder = recordings_dir()
    if folder is None:
        missing = f"no public recordings: set {VARIABLE} to their folder"
        if os.environ.get(REQUIRED):
            pytest.fail(f"{missing} ({REQUIRED} is set)")
        pytest.skip(missing)
    return folder
