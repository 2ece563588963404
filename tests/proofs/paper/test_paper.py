"""The paper's page: its figures, its verdicts, its forms."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.paper import controller_sections, paper, published, simulator_sections
from proofs.paper.page import page, svg
from proofs.paper.report import Chart, Reproduction, Section, Table, bars, below, every
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.train.pid_search import PIDGrid

GAINS = np.array([(2.0, 0.0, 0.0), *published.BEST_PID.values(), (0.0, 4.0, 0.0), (5.0, 10.0, 1.0)])


@pytest.fixture(scope="module")
def stored():
    return paper.load_stored()


def grid_of(error):
    """A grid whose PID k has the error ``error[k]`` on every lung and PIP."""
    values = np.broadcast_to(np.asarray(error, np.float32)[:, None], (len(error), 6))
    return PIDGrid(LUNG_IDS, protocol.PIPS, GAINS, np.stack([values] * 6))


def test_stored_errors_are_those_of_the_official_simulators(stored):
    """By clock, the frozen simulators state the same held-out errors in their manifest."""
    official = frozen.load()
    assert stored["horizon"]["about"]["simulators"] == official.manifest_sha256
    for name, about in official.lungs().items():
        here = stored["horizon"]["lungs"][name]
        assert here["breaths"] == about["held_out_breaths"]
        assert here["hybrid"]["mae"] == pytest.approx(about["held_out_mae"], abs=2e-3)
        assert here["hybrid"]["median_mae"] == pytest.approx(about["held_out_median_mae"], abs=2e-3)


def test_distances_are_sums_over_the_steps_of_an_inspiration(stored):
    for about in stored["horizon"]["lungs"].values():
        for kind in simulator_sections.KINDS:
            longest = len(about[kind]["by_step"])
            assert longest - 4 < about[kind]["distance"] / about[kind]["mae"] <= longest


def test_errors_by_horizon_say_whether_they_grow(stored):
    section = simulator_sections.by_horizon(stored["horizon"])
    assert section.verdict in ("agrees", "in part")
    grown = copy.deepcopy(stored["horizon"])
    for about in grown["lungs"].values():
        about["hybrid"]["by_step"] = [0.01 * 1.3**k for k in range(30)]
    assert simulator_sections.by_horizon(grown).verdict == "differs"


def test_networks_are_set_beside_the_papers(stored):
    section = simulator_sections.architectures(stored["networks"])
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows["width 150"][0] == 0.643
    wide, usual = rows["width 150"][2], rows["width 48"][2]
    assert isinstance(wide, float)
    assert isinstance(usual, float)
    assert wide < usual
    assert rows["N_B 5"][1] is None
    # Width 150 gains; of the other four larger shapes no interval is without zero.
    assert section.verdict == "in part"
    assert simulator_sections.boundary(stored["networks"]).verdict == "differs"
    surely = copy.deepcopy(stored["networks"])
    next(row for row in surely["variants"] if row["variant"] == "N_B 0")["low95"] = 0.01
    assert simulator_sections.boundary(surely).verdict == "agrees"


def test_the_grid_ranks_the_papers_gains():
    error = np.full(len(GAINS), 3.0)
    error[0] = 1.0
    section = controller_sections.best_gains(grid_of(error))
    row = section.tables[0].rows[0]
    assert row[:3] == ("R5C10", "10, 0.2", 3.0)
    assert row[3:5] == ("2, 0", 1.0)
    assert section.verdict == "differs"
    error[1:] = 1.02
    assert controller_sections.best_gains(grid_of(error)).verdict == "agrees"


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [((-2.0, 0.0), "agrees"), ((-1.0, 1.0), "in part"), ((0.1, 2.0), "differs")],
)
def test_a_claim_is_judged_by_its_whole_interval(interval, verdict):
    assert below(interval) == verdict
    assert below((interval[0] + 5.0, interval[1] + 5.0), 5.0) == verdict
    assert every(verdict, verdict) == verdict
    assert every("agrees", "differs") == "in part"


def test_a_grid_without_the_papers_gains_is_refused():
    grid = PIDGrid(LUNG_IDS, protocol.PIPS, GAINS[:1], np.ones((6, 1, 6), np.float32))
    with pytest.raises(InputError, match=r"does not contain P, I, D = 10, 0\.2, 0"):
        controller_sections.best_gains(grid)


@pytest.mark.parametrize(
    ("residual", "verdict"), [(0.9, "agrees"), (1.1, "differs")], ids=["better", "worse"]
)
def test_the_residual_network_is_judged_by_lung(residual, verdict):
    grid = grid_of(np.linspace(1.0, 2.0, len(GAINS)))
    section = controller_sections.performance(grid, np.full((6, 6), residual))
    assert section.verdict == verdict
    assert section.tables[0].rows[0][3] == pytest.approx(100.0 * (residual - 1.0), abs=1e-3)


def test_the_residual_network_is_judged_on_the_rigs_of_a_round_too():
    grid = grid_of(np.linspace(1.0, 2.0, len(GAINS)))
    ones = np.ones((6, 6))
    section = controller_sections.performance(grid, 0.9 * ones, ("trial", ones, 1.2 * ones))
    assert section.verdict == "in part"
    assert "On the rigs of round trial" in section.finding
    assert "+20 %" in section.finding
    assert section.tables[-1].rows[0][1:] == pytest.approx((1.0, 1.2, 20.0))


def test_no_claim_agrees_whose_interval_has_a_zero():
    grid = grid_of(np.linspace(1.0, 2.0, len(GAINS)))
    residual = np.repeat([[0.5], [0.9], [0.9], [0.95], [0.99], [0.99]], 6, axis=1)
    section = controller_sections.performance(grid, residual)
    assert section.verdict == "in part"
    assert "better on 6 of 6" in section.finding
    both = {"residual": residual, "PPO": np.full((6, 6), 0.88), "DQN": np.ones((6, 6))}
    assert controller_sections.reinforcement(both).verdict == "in part"


def test_one_network_for_all_must_win_by_more():
    grid = grid_of(np.linspace(1.0, 2.0, len(GAINS)))
    own, shared = np.full((6, 6), 0.9), np.full((6, 6), 0.8)
    assert controller_sections.robustness(grid, own, shared).verdict == "agrees"
    assert controller_sections.robustness(grid, shared, own).verdict == "in part"
    assert controller_sections.robustness(grid, own, 2.0 * shared).verdict == "differs"


def test_reinforcement_learning_is_compared_by_the_mean():
    errors = {"residual": np.ones((6, 6)), "PPO": np.ones((6, 6)), "DQN": 2 * np.ones((6, 6))}
    assert controller_sections.reinforcement(errors).verdict == "agrees"
    assert (
        controller_sections.reinforcement(errors | {"PPO": 0.5 * np.ones((6, 6))}).verdict
        == "differs"
    )


def test_studies_have_their_claims(stored):
    samples = controller_sections.sample_efficiency(stored["samples"])
    assert samples.verdict == "in part"
    assert "ppo" in {row[0] for row in samples.tables[0].rows}
    assert controller_sections.regularisation(stored["controllers"]).verdict == "differs"
    assert controller_sections.stability(stored["samples"]).verdict == "differs"
    early = copy.deepcopy(stored["samples"])
    for row in early["methods"]:
        row["episodes_to_2_percent"] = 100
    assert controller_sections.sample_efficiency(early).verdict == "differs"
    unfinished = copy.deepcopy(stored["samples"])
    unfinished["methods"][-1]["episodes_to_best_pid"] = None
    assert "Not all methods" in controller_sections.sample_efficiency(unfinished).finding


def small_page():
    table = Table("numbers", ("name", "value"), (("a", 1.23456), ("b", None)), 2)
    section = Section(
        "id", "A title", "table 9", "A <claim>.", "in part", "It is so.", "computed", (table,)
    )
    return Reproduction({"protocol": 2}, (section,))


def test_a_page_is_markdown_and_json():
    page = small_page()
    markdown = page.to_markdown()
    assert "| table 9 | A <claim>. | in part | It is so. |" in markdown
    assert "| a | 1.23 |" in markdown
    assert "| b | - |" in markdown
    text = json.dumps(page.to_json(), allow_nan=False)
    assert json.loads(text)["sections"][0]["tables"][0]["rows"] == [["a", 1.23456], ["b", None]]


def test_stored_results_must_be_readable(tmp_path):
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(InputError, match="cannot be read"):
        paper.load_stored(tmp_path / "x.json")


@pytest.mark.slow
def test_the_whole_page_agrees_with_scores_and_manifest(tmp_path, monkeypatch):
    """The figures of the command are those of a score and of the simulators' manifest."""
    from ventbench.entries.scoring import score

    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["paper", "--json", "paper.json"])
    assert result.exit_code == 0, result.output
    sections = {s["id"]: s for s in json.loads((tmp_path / "paper.json").read_text())["sections"]}
    rows = {row[0]: row for row in sections["reinforcement"]["tables"][0]["rows"]}
    entry = score("residual_mlp", track="performance", sandbox=False)
    for name, error in zip(LUNG_IDS, entry.by_lung, strict=True):
        assert rows[name][1] == pytest.approx(error, abs=1e-9)
    official = frozen.load().lungs()
    for row in sections["simulators"]["tables"][0]["rows"]:
        assert row[2] == official[row[0]]["own_rig_mae"]
    assert result.stdout.startswith("# The paper, reproduced")


