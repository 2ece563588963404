"""Few conditions on six lungs, shared so that they are compiled once."""

from __future__ import annotations

import pytest

from ventbench.entries.folder import submission_of
from ventbench.plants.rigs import load_rigs
from ventbench.stress.run import StressDraws, draw_cells
from ventbench.stress.score import StressScore, chosen_conditions, run_stress
from ventbench.stress.stressors import Condition

#: Stressors of the shared run.
NAMES = ("leak", "sensor_low", "disconnection")


class Controller:
    """A PI controller."""

    def reset(self, task: object) -> None:
        self.task, self.integral = task, 0.0

    def act(self, observation: object) -> float:
        if observation.time == 0:  # type: ignore[attr-defined]
            self.integral = 0.0
        error = observation.target - observation.pressure  # type: ignore[attr-defined]
        dt = observation.dt  # type: ignore[attr-defined]
        self.integral += dt / (dt + 0.5) * (error - self.integral)
        return 2.0 * error + 4.0 * self.integral


@pytest.fixture(scope="session")
def chosen() -> tuple[Condition, ...]:
    return chosen_conditions(NAMES)


@pytest.fixture(scope="session")
def draws() -> StressDraws:
    return draw_cells(load_rigs(), 1)


@pytest.fixture(scope="session")
def score(draws: StressDraws, chosen: tuple[Condition, ...]) -> StressScore:
    return run_stress(submission_of(Controller), draws, chosen)
