"""The PID grid: against the scorer's rollout, its table, picture, result and command."""

from __future__ import annotations

import io
import json

import jax
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.controllers.pid import PID
from ventbench.entries.cells import protocol_of
from ventbench.entries.folder import submission_of
from ventbench.entries.scoring import run_protocol
from ventbench.plants import frozen
from ventbench.plants.rigs import load_rigs
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack, take
from ventbench.task import draws, protocol, rollouts
from ventbench.task.environment import nominal_scenario
from ventbench.task.lungs import LUNG_IDS, LUNGS
from ventbench.task.metrics.score import run_error
from ventbench.train import pid_search
from ventbench.train.pid_search import PIDGrid
from ventbench.train.plants import plants_to_train_on

GAINS = np.array([(p, i, d) for p in (0.0, 2.0, 5.0) for i in (0.0, 4.0) for d in (0.0, 1.0)])
PLANTS = {lung.id: single_compartment(lung) for lung in LUNGS[:3]}


@pytest.fixture(scope="module")
def whole() -> PIDGrid:
    error = pid_search.errors(stack(list(PLANTS.values())), GAINS)
    return PIDGrid(tuple(PLANTS), protocol.PIPS, GAINS, error)


def test_the_table_is_the_grid(whole, tmp_path):
    whole.save(tmp_path / "grid.parquet")
    found = pd.read_parquet(tmp_path / "grid.parquet")
    assert tuple(found["lung"].unique()) == whole.lungs
    assert (len(found), found.columns[-1]) == (3 * len(GAINS), "error")
    second = found[found["lung"] == whole.lungs[1]]
    np.testing.assert_array_equal(second[["P", "I", "D"]], whole.gains)
    pips = second[[f"error_pip_{pip:g}" for pip in whole.pips]]
    np.testing.assert_array_equal(pips, whole.error[1])
    np.testing.assert_allclose(second["error"], whole.error[1].mean(axis=-1))


def test_the_picture_has_a_row_a_lung_and_one_for_all(whole):
    pytest.importorskip("matplotlib", reason="the extra ventbench[view] is missing")
    from matplotlib.image import imread

    from ventbench.pages.report import gain_map_png

    pictures = [
        gain_map_png(whole),
        gain_map_png(whole),
        gain_map_png(whole, each=False),
    ]
    assert pictures[0] == pictures[1]
    heights = [imread(io.BytesIO(picture)).shape[0] for picture in pictures]
    assert heights[0] > 2 * heights[2]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(pid_search, "paper_gains", lambda: GAINS)


def test_the_command_writes_table_plot_and_result(small, tmp_path):
    """Without draws; the result against the mean over all training rigs by hand."""
    command = ["train", "pid", "--all", "--draws", "0", "--out", str(tmp_path), "--json", "-"]
    run = CliRunner().invoke(app, command)
    assert run.exit_code == 0, run.output
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["best.json", "grid.parquet", "grid.png"]
    result = json.loads((tmp_path / "best.json").read_text())
    assert tuple(result["lungs"]) == LUNG_IDS
    official = frozen.load()
    assert result["simulators"]["manifest_sha256"] == official.manifest_sha256
    weights, totals = plants_to_train_on().weights, np.zeros(len(GAINS))
    for k, name in enumerate(LUNG_IDS):
        rigs = list(official.training_rigs[k])
        each = pid_search.errors(jax.tree.map(lambda x, r=rigs: x[0, r], official.members), GAINS)
        error = each.mean(axis=0)
        best = int(np.argmin(error @ weights[k]))
        assert result["lungs"][name]["gains"] == list(GAINS[best])
        assert result["lungs"][name]["error"] == pytest.approx(error[best].mean(), rel=1e-5)
        totals += error @ weights[k]
    assert result["single"]["gains"] == list(GAINS[int(np.argmin(totals))])


