"""The stress score: figures, intervals, failures, JSON, chart and command."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.stress.conftest import NAMES, Controller
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.entries.errors import SubmissionError
from ventbench.entries.folder import open_submission, submission_of
from ventbench.plants.rigs import load_rigs
from ventbench.stress.run import StressDraws, StressRun, draw_cells
from ventbench.stress.score import StressScore, assess, chosen_conditions, run_stress
from ventbench.stress.stressors import Condition
from ventbench.task.interfaces import Task


def _made(draws: StressDraws, pressure: np.ndarray) -> StressScore:
    """The score of given pressures above PIP, (S, L, n, 3, 34), without a controller."""
    pip = np.asarray(draws.scenario.pip)[..., None, None]
    zero = np.zeros_like(pressure)
    run = StressRun(pip + pressure, zero, zero, zero + 1.0, {})
    chosen = chosen_conditions(NAMES)[: len(pressure)]
    return assess(run, draws, chosen, submission=submission_of(Controller))


def test_figures_of_pressures_that_are_known(draws: StressDraws) -> None:
    above = np.zeros((3, 6, 1, 3, 34))
    above[1, :, :, 1:] = 1.0  # within the tolerance, breaths 2 and 3
    above[2, :3, :, 2, -10:] = 20.0  # unsafe at the end of breath 3, three lungs
    score = _made(draws, above)
    np.testing.assert_allclose(score.error[1], 1.0)
    np.testing.assert_allclose(score.error[2, :3], 20.0 * 10 / 68)
    assert score.unstressed == 0.0
    assert score.score == pytest.approx((1.0 + 0.5 * 20.0 * 10 / 68) / 2)
    np.testing.assert_array_equal(score.survived[2, :, 0], [False] * 3 + [True] * 3)
    np.testing.assert_array_equal(score.safe[2], score.survived[2])
    assert score.survived_share == 0.75
    assert np.all(score.alarm_s[2, :3] > 0.25)


def test_the_plateau_may_be_off_by_2_cmH2O_and_4_percent(draws: StressDraws) -> None:
    allowed = 2.0 + 0.04 * np.asarray(draws.scenario.pip)[..., None, None]
    for share, held in ((0.99, True), (1.01, False)):
        score = _made(draws, np.stack([np.zeros((6, 1, 3, 34)), -share * allowed + np.zeros(34)
                                       [None, None, None] + np.zeros((6, 1, 3, 34))]))  # fmt: skip
        assert np.all(score.survived[1] == held)


def test_an_interval_needs_two_draws_and_holds_the_mean(score: StressScore) -> None:
    assert all(math.isnan(x) for x in score.interval(score.error[0]))
    cells = draw_cells(load_rigs(), 6)
    drawn = {"rig": cells.drawn.rig, "member": cells.drawn.member, "pips": cells.nominal_pip}
    six = dataclasses.replace(score, **drawn)
    lung, noise = np.arange(6.0)[:, None], np.random.default_rng(0).normal(size=(6, 6))
    low, high = six.interval(lung + 0.1 * cells.nominal_pip)
    assert high - low < 1e-9  # lungs and PIPs are no chance
    low, high = six.interval(lung + 0.1 * cells.nominal_pip + noise)
    mean = 2.5 + 2.25 + noise.mean()
    assert low < mean < high
    assert high - low > 0.5 * 2 * 1.96 * noise.std() / 6


def test_a_difference_is_paired(score: StressScore) -> None:
    cells = draw_cells(load_rigs(), 6)
    error = np.random.default_rng(1).uniform(1.0, 9.0, (len(score.conditions), 6, 6))
    drawn = {"rig": cells.drawn.rig, "member": cells.drawn.member, "pips": cells.nominal_pip}
    one = dataclasses.replace(score, **drawn, error=error)
    two = dataclasses.replace(one, error=error + 0.25)
    difference, (low, high) = two.difference(one)
    assert (difference, low, high) == pytest.approx((0.25, 0.25, 0.25))
    with pytest.raises(InputError, match="different"):
        two.difference(score)


def test_the_controller_is_not_told(draws: StressDraws, chosen: tuple[Condition, ...]) -> None:
    seen: set[Task] = set()

    class Watching(Controller):
        def reset(self, task: object) -> None:
            super().reset(task)
            seen.add(task)  # type: ignore[arg-type]

    run_stress(submission_of(Watching), draws, chosen)
    assert {(task.track, task.lung) for task in seen} == {("robustness", None)}


def test_a_failure_fails_its_cells_and_the_score(
    draws: StressDraws, chosen: tuple[Condition, ...]
) -> None:
    class Failing(Controller):
        def act(self, observation: object) -> float:
            if observation.pressure > 40.0:  # type: ignore[attr-defined]
                raise ValueError("too much")
            return 100.0

    score = run_stress(submission_of(Failing), draws, chosen)
    assert score.failures
    assert math.isnan(score.score)
    assert not any(score.survived[cell] for cell in score.failures)
    values = score.to_json()
    assert values["score"] is None
    assert values["failures"][0]["condition"] == chosen[min(score.failures)[0]].id
    assert "failed in" in str(score)


def test_json_and_tables_say_the_same(score: StressScore, tmp_path: Path) -> None:
    values = json.loads(json.dumps(score.to_json()))
    assert values["score"] == score.score
    assert values["track"] == "stress"
    assert not values["complete"]
    rows = values["conditions"]
    assert [row["condition"] for row in rows] == [c.id for c in score.conditions]
    assert np.mean([row["error_cmH2O"] for row in rows[1:]]) == pytest.approx(score.score)
    assert np.mean([row["rise_cmH2O"] for row in rows[1:]]) == pytest.approx(values["rise"])
    frame = score.to_frame()
    assert len(frame) == score.error.size
    worst = max(rows[1:], key=lambda row: row["error_cmH2O"])
    assert values["worst_condition"] == worst["condition"]
    score.save(tmp_path)
    assert json.loads((tmp_path / "stress.json").read_text()) == values
    assert len((tmp_path / "stress.csv").read_text().splitlines()) == 1 + score.error.size


def test_the_chart_has_every_condition(score: StressScore, tmp_path: Path) -> None:
    from ventbench.pages.stress import stress_chart_png, write_stress_chart

    values = score.to_json()
    path = write_stress_chart(tmp_path / "stress.png", [values])
    assert path.read_bytes() == stress_chart_png([values])
    more = stress_chart_png([values, values])
    width = [int.from_bytes(png[16:20], "big") for png in (path.read_bytes(), more)]
    assert width[1] > width[0] + 200


def test_an_entry_that_must_be_told_its_lung_is_refused(
    draws: StressDraws, chosen: tuple[Condition, ...]
) -> None:
    with pytest.raises(SubmissionError, match="does not tell the lung"):
        run_stress(open_submission("pid_best"), draws, chosen)


@pytest.mark.slow
def test_the_command(tmp_path: Path) -> None:
    out = tmp_path / "runs"
    arguments = ["score", "pid_robust", "--track", "stress", "--draws", "1", "--in-process"]
    result = CliRunner().invoke(app, [*arguments, "--out", str(out), "--report", "--json", "-"])
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert json.loads((out / "pid_robust" / "stress.json").read_text()) == values
    assert (out / "stress.png").read_bytes()[:4] == b"\x89PNG"
    assert "all stressors" in result.stderr


@pytest.mark.slow
def test_one_command_gives_all_three_scores(tmp_path: Path) -> None:
    out = tmp_path / "runs"
    arguments = ["score", "pid_robust", "--stress", "--in-process", "--out", str(out)]
    result = CliRunner().invoke(app, [*arguments, "--json", "-"])
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    assert values["score"] > 1.0
    assert values["normalised"]["nominal"] > 100.0
    assert values["stress"]["score"] > values["score"]
    assert values["stress"]["draws"]["count"] == 6
    assert json.loads((out / "pid_robust" / "stress.json").read_text()) == values["stress"]
    assert "Normalised score" in result.stderr
    assert "all stressors" in result.stderr


def test_a_record_of_the_stress_track_needs_all_draws(tmp_path: Path) -> None:
    arguments = ["score", "pid_robust", "--track", "stress", "--draws", "3"]
    result = CliRunner().invoke(app, [*arguments, "--record", str(tmp_path)])
    assert result.exit_code != 0
    assert isinstance(result.exception, InputError)
    assert "--record of the stress track needs 6 draws" in str(result.exception)
