"""The adaptive entry finds out what lung and what dead time it has."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ventbench.base.files import submissions_folder
from ventbench.sandbox.child.cell import controller_class
from ventbench.task.interfaces import Observation, Task

DT, STEPS, PIP = 0.03, 34, 25.0


def _breaths(controller: Any, elastance: float, resistance: float, late: int) -> np.ndarray:
    """Pressure of three breaths of a linear lung behind the entry's own valve, ``(3, 34)``."""
    rng = np.random.default_rng(0)
    module = __import__("sys").modules[type(controller).__module__]
    out = np.zeros((3, STEPS))
    for breath in range(3):
        commands, volume, pressure = [5.0] * (late + 1), 0.0, 5.0
        for step in range(STEPS):
            out[breath, step] = pressure
            shown = pressure + 0.2 * rng.normal()
            seen = Observation(step * DT, DT, shown, PIP, (PIP,) * 10, commands[-1])
            commands.append(min(max(controller.act(seen), 0.0), 100.0))
            flow = np.interp(commands[-1 - late], module.COMMANDS, module.FLOWS)
            volume += flow * DT
            drop = flow + module.TUNED["bend"] * flow * flow
            pressure = 5.0 + elastance * volume + resistance * drop
    return out


def _controller() -> Any:
    controller = controller_class(submissions_folder() / "adaptive_pid")()
    controller.reset(Task("robustness", None, DT, STEPS))
    return controller


@pytest.mark.parametrize(("elastance", "resistance"), [(20.0, 3.0), (45.0, 12.0), (100.0, 6.0)])
def test_it_identifies_the_lung(elastance: float, resistance: float) -> None:
    controller = _controller()
    pressure = _breaths(controller, elastance, resistance, late=0)
    best = min(controller.filters, key=lambda each: each.cost)
    # The entry allows for an expiratory valve that is closing, which this lung does not have.
    assert best.a == pytest.approx(elastance, rel=0.3)
    assert best.b == pytest.approx(resistance, rel=0.5)
    # The third breath holds the target.
    assert np.abs(pressure[2, 15:] - PIP).mean() < 0.5
    assert np.abs(pressure[2] - PIP).mean() < np.abs(pressure[0] - PIP).mean() + 0.1


@pytest.mark.parametrize("late", [0, 1, 2, 3])
def test_it_finds_the_dead_time(late: int) -> None:
    controller = _controller()
    pressure = _breaths(controller, 45.0, 8.0, late)
    costs = [each.cost for each in controller.filters]
    assert int(np.argmin(costs)) == late
    assert pressure.max() < PIP + 6.0
    assert np.abs(pressure[2, 20:] - PIP).mean() < 1.0


def test_a_tube_that_comes_off_teaches_nothing() -> None:
    controller = _controller()
    _breaths(controller, 45.0, 8.0, late=0)
    before = [(each.a, each.b) for each in controller.filters]
    controller.act(Observation(0.0, DT, 5.0, PIP, (PIP,) * 10, 5.0))
    for step in range(1, 10):
        controller.act(Observation(step * DT, DT, 0.3, PIP, (PIP,) * 10, 100.0))
    assert [(each.a, each.b) for each in controller.filters] == before
