"""Records that replay and still lie: what `add` and `verify` see of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.board import canonical, create, frames, replay, store
from ventbench.board.verify import verify
from ventbench.cli import app

from .conftest import accept, opened, put


def _lowered(made: create.Draft, by: float) -> create.Draft:
    """The same commands, with all errors a little lower than they give."""

    def lower(table: Any) -> Any:
        return [lower(x) for x in table] if isinstance(table, list) else max(0.0, table - by)

    values = json.loads(made.content)
    values["errors"] = lower(values["errors"]["nominal"]), lower(values["errors"]["drawn"])
    values["errors"] = dict(zip(("nominal", "drawn"), values["errors"], strict=True))
    values["headroom"]["error"] = lower(values["headroom"]["error"])
    return create.Draft(canonical.canonical(values), made.commands)


def test_errors_lowered_within_tolerance_are_refused(
    tmp_path: Path, entered: Path, drafts, simulators
) -> None:
    forged = _lowered(drafts["softer"], 9e-10)
    honest = opened(drafts["softer"])
    assert np.all(np.abs(opened(forged).drawn - honest.drawn) < replay.TOLERANCE)
    folder = shutil.copytree(entered, tmp_path / "board")
    assert opened(forged).ranked_values.mean() < honest.ranked_values.mean(), "control: it leads"
    with pytest.raises(InputError, match=r"key errors\.drawn, mean over cells"):
        put(folder, forged, simulators)
    put(folder, forged)  # as an owner without scruples does
    nominal, drawn, ranked = verify(folder, lambda: simulators).problems
    assert "key errors.nominal, mean over cells" in nominal
    assert "key errors.drawn, mean over cells" in drawn
    assert "key headroom.error, mean over cells" in ranked


def test_replayed_errors_rank(
    tmp_path: Path, entered: Path, drafts, draft, simulators, monkeypatch
) -> None:
    """Were every check of a record fooled, its replay would still decide the ranks."""
    folder = shutil.copytree(entered, tmp_path / "board")

    def other(requested: np.ndarray) -> None:
        requested[..., 1::2] *= 1.3  # nobody takes it for a copy of "softer"

    twin = draft("twin", factor=0.97, change=other)
    for key in ("TOLERANCE", "MEAN_TOLERANCE"):
        monkeypatch.setattr(replay, key, 1e6)
    put(folder, drafts["softer"], simulators)
    put(folder, _lowered(twin, 0.5), simulators)
    problems = verify(folder, lambda: simulators).problems
    assert any("(softer): ranks 2 on the performance track by its recorded" in x for x in problems)


def test_the_lung_is_not_known_before_it_shows(
    leaderboard: Path, entered: Path, draft, simulators, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robustness: the first observation of a nominal run is the same on all lungs."""

    def by_lung(requested: np.ndarray) -> None:
        requested[3, 0, 2, 0, 0] += 1e-3

    with monkeypatch.context() as patched:
        patched.setattr(replay, "lung_leaks", lambda *_: [])
        leaky = draft("leaky", "pid_robust", change=by_lung)
        record = put(leaderboard, leaky, simulators)  # control: nothing else sees it
        assert verify(leaderboard, lambda: simulators).problems == []
    (problem,) = verify(leaderboard, lambda: simulators).problems
    assert record.sha256 in problem
    assert "key actions: in the nominal run at PIP 20 the first command" in problem
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
    assert failed.header.failed_cells == 2
    assert failed.track == "robustness"


def test_the_terminal_gets_no_commands(leaderboard: Path, drafts, monkeypatch) -> None:
    item = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    store.withdraw(leaderboard, item.sha256, "a \x1b]0;owned\x07\x1b[2J\x9b31m\u202e [red]bug")
    monkeypatch.setenv("COLUMNS", "300")
    arguments = ["board", "show", "--folder", str(leaderboard)]
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0
    assert not {"\x1b", "\x07", "\x9b", "\u202e"} & set(shown.output)
    assert "[red]bug" in shown.output
    (leaderboard / "\x1b[2Jx.html").write_text("x")
    arguments[1] = "verify"
    monkeypatch.setattr("ventbench.plants.frozen.load", lambda path=None: None)
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
    rows = {row.record.name: row for row in track.ranked}
    assert rows["honest"].entry.source == ""
    assert rows["twin"].entry.source == "honest"
