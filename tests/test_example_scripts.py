"""The scripts of examples/ run as they stand."""

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.controllers.pid import PID
from ventbench.task.interfaces import Observation

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))

#: Arguments that make a script short, and what it needs besides ventbench.
SHORT = {"beat_the_pid": ["3"], "train_ppo_jax": ["2"], "train_stable_baselines3": ["5"]}
NEEDS = {"train_stable_baselines3": "stable_baselines3"}


def test_the_readme_lists_every_script():
    listed = (ROOT / "examples" / "README.md").read_text("utf-8")
    assert len(SCRIPTS) >= 4
    assert not [path.name for path in SCRIPTS if f"[{path.name}]({path.name})" not in listed]


def test_the_corrected_pid_without_a_correction_is_the_pid():
    """Of the script that needs another library: the class that it puts into its submission."""
    tree = ast.parse((ROOT / "examples" / "train_stable_baselines3.py").read_text("utf-8"))
    (written,) = [node for node in tree.body if getattr(node, "name", "") == "CorrectedPID"]
    names: dict[str, Any] = {"np": np}
    exec(compile(ast.Module([written], []), "example", "exec"), names)
    corrected, alone = names["CorrectedPID"](), PID(*names["CorrectedPID"].GAINS)
    rng, state, before = np.random.default_rng(0), alone.init((3,)), np.zeros(3)
    for k in range(40):
        target, pressure = np.full(3, 25.0), rng.uniform(5.0, 30.0, 3)
        time, dt = 0.03 * (k % 33), 0.03  # a second breath begins after 33 steps
        ahead = np.tile(target[:, None], 10)
        x = [pressure / 40, target / 40, *(ahead.T / 40), before / 50 - 1]
        seen = corrected.see(np.stack([*x, np.full(3, time), np.full(3, dt / 0.03)], axis=-1))
        assert seen.shape == (3, 26)
        observation = Observation(time, dt, pressure, target, ahead, before)
        state, wanted = alone.step(state, observation)
        before = corrected.command(np.zeros(3))
        np.testing.assert_allclose(before, np.clip(wanted, 0.0, 100.0), rtol=1e-5, atol=1e-5)
    larger = corrected.command(np.full(3, 0.2))
    np.testing.assert_allclose(larger, np.clip(corrected.pid + 10.0, 0.0, 100.0))


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
