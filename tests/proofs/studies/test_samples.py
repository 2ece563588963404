"""The statistics of the study, and its table and picture."""

from __future__ import annotations

import json
import re

import jax
import numpy as np
import pytest
from scipy.stats import trim_mean
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.paper import controller_sections
from proofs.paper.paper import load_stored
from proofs.studies import samples
from proofs.studies.samples import LearningCurve, SampleStudy
from ventbench.controllers.residual import GAINS
from ventbench.plants import frozen
from ventbench.train import pid_search

RNG = np.random.default_rng(1)


def bands(scores: np.ndarray) -> np.ndarray:
    points = np.arange(scores.shape[1])
    return LearningCurve("ppo", points, points * 1.0, 0.0, scores).bands


@pytest.mark.parametrize("n", [1, 3, 4, 5, 8, 11])
def test_the_middle_is_the_trimmed_mean(n):
    values = RNG.normal(size=(n, 4))
    np.testing.assert_allclose(bands(values)[0], trim_mean(values, 0.25, axis=0))


def test_one_bad_seed_of_five_does_not_move_it():
    values = np.array([[1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 2.0, 3.0, 4.0, 500.0]]).T
    np.testing.assert_array_equal(bands(values)[0], 3.0)


def test_band_covers_the_middle_and_shrinks_with_seeds():
    middle, low, high = bands(RNG.normal(size=(5, 3)))
    assert np.all((low <= middle) & (middle <= high))
    narrow = np.subtract(*bands(RNG.normal(size=(200, 3)))[:0:-1])
    assert np.all(narrow < 0.5 * (high - low))
    # A mean of 100 middle values of a Gaussian: its standard error is about 1.09 / sqrt(200).
    np.testing.assert_allclose(narrow, 2 * 1.96 * 1.09 / np.sqrt(200), rtol=0.3)
    np.testing.assert_array_equal(bands(np.ones((5, 2))), np.ones((3, 2)))


@pytest.fixture
def made() -> SampleStudy:
    def curve(method: str, ends: float) -> LearningCurve:
        fall = np.array([3.0, 2.5, 2.1, 2.01, 2.0]) - 2.0 + ends
        scores = fall + 0.01 * np.arange(5)[:, None]
        return LearningCurve(method, np.array([0, 60, 120, 180, 240]), np.arange(5.0), 7.0, scores)

    return SampleStudy("R20C50", (curve("ppo", 2.0), curve("dqn", 1.0)), 3.02, 2.3)


def test_summary_says_when_a_score_was_reached(made):
    rows = made.summary().set_index("method")
    assert rows.loc["ppo", "final"] == pytest.approx(2.02)
    assert rows.loc["ppo", "at_100_episodes"] == pytest.approx(2.52)
    assert rows.loc["ppo", "episodes_to_best_pid"] == 120
    assert rows.loc["ppo", "episodes_to_2_percent"] == 180
    assert rows.loc["dqn", "episodes_to_best_pid"] == 0  # better from the start
    never = SampleStudy("R20C50", made.curves, 3.0, 0.5).summary()
    assert never["episodes_to_best_pid"].tolist() == [None, None]


def test_what_is_stored_has_the_form_of_the_papers_page(made):
    stored, known = made.stored(), load_stored()["samples"]
    assert stored.keys() == known.keys()
    assert stored["methods"][0].keys() == known["methods"][0].keys()
    assert stored["about"]["command"] == "python -m proofs study samples --seeds 5"
    json.dumps(stored, allow_nan=False)


def test_picture(made):
    pytest.importorskip("matplotlib", reason="the picture needs the extra view")
    content = samples.learning_curves_png(made)
    assert content.startswith(b"\x89PNG")
    assert len(content) < 300_000
    assert content == samples.learning_curves_png(made)


def test_the_short_recipe_is_done_after_96_breaths():
    short = samples.study_methods()["policy-gradient-short"]
    assert short.iterations * short.breaths == 96
    assert all(one.iterations == 1 for one in samples.study_methods(1e-6).values())


@pytest.mark.slow
def test_study_samples(tmp_path):
    store = tmp_path / "stored.json"
    store.write_text('{"networks": 1}')
    asked = ["study", "samples", "--seeds", "2", "--share", "0.01", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, [*asked, "--store", str(store)])
    assert result.exit_code == 0, result.output
    kept = json.loads(store.read_text())
    assert kept["networks"] == 1
    section = controller_sections.sample_efficiency(kept["samples"])
    methods = ["policy-gradient-short", "policy-gradient", "ppo", "dqn"]
    assert [row[0] for row in section.tables[0].rows] == methods
    (start,) = re.findall(r"the corrected PID has ([\d.]+)", " ".join(result.output.split()))
    plant = jax.tree.map(lambda leaf: leaf[-1:], frozen.load().plants)  # R20C50
    corrected = pid_search.errors(plant, np.array([GAINS], float))[0].mean()
    assert float(start) == pytest.approx(corrected, abs=2e-3)
    assert (tmp_path / "study-samples.png").stat().st_size < 300_000
    again = CliRunner().invoke(app, [*asked, "--store", str(store)])
    assert again.exit_code == 0, again.output
    assert json.loads(store.read_text()) == kept