def test_errors_by_horizon_can_be_measured_again(stored, public_recordings):
    again = simulator_sections.measure_horizon(
        public_recordings / paper.MEASURED, stored["horizon"]
    )
    for name, about in stored["horizon"]["lungs"].items():
        for kind in simulator_sections.KINDS:
            np.testing.assert_allclose(
                again["lungs"][name][kind]["by_step"], about[kind]["by_step"], atol=2e-3
            )


def test_the_papers_figures_are_pictures_beside_the_numbers(stored):
    sections = (
        simulator_sections.by_horizon(stored["horizon"]),
        simulator_sections.architectures(stored["networks"]),
        controller_sections.sample_efficiency(stored["samples"]),
    )
    assert {"figure 5, table 5", "table 4"} <= {s.place for s in sections if s.charts}
    shown = page(Reproduction({"ventbench": "x"}, sections))
    assert shown.count("<svg") == shown.count("<figure>") == 3
    assert "<code>--recordings DIR</code>" in shown
    assert shown.count("<tr>") == len(sections) + 1 + sum(
        1 + len(s.tables[0].rows) for s in sections
    )
    assert shown == page(Reproduction({"ventbench": "x"}, sections))


def test_a_group_of_bars_has_one_for_each_number_of_its_row():
    table = Table("Errors", ("lung", "paper", "here"), (("R5C10", 0.5, None), ("R5C20", 0.7, 1.0)))
    chart = bars(table, "error, cmH2O", ("paper", "here"))
    assert chart.series["here"] == (["R5C10", "R5C20"], [None, 1.0])
    line = Chart("One", "time, s", "pressure, cmH2O", {"target": ([0.0, 1.0], [5.0, 5.0])})
    for drawn in (svg(chart), svg(line)):
        assert drawn.startswith("<svg")
        assert drawn.rstrip().endswith("</svg>")
