"""Records that replay and still lie: what `add` and `verify` see of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.board import canonical, create, frames, store
from ventbench.board.figures import Figures
from ventbench.board.verify import verify
from ventbench.cli import app

from .conftest import accept, opened, put


def test_the_lung_is_not_known_before_it_shows(
    leaderboard: Path, entered: Path, draft, simulators, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robustness: the first observation of a nominal run is the same on all lungs."""

    def by_lung(requested: np.ndarray) -> None:
        requested[3, 0, 2, 0, 0] += 1e-3

    with monkeypatch.context() as patched:
        patched.setattr(Figures, "leak", "")
        leaky = draft("leaky", "pid_robust", change=by_lung)
        record = put(leaderboard, leaky, simulators)  # control: nothing else sees it
        assert verify(leaderboard, lambda: simulators).problems == []
    (problem,) = verify(leaderboard, lambda: simulators).problems
    assert record.sha256 in problem
    assert "key commands: in the nominal run at PIP 20 the first command" in problem
    with pytest.raises(InputError, match="the lung was known"):
        put(shutil.copytree(entered, leaderboard.parent / "other"), leaky, simulators)
    with pytest.raises(InputError, match="the lung was known"):
        draft("leaky", "pid_robust", change=by_lung)
    draft("told", "pid_best", change=by_lung)  # the performance track is told the lung


def test_later_commands_and_failed_runs_may_differ(draft) -> None:
    def later(requested: np.ndarray) -> None:
        requested[3, 0, 2, 0, 1] += 1.0
        requested[3, 0, 2, 1, 0] += 1.0

    draft("later", "pid_robust", change=later)
    failed = opened(draft("fails", "pid_robust", failed=2))
    assert len(failed.header.failures) == 2
    assert failed.track == "robustness"


def test_the_terminal_gets_no_commands(leaderboard: Path, drafts, monkeypatch) -> None:
    item = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    store.withdraw(leaderboard, item.sha256, "a \x1b]0;owned\x07\x1b[2J\x9b31m\u202e [red]bug")
    accept(leaderboard)
    monkeypatch.setenv("COLUMNS", "300")
    arguments = ["board", "show", "--folder", str(leaderboard)]
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0
    assert not {"\x1b", "\x07", "\x9b", "\u202e"} & set(shown.output)
    assert "[red]bug" in shown.output
    (leaderboard / "\x1b[2Jx.html").write_text("x")
    arguments[1] = "verify"
    checked = CliRunner().invoke(app, arguments)
    assert checked.exit_code == 1
    assert "\x1b" not in checked.output
    assert "x.html is no part of a leaderboard" in checked.output


def test_a_date_makes_nobody_an_author(leaderboard: Path, draft, simulators) -> None:
    """The order of freezing does: a copy that says it is older follows the original."""

    def uneasy(requested: np.ndarray) -> None:
        requested[..., ::2] *= 1.4

    copy = draft("twin", change=uneasy)
    values = json.loads(copy.content)
    values["created"] = "2020-01-01T00:00:00Z"
    put(leaderboard, create.Draft(canonical.canonical(values), copy.commands), simulators)
    put(leaderboard, draft("honest", change=uneasy), simulators)
    accept(leaderboard)
    (track, _) = frames.load_tracks(leaderboard, track="performance")
    rows = {row.record.name: row for row in track.listed}
    assert rows["honest"].source == ""
    assert rows["twin"].source == "honest"
