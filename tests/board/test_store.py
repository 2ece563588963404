"""What may join a leaderboard, and how records follow each other."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import pytest

from ventbench.base.errors import InputError
from ventbench.board import ranking, replay, store
from ventbench.board.verify import verify

from ..textbook_rigs import TextbookRigs
from .conftest import accept, put


def performance(folder: Path) -> ranking.Track:
    return ranking.board(replay.load(folder))[0]


def test_a_bomb_of_zeros_takes_no_memory() -> None:
    bomb = zlib.compress(bytes(10**8))
    with pytest.raises(InputError, match="does not hold commands of shape"):
        store.decode(bomb, (6, 21, 6, 3, 34), "it")


def test_a_link_is_no_record(drafts, tmp_path: Path) -> None:
    path = drafts["pid_best"].save(tmp_path)
    link = tmp_path / "link.json"
    link.symlink_to(path)
    with pytest.raises(InputError, match="no link"):
        store.add(tmp_path / "board", link)


def test_add_refuses_what_does_not_fit(leaderboard: Path, draft, drafts, simulators) -> None:
    with pytest.raises(InputError, match="already"):
        put(leaderboard, drafts["softer"], simulators)

    class Other(TextbookRigs):
        def about(self) -> dict[str, Any]:
            return {"version": 2}

    with pytest.raises(InputError, match="those of this ventbench are not those of the record"):
        put(leaderboard, draft("new"), Other())
    assert len(store.load(leaderboard).records) == 8


def test_an_entry_is_replaced_once_it_is_withdrawn(leaderboard: Path, draft, simulators) -> None:
    """Also by a record that was made before it was withdrawn."""
    old = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    made = draft("softer", factor=0.96)
    with pytest.raises(InputError, match=f"the entry has record {old.sha256[:12]}; withdraw that"):
        put(leaderboard, made, simulators)
    store.withdraw(leaderboard, old.sha256, "a bug")
    with pytest.raises(InputError, match="withdraw that"):  # nobody who may do so has signed it
        put(leaderboard, made, simulators)
    accept(leaderboard)
    new = put(leaderboard, made, simulators)
    entry = next(x for x in performance(leaderboard).listed if x.record.name == "softer")
    assert entry.record.sha256 == new.sha256
    assert {record.sha256 for record in entry.history} == {new.sha256, old.sha256}
    assert verify(leaderboard, lambda: simulators).problems == []
    with pytest.raises(InputError, match=f"the entry has record {new.sha256[:12]}; withdraw that"):
        put(leaderboard, draft("softer", factor=0.94), simulators)


def test_verify_reports_a_replacement_that_add_refuses(
    leaderboard: Path, draft, simulators, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(store, "conflicts", lambda *_, **__: [])
        thief = put(leaderboard, draft("softer", factor=0.96, texts="Mallory"), simulators)
    problems = verify(leaderboard, lambda: simulators).problems
    softer = {x.sha256 for x in store.load(leaderboard).scores if x.name == "softer"}
    assert thief.sha256 in softer
    assert all(any(x in text for x in softer) for text in problems)
    assert any("withdraw that first" in text for text in problems)


def test_a_withdrawn_record_is_listed_with_its_reason(leaderboard: Path) -> None:
    old = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    store.withdraw(leaderboard, old.sha256[:10], "its <b>authors</b> found a bug")
    assert "softer" in [x.record.name for x in performance(leaderboard).listed], "unsigned"
    accept(leaderboard)
    track = performance(leaderboard)
    assert "softer" not in [x.record.name for x in track.listed]
    (entry,) = [x for x in track.rows if x.record.name == "softer"]
    assert entry.status == "not ranked"
    assert entry.reasons == ("withdrawn: its <b>authors</b> found a bug",)
    with pytest.raises(InputError, match="already"):
        store.withdraw(leaderboard, old.sha256, "again")
    with pytest.raises(InputError, match="no single record"):
        store.withdraw(leaderboard, "f" * 64, "x")
