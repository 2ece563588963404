"""The scripts of examples/ run as they stand."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))

#: Arguments that make a script short, and what it needs besides ventbench.
SHORT = {"beat_the_pid": ["3"], "train_stable_baselines3": ["5"]}
NEEDS = {"train_stable_baselines3": "stable_baselines3"}


def test_the_readme_lists_every_script():
    listed = (ROOT / "examples" / "README.md").read_text("utf-8")
    assert len(SCRIPTS) >= 4
    assert not [path.name for path in SCRIPTS if f"[{path.name}]({path.name})" not in listed]


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_each_runs(script, tmp_path):
    needed = NEEDS.get(script.stem)
    if needed and importlib.util.find_spec(needed) is None:
        pytest.skip(f"needs {needed}, which is no dependency of ventbench")
    for name in ("data", "submissions"):
        (tmp_path / name).symlink_to(ROOT / name)
    ended = subprocess.run(
        [sys.executable, str(script), *SHORT.get(script.stem, [])],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert "cmH2O" in ended.stdout
    assert (tmp_path / "runs").is_dir()
