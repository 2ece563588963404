"""The scripts of examples/ run as they stand."""

import ast
import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest

import ventbench
from ci.notebooks import NOTEBOOKS, executed, shown
from ventbench.controllers.pid import PID
from ventbench.task.interfaces import Observation

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))

#: Arguments that make a script short, and packages that no extra of ventbench brings: their scripts
#: run where somebody has installed them (the weekly workflow does).
SHORT = {"beat_the_pid": ["3"], "train_ppo_jax": ["2"], "train_stable_baselines3": ["5"]}
NEEDS = {"train_stable_baselines3": "stable_baselines3"}
RUNNABLE = [
    path for path in SCRIPTS if path.stem not in NEEDS or importlib.util.find_spec(NEEDS[path.stem])
]


def test_the_readme_lists_every_script():
    listed = (ROOT / "examples" / "README.md").read_text("utf-8")
    assert len(SCRIPTS) >= 4
    assert len(NOTEBOOKS) == 2
    paths = [*SCRIPTS, *NOTEBOOKS]
    assert not [path.name for path in paths if f"[{path.name}]({path.name})" not in listed]


def as_script(notebook: Path) -> str:
    """Its code cells in order."""
    found = json.loads(notebook.read_text("utf-8"))
    assert (found["nbformat"], found["nbformat_minor"]) == (4, 5)
    parts = []
    for cell in found["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] or cell is found["cells"][1], "store outputs: ci/notebooks.py"
            parts.append(re.sub(r"(?m)^%.*$", "", "".join(cell["source"])))
    return "\n".join(parts)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_call_what_there_is(notebook):
    """Quickly; the whole run is below."""
    calls = [
        node for node in ast.walk(ast.parse(as_script(notebook))) if isinstance(node, ast.Call)
    ]
    ours = 0
    for call in calls:
        name = ast.unparse(call.func)
        if name.startswith("ventbench."):
            function = getattr(ventbench, name.removeprefix("ventbench."))
            keywords = {x.arg: None for x in call.keywords if x.arg}
            inspect.signature(function).bind(*call.args, **keywords)
            ours += 1
    assert ours >= 4


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
@pytest.mark.filterwarnings("default")  # of Jupyter's own, about its loop and its sockets
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_show_what_is_stored(notebook, tmp_path):
    stored = nbformat.read(notebook, as_version=4)
    assert shown(executed(notebook, tmp_path)) == shown(stored)
    assert "image/png" in str(nbformat.read(NOTEBOOKS[0], as_version=4))
    assert (tmp_path / "runs").is_dir()


@pytest.mark.slow
@pytest.mark.parametrize("script", RUNNABLE, ids=lambda path: path.stem)
def test_each_runs(script, tmp_path):
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
