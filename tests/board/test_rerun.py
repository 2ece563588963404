"""Who computed the commands: the code that a record names, or somebody else."""

from __future__ import annotations

import functools
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.board import official_runs, store
from ventbench.board.verify import verify
from ventbench.cli import app
from ventbench.entries.cells import InProcessRunner
from ventbench.plants import frozen
from ventbench.task import environment, protocol

from ..textbook_rigs import TextbookRigs
from .conftest import entry_folder, put


def sha_of(folder: Path, name: str) -> str:
    return next(score.sha256 for score in store.load(folder).scores if score.name == name)


def states(outcomes: list[official_runs.Outcome]) -> dict[str, str]:
    return {outcome.record.name: outcome.state for outcome in outcomes}


@pytest.fixture
def again(simulators: TextbookRigs):
    """Run records of a leaderboard again, in this process."""

    def run(folder: Path, *sources: Path, **options) -> list[official_runs.Outcome]:
        options = {"runner": InProcessRunner, **options}
        return official_runs.rerun(folder, sources=sources, load=lambda: simulators, **options)

    return run


@pytest.fixture
def board(three: Path, tmp_path: Path) -> Path:
    return shutil.copytree(three, tmp_path / "leaderboard")


@pytest.fixture(scope="module")
def three(draft, drafts, simulators, entered, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An honest PID, one with commands that its code does not give, one without code."""
    folder = shutil.copytree(entered, tmp_path_factory.mktemp("three") / "leaderboard")
    for made in (draft("honest"), drafts["softer"], draft("absent", "pid_robust")):
        put(folder, made, simulators)
    return folder


@pytest.fixture
def code(tmp_path: Path) -> Path:
    for name in ("honest", "softer"):
        entry_folder(tmp_path / "code" / name, "pid_best", name)
    return tmp_path / "code"


def test_commands_of_somebody_else_are_seen(board: Path, code: Path, again, simulators) -> None:
    """Commands of one's own making under the hashes of decent code: replay cannot see it."""
    assert verify(board, lambda: simulators).problems == [], "control"
    outcomes = again(board, code)
    assert states(outcomes) == {
        "honest": official_runs.REPRODUCED,
        "softer": official_runs.DIFFERENT,
        "absent": official_runs.NOT_RERUN,
    }
    by_name = {outcome.record.name: str(outcome) for outcome in outcomes}
    forged, absent = by_name["softer"], by_name["absent"]
    assert "commands differ in 756 of 756 cells" in forged
    assert "first in cell (0, 0, 0), breath 1, step 1" in forged
    assert "no folder at hand has the files that it names; give --source DIR" in absent


def test_two_steps_of_the_valve_are_seen(scores) -> None:
    recorded = environment.resolved(scores["pid_best"].requested)
    changed = recorded.copy()
    changed[2, 3, 4, 1, 5] += protocol.RESOLUTION  # where a processor's rounding tips it over
    assert official_runs.difference(recorded, recorded.copy()) == ""
    assert official_runs.difference(recorded, changed) == ""
    changed[2, 3, 4, 1, 5] += protocol.RESOLUTION
    text = official_runs.difference(recorded, changed)
    assert "differ in 1 of 756 cells" in text
    assert "first in cell (2, 3, 4), breath 2, step 6" in text
    changed[2, 3, 4, 1, 5] = np.nan
    assert "differ in 1 of 756 cells" in official_runs.difference(recorded, changed)


def test_a_reproduced_record_says_how_close(board: Path, code: Path, again) -> None:
    (outcome,) = again(board, code, records=[sha_of(board, "honest")])
    assert outcome.detail == "to the bit"
    assert str(outcome).endswith("(honest, performance): reproduced: to the bit")


def test_changed_code_is_not_the_code(board: Path, code: Path, again) -> None:
    path = code / "honest" / "controller.py"
    path.write_text(path.read_text() + "\n")
    assert states(again(board, code))["honest"] == official_runs.NOT_RERUN
    path.write_text(path.read_text()[:-1])
    (code / "honest" / "more.txt").write_text("x")
    assert states(again(board, code))["honest"] == official_runs.NOT_RERUN


def test_nothing_of_an_earlier_run_is_believed(
    board: Path, code: Path, again, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    files = set(tmp_path.rglob("*"))
    sha256 = sha_of(board, "honest")
    started = []
    runner = lambda: started.append(1) or InProcessRunner()  # noqa: E731
    for count in (1, 2):
        (outcome,) = again(board, code, records=[sha256[:8]], runner=runner)
        assert outcome.state == official_runs.REPRODUCED
        assert len(started) == count, "it ran"
    assert set(tmp_path.rglob("*")) == files, "nothing is left for the next"
    with pytest.raises(InputError, match="no single record"):
        again(board, code, records=["f" * 64])


def test_code_beside_the_leaderboard_and_the_folder_itself(board: Path, code: Path, again) -> None:
    (outcome,) = again(board, code / "honest", records=[sha_of(board, "honest")])
    assert outcome.state == official_runs.REPRODUCED
    shutil.copytree(code / "honest", board.parent / "submissions" / "renamed")
    (outcome,) = again(board, records=[sha_of(board, "honest")])
    assert outcome.state == official_runs.REPRODUCED


def test_the_command_says_all_three(
    board: Path, code: Path, simulators, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frozen, "load", lambda path=None: simulators)
    in_this_process = functools.partial(
        official_runs.rerun, load=lambda: simulators, runner=InProcessRunner
    )
    monkeypatch.setattr(official_runs, "rerun", in_this_process)
    arguments = ["board", "verify", "--folder", str(board)]
    said = CliRunner().invoke(app, [*arguments, "--rerun", "--source", str(code)])
    assert said.exit_code == 1
    text = " ".join(said.output.split())
    assert "(softer, performance): different: commands differ" in text
    assert "(absent, robustness): not re-run: no folder at hand" in text
    assert "1 problem: 3 records, 3 replayed" in text
    assert "1 reproduced by their code" in text
    refused = CliRunner().invoke(app, [*arguments, "abc"])
    assert isinstance(refused.exception, InputError)


@pytest.mark.slow
def test_published_records_are_reproduced_in_two_processes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The newest records of two PIDs of this repository's leaderboard, in the sandbox."""
    monkeypatch.undo()  # the frozen lungs, not textbook ones in their place
    folder = Path(__file__).parents[2] / "leaderboard"
    scores = [score for score in store.load(folder).scores if score.track == "performance"]
    newest = {s.name: s.sha256 for s in scores if s.name in ("pid_best", "pid_robust")}
    assert len(newest) == 2
    outcomes = official_runs.rerun(folder, records=[*newest.values()], workers=2)
    assert [(x.state, x.detail) for x in outcomes if x.state != official_runs.REPRODUCED] == []
