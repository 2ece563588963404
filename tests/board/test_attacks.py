"""What was done to a published board without anybody noticing, and is noticed now."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ventbench.board import attestation, canonical, ranking, replay, store
from ventbench.board.verify import verify

from .conftest import KEY, ROUND

pytest.importorskip("cryptography", reason="needs the extra ventbench[attest]")


def record_of(board: Path, name: str) -> Path:
    """Where the record of an entry lies."""
    sha256 = next(x.sha256 for x in store.load(board).scores if x.name == name)
    return store.path_of(board, sha256)


def rewrite(board: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the result of the round, as whoever owns the folder can."""
    path = board / "rounds" / ROUND / "result.json"
    result = json.loads(path.read_bytes())
    change(result)
    path.write_bytes(canonical.canonical(result))


def without(board: Path, *names: str) -> None:
    """Remove the records of entries and their commands."""
    for score in store.load(board).scores:
        if score.name in names:
            for commands in score.commands:
                store.commands_path(commands, board / store.RECORDS).unlink()
            store.path_of(board, score.sha256).unlink()


def all_but_one(board: Path) -> None:
    """Leave one entry, alone at the top."""
    without(board, "pid_best", "pid_robust", "softer", "robust", "broken", "open", "home")


def failed(board: Path) -> None:
    """Say that an entry failed, in words of one's own."""
    without(board, "softer")

    def change(result: dict[str, Any]) -> None:
        del result["records"]["softer (performance)"]
        result["failed"]["softer (performance)"] = "it ran out of memory"

    rewrite(board, change)


def swapped(board: Path) -> None:
    """Let two entries have each other's record."""

    def change(result: dict[str, Any]) -> None:
        own, one, two = result["records"], "softer (performance)", "harder (performance)"
        own[one], own[two] = own[two], own[one]

    rewrite(board, change)


def invented_seeds(board: Path) -> None:
    """Give an entry seeds that nobody ran, and sign that."""
    rewrite(board, lambda result: result["seeds"].update({"softer (performance)": [0.5] * 5}))
    attestation.sign(board, board / "rounds" / ROUND / "result.json", KEY)


def withdrawn(board: Path) -> None:
    """Take back the record of a rival."""
    store.withdraw(board, record_of(board, "softer").stem, "its authors asked for it")


ATTACKS: dict[str, tuple[Callable[[Path], object], str]] = {
    "all but one record removed": (all_but_one, "is missing: the record of softer"),
    "an entry moved to the failed ones": (failed, "result.sig signs another file"),
    "hashes swapped": (swapped, "result.json, key records"),
    "seeds invented": (invented_seeds, "seeds.json, key softer (performance): its commands do not"),
    "no result": (
        lambda board: (board / "rounds" / ROUND / "result.json").unlink(),
        "result.json is missing",
    ),
    "a rival withdrawn without a key": (withdrawn, "is signed by no key"),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_an_attack_is_noticed(leaderboard: Path, simulators, attack: str) -> None:
    do, named = ATTACKS[attack]
    do(leaderboard)
    problems = verify(leaderboard, lambda: simulators).problems
    assert any(named in x for x in problems), problems


def test_a_withdrawal_without_a_key_changes_no_rank(leaderboard: Path) -> None:
    before = [x.record.name for x in ranking.board(replay.load(leaderboard))[0].listed]
    withdrawn(leaderboard)
    after = [x.record.name for x in ranking.board(replay.load(leaderboard))[0].listed]
    assert after == before != []


def test_the_signature_of_a_rival_is_missed(leaderboard: Path, simulators, tmp_path: Path) -> None:
    signed = shutil.copytree(leaderboard, tmp_path / "signed")
    listed = (signed / canonical.ATTESTATIONS).read_text()
    (signed / canonical.ATTESTATIONS).write_text(listed[listed.index("[[keys]]") :])
    attestation.sign(signed, signed / canonical.ATTESTATIONS, KEY)
    for one in store.record_paths(signed):
        attestation.sign(signed, one, KEY)
    assert verify(signed, lambda: simulators).problems == [], "control"
    path = record_of(signed, "softer")
    attestation.signature_path(path).unlink()
    (problem,) = verify(signed, lambda: simulators).problems
    assert f"{path}, of round {ROUND}, is signed by no key" in problem
