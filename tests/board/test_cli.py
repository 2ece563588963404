"""The commands, on textbook lungs in the place of the frozen ones."""

from __future__ import annotations

import csv
import io
import json
import shutil
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.board import frames, store
from ventbench.cli import app

from .conftest import accept

RUN = CliRunner()


def run(*arguments: object, code: int = 0) -> str:
    found = RUN.invoke(app, ["board", *map(str, arguments)])
    if isinstance(found.exception, InputError):  # main() prints it and exits with 2
        assert code == 2
        return str(found.exception)
    assert found.exit_code == code, found.output
    return found.output


def test_from_records_to_a_verified_board(drafts, entered: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(entered, tmp_path / "board")
    names = ("pid_best", "softer", "broken")
    paths = [drafts[name].save(tmp_path / "records") for name in names]
    added = run("add", *paths, "--folder", folder)
    for name in names:
        assert f"added {name} (performance)" in added
    accept(folder)
    build = ("build", "--folder", folder, "--out", tmp_path / "site")
    assert "3 records, 6 pages, 21 files changed" in run(*build)
    assert "3 records, 6 pages, 0 files changed" in run(*build)
    output = run("verify", "--folder", folder)
    assert "no problems: 3 records, 3 replayed" in output
    report = tmp_path / "show.json"
    text = run("show", "--folder", folder, "--json", report)
    rows = json.loads(report.read_text())["rows"]
    assert [(row["name"], row["rank"]) for row in rows] == [
        ("pid_best", 1),
        ("softer", 2),
        ("broken", ""),
    ]
    assert "softer" in text
    written = csv.DictReader(io.StringIO((tmp_path / "site" / "leaderboard.csv").read_text()))
    assert [row["score_cmH2O"] for row in written] == [row["score_cmH2O"] for row in rows]


def test_verify_says_no_with_exit_code_1(leaderboard: Path, tmp_path: Path) -> None:
    item = next(x for x in store.load(leaderboard).scores if x.name == "pid_best")
    path = store.path_of(leaderboard, item.sha256)
    path.write_bytes(path.read_bytes().replace(b"pid", b"PID"))
    output = run("verify", "--folder", leaderboard, "--json", tmp_path / "report.json", code=1)
    assert f"{path} has been changed" in output
    assert "1 problem:" in output
    report = json.loads((tmp_path / "report.json").read_text())
    assert len(report["problems"]) == 1
    assert report["replayed"] == 7


def test_withdraw(leaderboard: Path) -> None:
    item = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    output = run("withdraw", item.sha256[:12], "--reason", "a bug", "--folder", leaderboard)
    assert item.sha256 in output
    assert "next: ventbench board sign" in output
    accept(leaderboard)
    run("build", "--folder", leaderboard, "--out", leaderboard.parent / "site")
    assert "withdrawn: a bug" in (leaderboard.parent / "site" / "index.html").read_text()
    assert "no problems" in run("verify", "--folder", leaderboard)


def test_bad_input_is_explained(tmp_path: Path) -> None:
    assert "holds no record" in run("show", "--folder", tmp_path, code=2)
    (tmp_path / "x.json").write_text("{}\n")
    assert "field `kind`" in run("add", tmp_path / "x.json", "--folder", tmp_path, code=2)


def test_outside_a_checkout_the_last_rounds_board_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is said; a folder that is here and holds nothing is another thing."""
    monkeypatch.undo()  # the frozen lungs, not textbook ones in their place
    monkeypatch.chdir(tmp_path)
    found = RUN.invoke(app, ["board", "show"])
    assert "no folder leaderboard here; the board of the last round, which came" in found.stderr
    assert "identify_plan" in found.stdout
    assert "rehearsal-6: scored" in RUN.invoke(app, ["round", "show"]).stdout
    assert "there is no such folder; the published leaderboard" in run("verify", code=2)
    (tmp_path / "leaderboard").mkdir()
    assert "leaderboard holds no record" in run("show", code=2)


def test_without_the_extra_the_board_is_shown_and_a_page_says_what_it_needs(
    leaderboard: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for missing in ("jinja2", "markupsafe"):
        monkeypatch.setitem(sys.modules, missing, None)
    name = store.load(leaderboard).scores[0].name
    assert name in run("show", "--folder", leaderboard)
    assert "need jinja2: install ventbench[view]" in run(
        "build", "--folder", leaderboard, "--out", leaderboard.parent, code=2
    )


def test_tables_fit_80_columns(full: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No line breaks within a cell, whether or not the terminal is wider."""
    monkeypatch.setenv("COLUMNS", "80")
    text = run("show", "--folder", full)
    assert max(map(len, text.splitlines())) <= 80
    for track in frames.load_tracks(full):
        for row in track.rows:
            if row.status == "ranked" and (own := row.normalised) is not None:
                line = next(x for x in text.splitlines() if row.record.sha256[:8] in x)
                assert row.record.name in line
                assert f"{own.low:.1f} to {own.high:.1f}" in line
    assert "…" not in text
    assert "broken: not ranked" in text or "broken: not official" in text


def test_an_entry_that_nobody_vouches_for_says_so_once(
    drafts, entered: Path, tmp_path: Path
) -> None:
    shutil.copytree(entered, tmp_path / "board")
    run("add", drafts["softer"].save(tmp_path), "--folder", tmp_path / "board")
    said = " ".join(run("show", "--folder", tmp_path / "board").split())
    assert "softer: not official: no key of this leaderboard has signed the record" in said


def test_a_rerun_elsewhere_replaces_no_official_record(
    leaderboard: Path, draft, tmp_path: Path
) -> None:
    official = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    path = draft("softer", factor=0.99).save(tmp_path)
    said = run("add", path, "--folder", leaderboard, code=2)
    assert f"the entry has record {official.sha256[:12]}; withdraw that first" in said
