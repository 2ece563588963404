"""What a record is, what is refused, and how records follow each other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench import draws, files, protocol
from ventbench.board import actions, canonical, create, ranking, record, store
from ventbench.board.record import Record
from ventbench.errors import InputError

from .conftest import SANDBOX, Textbook, opened, put


def test_a_record_says_where_it_comes_from(drafts, scores) -> None:
    content = json.loads(drafts["pid_best"].content)
    assert content["protocol"] == protocol.VERSION
    assert content["official"] is True
    assert content["sandbox"] == SANDBOX
    assert content["draws"] == {"version": 1, "sha256": draws.SHA256, "count": 20}
    assert content["simulators"]["manifest_sha256"] == "0" * 64
    root = Path(draws.__file__).parents[1]
    assert content["versions"]["requirements.lock"] == files.sha256(root / "requirements.lock")
    assert {"python", "jax", "numpy"} <= content["versions"].keys()
    machine = content["machine"]
    assert {"cpu", "isa", "system", "kernel", "architecture", "cores"} <= machine.keys()
    hashes = content["submission"]["files"]
    assert create.combined_hash(hashes) == content["submission"]["sha256"]
    assert np.array(content["errors"]["drawn"]).shape == (20, 6, 6)
    assert np.array(content["safety"]["peak_centi_cmH2O"]).shape == (21, 6, 6)


def test_a_record_is_small(drafts) -> None:
    for made in drafts.values():
        assert len(made.content) + len(made.commands) < 700_000


def test_commands_come_back_bit_for_bit(drafts, scores, tmp_path: Path) -> None:
    item = record.load(drafts["pid_best"].save(tmp_path))
    assert isinstance(item, Record)
    found = actions.load(item, tmp_path)
    assert found.tobytes() == scores["pid_best"].requested.tobytes()


def test_replay_agrees_with_the_scorer(drafts, scores) -> None:
    # Numbers of these records come from a replay, those of the scores from the scorer's loop.
    content = json.loads(drafts["pid_best"].content)
    item = opened(drafts["pid_best"])
    assert item.nominal == pytest.approx(scores["pid_best"].nominal, abs=1e-9)
    assert item.drawn == pytest.approx(scores["pid_best"].drawn, abs=1e-9)
    assert content["safe"] == scores["pid_best"].safe.tolist()
    peaks = scores["pid_best"].peak
    assert content["peak_pressure_cmH2O"] == pytest.approx(peaks, abs=1e-9)
    below = np.sum(scores["pid_best"].requested < 0, axis=(1, 2, 3, 4))
    assert content["clipped"]["below"] == below.tolist()
    highest = np.array(content["safety"]["peak_centi_cmH2O"]).max(axis=(0, 2)) / 100
    assert highest == pytest.approx(peaks, abs=0.0051)


def test_spread_is_the_deviation_of_the_ensemble(drafts, scores, simulators: Textbook) -> None:
    from ventbench import precision, scenario
    from ventbench.plants.stacking import take
    from ventbench.submissions.stepping import replay

    pressures = []
    with precision.float64():
        for member in range(3):
            plants = take(simulators.ensemble, member)
            cells = scenario.nominal(protocol.PIPS)
            inspired, _ = replay(plants, cells, scores["pid_best"].requested[:, 0])
            pressures.append(np.asarray(inspired.pressure)[:, :, protocol.SCORED_BREATHS, :])
    expected = np.std(pressures, axis=0, ddof=1).mean(axis=(-2, -1))
    item = opened(drafts["pid_best"])
    assert item.spread == pytest.approx(expected, abs=1e-9)
    assert item.exploitation == pytest.approx(expected.mean(), abs=1e-9)
    assert item.exploitation > 0


def test_every_failure_is_there(draft) -> None:
    item = opened(draft("weak", failed=30, texts="x" * 3000))
    assert item.header.failed_cells == len(item.header.failures) == 30
    assert np.isnan(item.nominal).sum() == 30
    assert np.isnan(item.exploitation)
    (first, *_) = ranking.reasons(ranking.Event(item, None))
    assert first.startswith("30 of 756 cells failed, the first: weak: xxx")
    assert len(first) < 400


def test_an_incomplete_score_makes_no_record(scores, simulators: Textbook) -> None:
    import dataclasses

    score = dataclasses.replace(scores["pid_best"], drawn=scores["pid_best"].drawn[:3])
    with pytest.raises(InputError, match="--draws 20"):
        create.create(score, simulators)


def test_a_wrong_score_makes_no_record(scores, simulators: Textbook) -> None:
    import dataclasses

    score = dataclasses.replace(scores["pid_best"], nominal=scores["pid_best"].nominal * 0.999)
    with pytest.raises(InputError, match=r"does not replay: key errors\.nominal"):
        create.create(score, simulators)


def _without(key: str):
    return lambda x: {k: v for k, v in x.items() if k != key}


WRONG: dict[str, tuple[Any, str]] = {
    "missing key": (_without("safe"), "key safe: is missing"),
    "unknown key": (lambda x: {**x, "rank": 1}, "key 'rank': is not known"),
    "name that leaves its folder": (
        lambda x: {**x, "submission": {**x["submission"], "manifest": {
            **x["submission"]["manifest"], "name": "../../index"}}},
        "key submission",
    ),
    "negative error": (
        lambda x: {**x, "errors": {**x["errors"], "nominal": [[-1.0] * 6] * 6}},
        "one is negative",
    ),
    "hidden failure": (
        lambda x: {**x, "errors": {**x["errors"], "nominal": [[None] * 6] * 6}},
        "key failed_cells",
    ),
    "official without a sandbox": (lambda x: {**x, "sandbox": None}, "was not official"),
    "other lungs": (lambda x: {**x, "lungs": ["R9C9"] * 6}, "all lungs and PIPs"),
    "shape of gigabytes": (
        lambda x: {**x, "actions": {**x["actions"], "shape": [10**6] * 5}}, "actions.shape",
    ),
    "number as text": (lambda x: {**x, "spread": [["1"] * 6] * 6}, "key spread"),
    "flag as number": (lambda x: {**x, "official": 1}, "key official"),
    "deep nesting": (
        lambda x: {**x, "machine": {"a": [[[[[[[[1]]]]]]]]}}, "key machine",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_malformed_record_is_refused(drafts, name: str) -> None:
    change, message = WRONG[name]
    values = change(json.loads(drafts["pid_best"].content))
    with pytest.raises(InputError, match=message.replace(".", r"\.")):
        record.from_bytes(canonical.canonical(values), "it")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]\n",
        b'{"a": 1}\n',
        b'{"a":1,"a":1}\n',
        b'{"a":NaN}\n',
        b"[" * 100_000,
        b"\xff",
    ],
)
def test_only_canonical_text_is_read(content: bytes) -> None:
    with pytest.raises(InputError):
        record.from_bytes(content, "it")


def test_a_bomb_of_zeros_takes_no_memory() -> None:
    import zlib

    bomb = zlib.compress(bytes(10**8))
    with pytest.raises(InputError, match="does not hold commands of shape"):
        actions.decode(bomb, (6, 21, 6, 3, 34), "it")


def test_a_link_is_no_record(drafts, tmp_path: Path) -> None:
    path = drafts["pid_best"].save(tmp_path)
    link = tmp_path / "link.json"
    link.symlink_to(path)
    with pytest.raises(InputError, match="symbolic link"):
        store.add(tmp_path / "board", link)


def test_add_refuses_what_does_not_fit(leaderboard: Path, draft, drafts, simulators) -> None:
    with pytest.raises(InputError, match="already"):
        put(leaderboard, drafts["softer"], simulators)
    with pytest.raises(InputError, match="is not there"):
        put(leaderboard, draft("new", supersedes="a" * 64), simulators)
    robust = next(x for x in store.load(leaderboard).scores if x.name == "robust")
    with pytest.raises(InputError, match="another entry"):
        put(leaderboard, draft("softer", supersedes=robust.sha256), simulators)
    softer = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    quiet = draft("softer", sandbox=None, supersedes=softer.sha256)
    with pytest.raises(InputError, match="is not official and supersedes"):
        put(leaderboard, quiet, simulators)

    class Other(Textbook):
        def about(self) -> dict[str, Any]:
            return {"version": 2}

    with pytest.raises(InputError, match="other simulators"):
        put(leaderboard, draft("new"), Other())
    assert len(store.load(leaderboard).records) == 8


def test_a_record_that_does_not_replay_is_not_added(leaderboard: Path, drafts, simulators) -> None:
    values = json.loads(drafts["softer"].content)
    values["errors"]["drawn"][0][0][0] -= 1e-6
    forged = create.Draft(canonical.canonical(values), drafts["softer"].commands)
    with pytest.raises(InputError, match=r"does not replay: key errors\.drawn\[0\]\[0\]\[0\] says"):
        put(leaderboard, forged, simulators)


def test_the_newest_official_record_counts(leaderboard: Path, draft, simulators) -> None:
    old = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    new = put(leaderboard, draft("softer", factor=0.96), simulators)
    home = put(leaderboard, draft("softer", factor=0.95, sandbox=None), simulators)
    track = ranking.standings(store.load(leaderboard).records)[1]["performance"]
    entry = next(x for x in track.ranked if x.record.name == "softer")
    assert entry.record.sha256 == new.sha256
    assert [event.record.sha256 for event in entry.history] == [
        home.sha256, new.sha256, old.sha256,
    ]  # fmt: skip
    assert home.sha256 in [x.record.sha256 for x in track.unofficial]


def test_a_withdrawn_record_is_listed_with_its_reason(leaderboard: Path) -> None:
    old = next(x for x in store.load(leaderboard).scores if x.name == "softer")
    store.withdraw(leaderboard, old.sha256[:10], "its <b>authors</b> found a bug")
    track = ranking.standings(store.load(leaderboard).records)[1]["performance"]
    assert "softer" not in [x.record.name for x in track.ranked]
    (entry,) = [x for x in track.unranked if x.record.name == "softer"]
    assert entry.reasons == ("withdrawn: its <b>authors</b> found a bug",)
    with pytest.raises(InputError, match="already"):
        store.withdraw(leaderboard, old.sha256, "again")
    with pytest.raises(InputError, match="no single record"):
        store.withdraw(leaderboard, "f" * 64, "x")
