"""An entry that learns between breaths: the scheduled PID."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ventbench.base.files import submissions_folder
from ventbench.sandbox.child.cell import controller_class
from ventbench.task.interfaces import Observation, Task

DT, STEPS, PIP = 0.03, 34, 25.0


def _breaths(controller: Any, elastance: float, resistance: float, count: int) -> np.ndarray:
    """Pressure of breaths of a linear lung behind a linear valve, without noise, cmH2O."""
    out = np.zeros((count, STEPS))
    for breath in range(count):
        volume, pressure, command = 0.0, 5.0, 5.0
        for step in range(STEPS):
            out[breath, step] = pressure
            seen = Observation(step * DT, DT, pressure, PIP, (PIP,) * 10, command)
            command = min(max(controller.act(seen), 0.0), 100.0)
            flow = 0.02 * command
            volume += flow * DT
            pressure = 5.0 + elastance * volume + resistance * flow
    return out


def _controller(name: str) -> Any:
    controller = controller_class(submissions_folder() / name)()
    controller.reset(Task("robustness", None, DT, STEPS))
    return controller


@pytest.mark.parametrize(
    ("stiff", "soft"), [((100.0, 6.0), (20.0, 6.0)), ((60.0, 20.0), (60.0, 4.0))]
)
def test_the_scheduled_pid_tells_lungs_apart(stiff, soft):
    controllers = [_controller("pid_scheduled") for _ in range(2)]
    for controller, lung in zip(controllers, (stiff, soft), strict=True):
        _breaths(controller, lung[0], lung[1], 3)
    assert not np.allclose(controllers[0].gains, controllers[1].gains, rtol=0.2)
    inside = controllers[0].lungs["gains"]
    for controller in controllers:
        assert (controller.gains >= inside.min(axis=0) * 0.999).all()
        assert (controller.gains <= inside.max(axis=0) * 1.001).all()
