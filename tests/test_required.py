"""Where every test has to run, one that skips has failed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import NO_RECORDINGS, REQUIRED
from ventbench.recordings.read import VARIABLE

ROOT = Path(__file__).parents[1]
HOOKS = "from tests.conftest import pytest_make_collect_report, pytest_runtest_makereport\n"
INSIDE = "import pytest\n@pytest.mark.xfail\ndef test_x():\n    pytest.xfail()\n"
SKIPS = f"{INSIDE}def test():\n    pytest.skip({{!r}})\n"
WHOLE = "import pytest\npytest.skip('no tool', allow_module_level=True)\n"


@pytest.mark.parametrize(
    ("source", "environment", "failed"),
    [
        (SKIPS.format("no tool"), {REQUIRED: "1"}, True),
        (SKIPS.format("no tool"), {}, False),
        (WHOLE, {REQUIRED: "1"}, True),
        (INSIDE, {REQUIRED: "1"}, False),
        (SKIPS.format(NO_RECORDINGS), {REQUIRED: "1"}, False),
        (SKIPS.format(NO_RECORDINGS), {REQUIRED: "1", VARIABLE: "here"}, True),
    ],
)
def test_a_skip_fails(
    source: str, environment: dict[str, str], failed: bool, tmp_path: Path
) -> None:
    (tmp_path / "conftest.py").write_text(HOOKS)
    (tmp_path / "test_it.py").write_text(source)
    (tmp_path / "pytest.ini").write_text("[pytest]")
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_it.py"],
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
    )
    assert (ran.returncode == 1 or ran.returncode == 2) == failed, ran.stdout + ran.stderr
    assert (f"did not run, and {REQUIRED} is set" in ran.stdout) == failed