def test_the_command_for_one_lung(small, tmp_path):
    arguments = ["train", "pid", "--lung", "R20C50", "--draws", "0", "--out", str(tmp_path)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    result = json.loads((tmp_path / "best.json").read_text())
    assert tuple(result["lungs"]) == ("R20C50",)
    assert "single" not in result
    run = CliRunner().invoke(app, ["train", "pid", "--lung", "all", "--out", str(tmp_path)])
    assert isinstance(run.exception, InputError)


@pytest.mark.parametrize("which", [[], ["--all", "--robust"], ["--lung", "R5C10", "--all"]])
def test_the_command_wants_to_know_which_lungs(which, tmp_path):
    run = CliRunner().invoke(app, ["train", "pid", *which, "--out", str(tmp_path)])
    assert isinstance(run.exception, InputError)
    assert "exactly one of" in str(run.exception)


def test_the_papers_values():
    gains = pid_search.paper_gains()
    assert gains.shape == (8000, 3)
    for column in gains.T:
        expected = [*np.arange(10) / 10, *range(1, 11)]
        np.testing.assert_allclose(np.unique(column), expected, atol=1e-12)
    assert len(np.unique(gains, axis=0)) == 8000


def test_an_error_is_that_of_the_scored_run():
    with compilation.float64():
        plants = stack([single_compartment(lung) for lung in LUNGS[:2]])
        gains = np.array([(0.0, 0.0, 0.0), (6.0, 6.0, 0.3), (10.0, 10.0, 10.0)])
        cells = nominal_scenario(np.array(protocol.PIPS))
        expected = [
            [
                run_error(
                    rollouts.closed_loop(take(plants, lung), PID(*gain), cells)[0].pressure,
                    np.asarray(cells.pip)[:, None, None],
                )
                for gain in gains
            ]
            for lung in range(2)
        ]
    found = pid_search.errors(plants, gains)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


def test_the_last_batch_may_be_short(monkeypatch):
    plants = stack([single_compartment(LUNGS[0])])
    gains = np.array([(p, 1.0, 0.0) for p in range(5)], float)
    whole = pid_search.errors(plants, gains)
    monkeypatch.setattr(pid_search, "BATCH", 2)
    np.testing.assert_allclose(pid_search.errors(plants, gains), whole, 1e-6)


#: Two good PIDs and a bad one.
PIDS = np.array([(2.0, 4.0, 0.0), (5.0, 5.0, 0.0), (0.0, 0.1, 0.0)])


def test_gains_are_tuned_on_draws_of_their_own():
    told = []
    grid, result = pid_search.tune_pid(gains=PIDS, draws=2, progress=lambda *x: told.append(x))
    assert told[-1] == (6 * 3 * 6, 6 * 3 * 6)
    assert grid.lungs == tuple(result["lungs"]) == LUNG_IDS
    good = [list(gains) for gains in PIDS[:2]]
    assert all(entry["gains"] in good for entry in result["lungs"].values())
    assert result["single"]["gains"] in good
    assert result["draws"] == 2
    assert pid_search.TUNING_SEED != draws.DEVELOPMENT_SEED


def test_an_error_on_draws_is_that_of_the_scorer():
    rigs = load_rigs("single_compartment")
    drawn = draws.build(tuple((0,) for _ in rigs.lungs), 1, seed=pid_search.TUNING_SEED, n=1)
    found = pid_search.errors_on_draws(rigs, drawn, 2, PIDS[:1])

    class Controller:
        def reset(self, task):
            self.integral = self.before = self.derivative = 0.0

        def act(self, observation):
            if observation.time == 0:
                self.reset(None)
            error = observation.target - observation.pressure
            a = observation.dt / (observation.dt + 0.5)
            self.integral += a * (error - self.integral)
            return 2.0 * error + 4.0 * self.integral

    score = run_protocol(submission_of(Controller), protocol_of(rigs, drawn=drawn))
    assert score.controllable is not None
    # The environment rounds a submission's commands to 0.001 %.
    np.testing.assert_allclose(found[0], score.controllable[2, 1], atol=1e-4)
