"""Rounds of diagnosers: who takes part is fixed before anybody can know the cases."""

from __future__ import annotations

import hashlib
import hmac
import json
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from proofs import rounds
from proofs.__main__ import app
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.reveal import Board
from proofs.rounds import Round, draw, freeze, load, play
from tests.board import referee
from ventbench.base.errors import InputError

SECRET, FROZEN = 20261127, datetime(2026, 11, 27, 10, tzinfo=UTC)
PAGE = (Path(__file__).parents[2] / "docs" / "diagnosers.md").read_text("utf-8")


@pytest.fixture(autouse=True)
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the figures depend on is one file."""
    monkeypatch.setattr(rounds, "_ROOT", tmp_path / "checkout")
    monkeypatch.setattr(rounds, "_CODE", ("proofs", "requirements.lock"))
    (tmp_path / "checkout" / "proofs").mkdir(parents=True)
    (tmp_path / "checkout" / "requirements.lock").write_text("numpy==2\n")
    judge = tmp_path / "checkout" / "proofs" / "judge.py"
    judge.write_text("FLOOR = 1e-3\n")
    return judge


def entry(folder: Path, name: str) -> str:
    """The example of the docs, under a name."""
    place = folder / "sent" / name
    place.mkdir(parents=True)
    (python,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    (place / "diagnose.py").write_text(python)
    (place / "diagnoser.toml").write_text(f'name = "{name}"\nfunction = "diagnose:diagnose"\n')
    return str(place)


@pytest.fixture
def frozen(tmp_path: Path) -> Round:
    return freeze(
        tmp_path / "round",
        [entry(tmp_path, "mine"), entry(tmp_path, "other")],
        {"faults": 1},
        delay_s=60,
        kind="null",
        chain=referee.chain(SECRET),
        now=FROZEN,
    )


def test_the_seed_is_that_of_the_value_after_the_delay(frozen: Round) -> None:
    due = FROZEN + timedelta(seconds=60)
    assert frozen.frozen.chain.time_of(frozen.number) == due
    with pytest.raises(InputError, match="not drawn yet"):
        _ = frozen.seed
    value = referee.value(SECRET, frozen.number)
    with pytest.raises(InputError, match="is published at 2026-11-27 10:01:00"):
        draw(frozen, value, now=due - timedelta(seconds=1))
    for wrong in (referee.value(SECRET, frozen.number + 1), referee.value(7, frozen.number)):
        with pytest.raises(InputError, match="the value of the beacon"):
            draw(frozen, wrong, now=due)
    own = draw(frozen, value, now=due)
    assert load(own.folder) == own
    key = bytes.fromhex(json.loads(value)["randomness"])
    content = hashlib.sha256((own.folder / "frozen.json").read_bytes()).digest()
    expected = hmac.digest(key, b"ventbench round 1\n" + content, "sha256")
    assert own.seed == expected.hex()


def test_what_is_frozen_is_what_plays(frozen: Round, tmp_path: Path, code: Path) -> None:
    own = draw(frozen, referee.value(SECRET, frozen.number))
    (tmp_path / "sent" / "mine" / "diagnose.py").write_text("better = True\n")  # too late
    copy = own.folder / "diagnosers" / "mine" / "diagnose.py"
    before = copy.read_text()
    copy.write_text(before + "# better\n")
    with pytest.raises(InputError, match="mine has been changed since the freeze"):
        play(own)
    copy.write_text(before)
    code.write_text("FLOOR = 0.1\n")
    with pytest.raises(InputError, match="check out the commit that was frozen"):
        play(own)
    path = own.folder / "frozen.json"
    path.write_text(path.read_text().replace('"seconds": 300', '"seconds": 900'))
    assert load(own.folder).seed != own.seed, "whoever changes it later gets other cases"
    path.write_text(path.read_text().replace('"delay_s": 60', '"delay_s": 61'))
    with pytest.raises(InputError, match="key round: is"):
        load(own.folder)


def test_who_cannot_take_part(frozen: Round, tmp_path: Path) -> None:
    mine, out = str(tmp_path / "sent" / "mine"), tmp_path / "another"
    for given, worlds, why in (
        ([mine, mine], {"faults": 1}, "there is a diagnoser mine already"),
        (["os:getcwd"], {"faults": 1}, "a function has no hash"),
        ([mine], {"moon": 1}, "no generator 'moon'"),
    ):
        with pytest.raises(InputError, match=why):
            freeze(out, given, worlds)
    with pytest.raises(InputError, match="is there already"):
        freeze(frozen.folder, [mine], {"faults": 1})
    with pytest.raises(InputError, match="`challenge freeze` begins one"):
        load(out)


def test_a_round_is_played_and_goes_on_where_it_stopped(frozen: Round) -> None:
    own, steps = draw(frozen, referee.value(SECRET, frozen.number)), []
    result = play(own, tell=lambda name, done, total: steps.append((name, done, total)))
    assert ("make faults", 1, 1) in steps, "as the bars of the command line are told"
    folder = ChallengeFolder(own.folder / "faults")
    assert set(folder.answers("mine")) == set(folder.answers("other")) == {"case_0001"}
    (rows,) = result.tables.values()
    assert [row.diagnoser for row in rows] == ["mine", "other"]
    assert rows[0].draws[0].seed == own.seed
    assert own.seed in (own.folder / "board.md").read_text()
    assert rows[0].cases[0, "case_0001"].belief == 1.0, "nothing is missing, and both say so"
    times = {path: path.stat().st_mtime_ns for path in folder.path.rglob("*.*")}
    assert play(own).as_dict() == result.as_dict()
    assert {path: path.stat().st_mtime_ns for path in folder.path.rglob("*.*")} == times
    (folder.path / "commitment.txt").write_text("0" * 64 + "\n")  # cases of another seed
    with pytest.raises(InputError, match="was published"):
        play(own)


def test_the_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chain, value, out = tmp_path / "chain.json", tmp_path / "value.json", tmp_path / "round"
    chain.write_bytes(msgspec.json.encode(referee.chain(SECRET)))
    mine = entry(tmp_path, "mine")
    arguments = ["challenge", "freeze", str(out), "--diagnoser", mine, "--delay", "1"]
    done = CliRunner().invoke(app, [*arguments, "--rehearsal", str(chain), "--world", "faults"])
    assert "give NAME:CASES" in done.output
    done = CliRunner().invoke(app, [*arguments, "--rehearsal", str(chain)])
    assert done.exit_code == 0, done.output
    own = load(out)
    assert own.sha256 in done.output
    assert own.frozen.worlds == {"faults": 60, "stranger": 60}
    value.write_bytes(referee.value(SECRET, own.number))
    due = own.frozen.chain.time_of(own.number)
    take = rounds.beacon.take
    monkeypatch.setattr(
        rounds.beacon,
        "take",
        lambda content, chain, number, now=None: take(content, chain, number, due),
    )
    played = []
    nobody = Board("", {})
    monkeypatch.setattr(rounds, "play", lambda own, **more: played.append(own) or nobody)
    done = CliRunner().invoke(app, ["challenge", "round", str(out), "--beacon", str(value)])
    assert done.exit_code == 0, done.output
    assert played[0].seed == load(out).seed
