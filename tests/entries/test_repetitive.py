"""The entry that learns from breath to breath: that its learning converges, and whither."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from ventbench.base.files import submissions_folder
from ventbench.sandbox.child.cell import controller_class
from ventbench.task.interfaces import Observation, Task

DT, STEPS, PIP = 0.03, 34, 25.0

#: Elastance, cmH2O/L, and resistance, cmH2O s/L, of linear lungs.
LUNGS = [(20.0, 5.0), (50.0, 12.0), (100.0, 20.0)]


def _breath(controller: Any, elastance: float, resistance: float) -> np.ndarray:
    """Pressures of a breath of a linear lung behind a linear valve, without noise, cmH2O."""
    out, volume, pressure, command = np.zeros(STEPS), 0.0, 5.0, 5.0
    for step in range(STEPS):
        out[step] = pressure
        seen = Observation(step * DT, DT, pressure, PIP, (PIP,) * 10, command)
        command = min(max(controller.act(seen), 0.0), 100.0)
        flow = 0.02 * command
        volume += flow * DT
        pressure = 5.0 + elastance * volume + resistance * flow
    return out


def _controller() -> Any:
    controller = controller_class(submissions_folder() / "repetitive")()
    controller.reset(Task("robustness", None, DT, STEPS))
    return controller


@pytest.mark.parametrize(("elastance", "resistance"), LUNGS)
def test_whatever_feed_forward_it_starts_from_learning_ends_at_one(elastance, resistance):
    runs = [_controller(), _controller()]
    for controller in runs:
        _breath(controller, elastance, resistance)
        first = _breath(controller, elastance, resistance)
    runs[1].forward = runs[1].forward + 4.0
    apart = []
    for _ in range(20):
        last = [_breath(controller, elastance, resistance) for controller in runs]
        apart.append(np.linalg.norm(runs[1].forward - runs[0].forward))
    assert (np.diff(apart) <= -0.05 * np.array(apart[:-1])).all()
    np.testing.assert_allclose(last[0], last[1], atol=0.1)
    assert np.abs(last[0] - PIP)[8:].mean() < np.abs(first - PIP)[8:].mean() + 0.05


@pytest.mark.slow
def test_the_learning_converges_on_rigs_that_it_was_not_tuned_on():
    script = submissions_folder() / "repetitive" / "make.py"
    said = subprocess.run([sys.executable, script, "check"], capture_output=True, text=True)
    assert said.returncode == 0, said.stdout + said.stderr
