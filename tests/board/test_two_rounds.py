"""Two rounds in a row from one checkout, by the commands of ``docs/leaderboard.md``."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from ventbench.board import attestation, frames, official_runs, rounds
from ventbench.cli import app
from ventbench.entries import reference as references
from ventbench.entries.cells import InProcessRunner
from ventbench.entries.result import Score
from ventbench.plants import frozen as plants
from ventbench.task import attainable
from ventbench.task import draws as draw_tables

from . import referee
from .conftest import FROZEN, KEY, SANDBOX, SECRET, attest, entry_folder

pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")

#: What the tests of the board do without, see `conftest.py`; and what is replaced here.
WITNESS, SECOND = references.witness_errors, references.second_errors
SECONDS, RUN = rounds._seconds, official_runs.run_protocol

#: Draws of these rounds, starts of their bounds, and cells where these are found again.
DRAWS, STARTS, AGAIN = 6, (1, 4, 16), 2


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, simulators) -> None:
    """Few draws, few starts, a day between two steps; runs in this process count as official."""
    clock = iter(FROZEN + timedelta(days=k) for k in range(100))
    monkeypatch.setattr(rounds, "_seconds", lambda when: SECONDS(when or next(clock)))
    monkeypatch.setattr(draw_tables, "COUNT", DRAWS)
    monkeypatch.setattr(references, "witness_errors", WITNESS)
    monkeypatch.setattr(references, "second_errors", SECOND)
    monkeypatch.setattr(attainable, "STARTS", STARTS)
    for function in (official_runs.bound, official_runs.score, official_runs.close):
        defaults: Any = function.__kwdefaults__
        monkeypatch.setitem(defaults, "load", lambda: simulators)
        if "runner" in defaults:
            monkeypatch.setitem(defaults, "runner", InProcessRunner)

    def official(*given: Any, **options: Any) -> Score:
        made = RUN(*given, **options)
        rigs = replace(made.protocol.rigs, sha256=plants.MANIFEST_SHA256)
        return replace(made, sandbox=SANDBOX, protocol=replace(made.protocol, rigs=rigs))

    monkeypatch.setattr(official_runs, "run_protocol", official)


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_two_rounds_with_outsiders_refused_and_returning_entries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One returns; one fails, is mended and returns; one cannot be opened, one is over its limit.

    Each entry of the second round is scored in a job of its own, and one of these jobs never ends.
    """
    inside, board, work = tmp_path / "submissions", tmp_path / "leaderboard", tmp_path / "work"
    monkeypatch.setattr(rounds, "bundled", lambda: sorted(x.name for x in inside.iterdir()))
    monkeypatch.setenv(attestation.SECRET, KEY)
    chain, listed = tmp_path / "chain.json", list[Any]()
    chain.write_bytes(msgspec.json.encode(referee.chain(SECRET)))

    def command(*arguments: str) -> str:
        ended = CliRunner().invoke(app, [*arguments, "--folder", str(board)])
        assert ended.exit_code == 0, (arguments, ended.output, ended.exception)
        return ended.stdout

    def merged(name: str, account: str, change: str = "") -> None:
        folder = entry_folder(inside / name, "pid_best", name)
        code = folder / "controller.py"
        code.write_text(f"{code.read_text()}\n{change}\n")
        asked = FROZEN + timedelta(seconds=len(listed))
        listed.append({"name": name, "account": account, "asked": asked.isoformat()})

    def opened(name: str, closes: str) -> None:
        referees = ("--limit", "2", "--delay", "60", "--rehearsal", str(chain))
        command("round", "open", name, "--closes", closes, *referees)

    def frozen(name: str) -> rounds.Frozen:
        requests = tmp_path / "requests.json"
        requests.write_text(json.dumps(listed))
        where = ("--submissions", str(inside), "--requests", str(requests))
        command("round", "freeze", name, *where)
        shown = json.loads(command("round", "show", name, "--json", "-"))
        value = tmp_path / "value.json"
        value.write_bytes(referee.value(SECRET, shown["beacon_round"]))
        command("round", "draw", name, "--beacon", str(value))
        made = rounds.load(board, name).frozen
        assert made is not None
        return made

    def scored(name: str, only: tuple[str, ...] = ()) -> None:
        command("round", "bounds", name, "--out", str(work))
        for entry in only:
            command("round", "score", name, "--only", entry, "--out", str(work))
        if only:  # as the workflow does, whose last job runs no submission
            official_runs.close(board, name, work / name, secret=KEY)
        else:
            command("round", "score", name, "--out", str(work))
        command("board", "verify", "--bounds", str(AGAIN))
        command("board", "build", "--out", str(tmp_path / "site"))
        command("board", "verify", "--bounds", "0", "--site", str(tmp_path / "site"))

    board.mkdir()
    attest(board)
    entry_folder(inside / "pid_best", "pid_best", "pid_best")
    opened("a", "2026-11-20")
    merged("one", "eve")
    merged("two", "mallory", "raise ValueError('unfinished')")
    merged("lacking", "mallory")
    (inside / "lacking/controller.py").unlink()
    first = frozen("a")
    assert {x.name: x.account for x in first.entries} == {
        "pid_best": "",
        "one": "eve",
        "two": "mallory",
    }
    assert "controller.py is missing" in first.left_out["lacking"]
    scored("a")

    opened("b", "2026-11-21")
    for name in ("lacking", "two"):
        shutil.rmtree(inside / name)
    merged("two", "mallory")
    merged("lacking", "mallory")
    merged("third", "mallory")
    merged("new", "carol")
    second = frozen("b")
    owners = {"one": "eve", "two": "mallory", "lacking": "mallory", "new": "carol"}
    assert {x.name: x.account for x in second.entries} == {"pid_best": "", **owners}
    assert second.left_out == {"third": "account mallory has 2 entries already"}
    scored("b", ("pid_best", "one", "two", "new"))

    results = [rounds.load(board, name).result for name in "ab"]
    assert [x and {y.split()[0] for y in x.records} for x in results] == [
        {"pid_best", "one"},
        {"pid_best", "one", "two", "new"},
    ]
    failed = [x.failed if x else {} for x in results]
    assert "unfinished" in failed[0]["two (performance)"]
    assert "No such file" in failed[1]["lacking (performance)"]
    ranked = {
        track.draws: {row.record.name: row.place and row.place.rank for row in track.listed}
        for track in frames.load_tracks(board, track="performance")
        if track.round
    }
    assert ranked == {
        "a": dict.fromkeys(("pid_best", "one"), 1),
        "b": dict.fromkeys(("pid_best", "one", "two", "new"), 1),
    }, "copies of the PID count as one with it"
