"""The closed loop: controllers planned on a simulator, and the whole of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hardware_eval.bench.controllers import SubmissionController
from hardware_eval.demo import (
    GAINS,
    PlannedController,
    demo,
    emulated_line,
    errors_on,
    plan_controller,
)
from hardware_eval.emulation.simulated import conceal
from ventbench.controllers.pid import TIME_CONSTANT
from ventbench.entries.cells import InProcessRunner
from ventbench.entries.folder import open_submission
from ventbench.physics.model import physics
from ventbench.task.interfaces import Plant, Task
from ventbench.task.lungs import lung

LUNG, PIPS = "R20C10", (10.0, 20.0)


def test_a_written_entry_sends_its_plan_and_answers_what_is_missing(tmp_path: Path) -> None:
    commands, pressures = np.array([[40.0, 8.0], [80.0, 16.0]]), np.array([[5.0, 9.0], [5.0, 18.0]])
    planned = PlannedController(PIPS, commands, pressures)
    assert planned.error == pytest.approx((5.0 + 1.0 + 15.0 + 2.0) / 4)
    submission = open_submission(str(planned.write(tmp_path, "planned")))
    assert submission.manifest.name == "planned"
    task = Task("performance", LUNG, 0.03, 34)
    controller = SubmissionController(InProcessRunner(), submission, task)

    def answer(step: int, pressure: float, pip: float) -> float | None:
        row = [step * 0.03 + 0.001 * (step > 0), 0.03, pressure, pip, *[pip] * 10, 5.0]
        return controller.act(np.array([row]), 1.0)

    P, I = GAINS  # noqa: E741 - the field's names
    share = 0.03 / (0.03 + TIME_CONSTANT)
    assert answer(0, 5.0, 10.0) == pytest.approx(40.0)
    assert answer(1, 8.0, 10.0) == pytest.approx(8.0 + P + I * share)
    # A new breath begins anew; half way between two PIPs the plan is half way too.
    assert answer(0, 4.0, 15.0) == pytest.approx(60.0 + P + I * share)
    # Beyond the plan, in PIP and in time, its nearest value holds.
    assert answer(7, 18.0, 35.0) == pytest.approx(16.0 + I * share * (1.0 - share))
    controller.close()


@pytest.mark.slow
def test_what_the_simulator_lacks_costs_and_a_plan_with_it_does_better(tmp_path: Path) -> None:
    plain: Plant = physics(lung(LUNG))
    # A valve that lags has a state of several values for each lung.
    true: Plant = physics(
        lung(LUNG), {"turbulent_resistance": {"quadratic": 11.0}, "valve_lag": {"tau": 0.02}}
    )
    line = emulated_line(true, LUNG)
    planned = {name: plan_controller(x, PIPS) for name, x in (("plain", plain), ("true", true))}
    errors = {}
    for name, controller in planned.items():
        entry, out = controller.write(tmp_path, name), tmp_path / f"{name}_run"
        errors[name] = errors_on(line, entry, LUNG, PIPS, out, sandbox=False)
        assert sorted(errors[name]) == list(PIPS)
    mean = {name: np.mean(list(by_pip.values())) for name, by_pip in errors.items()}
    assert mean["plain"] > 1.3 * planned["plain"].error
    assert mean["true"] < 0.8 * mean["plain"]
    # What is left beside the plan is noise, and a lung that has not emptied since the last breath.
    assert mean["true"] == pytest.approx(planned["true"].error, abs=0.25)


@pytest.mark.slow
def test_the_loop_closes(tmp_path: Path) -> None:
    words = "monday"  # the words that the command has if none are given
    out = tmp_path / "demo"
    done = demo(words, out, breaths=36, simulator="physics", sandbox=False, tell=print)
    hidden = conceal(words, "physics")
    effect = hidden.effect
    assert (hidden.lung.id, effect.name) == (done.lung, "leak")
    figures = json.loads((out / "demo.json").read_text())
    assert figures["truth"]["name"] == effect.name
    assert figures["steps"] == list(done.steps)
    assert effect.name.replace("_", " ") in done.steps[-1]
    mean = {x: np.mean(list(getattr(done, x).values())) for x in ("simulated", "measured")}
    assert mean["measured"] > mean["simulated"]
    # The sensor's noise and converter alone give 0.08.
    assert done.open_loop_mae["after"] < min(0.2, done.open_loop_mae["refit"])
    assert done.better
    assert done.right
    assert len(done.named) <= 2
