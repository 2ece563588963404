"""Rounds: who is in is fixed before anybody can know the draws, and no byte changes unseen."""

from __future__ import annotations

import json
import py_compile
import re
import shutil
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

from ci import propose
from ci.git import Git
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.board import canonical, gate, official_runs, replay, rounds, store
from ventbench.board.gate import PRACTICE
from ventbench.board.rounds import Request
from ventbench.board.verify import verify
from ventbench.cli import app
from ventbench.entries import reference as references
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import (
    Submission,
    as_submission,
    combined_hash,
    file_hashes,
    frozen_copy,
    open_submission,
)
from ventbench.entries.scoring import run_protocol
from ventbench.plants import frozen
from ventbench.plants.rigs import load_rigs
from ventbench.task import draws as draw_tables
from ventbench.task import protocol

from . import referee
from .conftest import FROZEN, KEY, OFFICIAL, ROUND, SECRET, attest, entry_folder, put
from .test_verify import flip

SPEED = Path(__file__).parents[2] / "docs" / "speed.md"

#: What names the rigs of rounds that are never scored.
ABOUT = {"version": 2}


def ask(name: str, account: str, minute: int = 0) -> Request:
    return Request(name, account, FROZEN + timedelta(minutes=minute - 60))


@pytest.fixture
def fresh(tmp_path: Path) -> Path:
    """A leaderboard with an open round, and four submissions."""
    for name in ("pid_robust", "one", "two", "three"):
        entry_folder(tmp_path / "submissions" / name, "pid_robust", name)
    board = tmp_path / "leaderboard"
    rounds.open_round(
        board,
        "r2",
        FROZEN,
        ["pid_robust"],
        delay_s=60,
        limit=2,
        chain=referee.chain(SECRET),
        now=FROZEN - timedelta(days=1),
    )
    return board


def freeze(board: Path, *requests: Any, now: datetime = FROZEN) -> rounds.Round:
    return rounds.freeze(board, "r2", board.parent / "submissions", requests, ABOUT, now=now)


def test_the_public_beacon_is_the_default_and_anything_else_a_rehearsal(tmp_path: Path) -> None:
    later = datetime.now(UTC) + timedelta(days=1)
    assert not rounds.open_round(tmp_path, "a", later, ["pid_best"]).opened.rehearsal
    chain = referee.chain(SECRET)
    assert rounds.open_round(tmp_path, "b", later, ["pid_best"], chain=chain).opened.rehearsal
    for name in ("development", "a", "A/b", ".."):
        with pytest.raises(InputError):
            rounds.open_round(tmp_path, name, later, ["pid_best"])


def test_entries_are_limited_by_account_and_not_by_name(fresh: Path) -> None:
    own = freeze(fresh, ask("three", "Eve", 2), ask("one", "eve", 0), ask("two", "EVE", 1))
    assert own.frozen is not None
    assert [(x.name, x.account) for x in own.frozen.entries] == [
        ("pid_robust", ""),
        ("one", "eve"),
        ("two", "eve"),
    ]
    assert own.frozen.left_out == {"three": "account eve has 2 entries already"}
    assert own.state == "frozen"


def test_a_name_stays_with_its_account(fresh: Path) -> None:
    freeze(fresh, ask("one", "eve"))
    rounds.open_round(fresh, "r3", FROZEN, ["pid_robust"], chain=referee.chain(SECRET))
    asked = [ask("one", "mallory"), ask("two", "mallory"), ask("pid_robust", "mallory")]
    own = rounds.freeze(fresh, "r3", fresh.parent / "submissions", asked, ABOUT, now=FROZEN)
    assert own.frozen is not None
    assert {x.name: x.account for x in own.frozen.entries} == {"pid_robust": "", "two": "mallory"}
    assert "another account" in own.frozen.left_out["one"]


@pytest.mark.parametrize("author", ["Ada\\u200b", "\\u3164", "Аda", "A\\u0344\\ufe0fda"])
def test_authors_who_look_like_others_are_left_out(fresh: Path, author: str) -> None:
    path = fresh.parent / "submissions/one/submission.toml"
    text = path.read_text()
    start = text.index("authors = ")
    end = text.index("\n", start)
    path.write_text(f'{text[:start]}authors = ["{author}"]{text[end:]}')
    own = freeze(fresh, ask("one", "eve"), ask("two", "eve"))
    assert own.frozen is not None
    assert [x.name for x in own.frozen.entries] == ["pid_robust", "two"]


def test_nothing_is_frozen_early_or_twice_and_nothing_drawn_early(fresh: Path) -> None:
    with pytest.raises(InputError, match="closes at"):
        freeze(fresh, now=FROZEN - timedelta(seconds=1))
    with pytest.raises(InputError, match="it must be frozen"):
        rounds.draw(fresh, "r2", referee.value(SECRET, 1))
    own = freeze(fresh)
    with pytest.raises(InputError, match="frozen already"):
        freeze(fresh)
    with pytest.raises(InputError, match="has no draws yet"):
        _ = own.seed
    due = FROZEN + timedelta(seconds=60)
    assert own.opened.chain.time_of(own.number) == due
    value = referee.value(SECRET, own.number)
    with pytest.raises(InputError, match="is published at"):
        rounds.draw(fresh, "r2", value, now=due - timedelta(seconds=1))
    # No other value can be chosen: neither the next one, nor one of another key.
    for wrong in (referee.value(SECRET, own.number + 1), referee.value(SECRET + 1, own.number)):
        with pytest.raises(InputError, match=r"key (round|signature)"):
            rounds.draw(fresh, "r2", wrong, now=due)
    assert rounds.draw(fresh, "r2", value, now=due).state == "drawn"


def test_the_seed_is_of_the_entries_and_of_the_beacon(fresh: Path) -> None:
    other = shutil.copytree(fresh.parent, fresh.parent.parent / "other") / "leaderboard"
    (other.parent / "submissions/pid_robust/README.md").write_text("another entry")
    seeds = set()
    for board in (fresh, other):
        own = freeze(board)
        rounds.draw(board, "r2", referee.value(SECRET, own.number))
        seeds.add(rounds.load(board, "r2").seed)
    assert len(seeds) == 2
    assert draw_tables.DEVELOPMENT_SEED not in seeds


@pytest.mark.parametrize("name", ["round.toml", "protocol.json", "frozen.toml", "beacon.json"])
def test_a_changed_byte_of_a_round_is_found(leaderboard: Path, simulators, name: str) -> None:
    path = leaderboard / "rounds" / ROUND / name
    assert verify(leaderboard, lambda: simulators).problems == [], "control"
    flip(path, path.stat().st_size // 2)
    assert verify(leaderboard, lambda: simulators).problems
    flip(path, path.stat().st_size // 2)
    # A byte that changes no value: in a date, a digit; else a space at the end.
    path.write_bytes(path.read_bytes() + b" ")
    assert verify(leaderboard, lambda: simulators).problems


def test_a_changed_entry_or_protocol_is_found(
    full: Path, entered: Path, simulators, tmp_path: Path
) -> None:
    folder = tmp_path / "clone"
    board = shutil.copytree(full, folder / "leaderboard")
    shutil.copytree(entered.parent / "submissions", folder / "submissions")
    assert verify(board, lambda: simulators).problems == []
    flip(folder / "submissions/harder/README.md", 10)
    (problem,) = verify(board, lambda: simulators).problems
    assert "harder is not what was frozen in round r1" in problem
    other = shutil.copytree(folder, tmp_path / "next") / "leaderboard"
    rounds.open_round(other, "r0", FROZEN + timedelta(days=9), ["harder"])
    assert verify(other, lambda: simulators).problems == [], "entries may change for the next one"
    flip(folder / "submissions/harder/README.md", 10)

    class Other(type(simulators)):
        def about(self):
            return {**super().about(), "kind": "other"}

    problems = verify(board, Other).problems
    assert any("this ventbench has another protocol: simulators" in text for text in problems)


def test_what_was_not_frozen_has_no_rank(leaderboard: Path, drafts, simulators) -> None:
    own = leaderboard / "rounds" / ROUND / rounds.FROZEN
    changed = json.loads(drafts["softer"].content)
    changed["submission"]["manifest"]["name"] = "unknown"
    made = type(drafts["softer"])(canonical.canonical(changed), drafts["softer"].commands)
    put(leaderboard, made, simulators)
    board = replay.load(leaderboard)
    record = next(x for x in board.scores if x.name == "unknown")
    assert gate.simulated(record, board) == ("its code was not frozen in round r1",)
    assert own.exists()


def test_practice_is_never_ranked(full: Path) -> None:
    record = next(x for x in replay.load(full).scores if x.name == "softer")
    vouched = store.Store(Path(), (), frozenset([record.sha256]))
    assert gate.simulated(record, vouched) == (PRACTICE,)


def _pid_bounds(own, simulators, pool, folder, **options):
    """Bounds in no time: a tenth of the PID's errors."""
    rigs = simulators.scored()
    plants, cells = rigs.cells(own.draws(rigs), protocol.PIPS)
    gains = np.tile([1.0, 5.0, 0.0], (6, 1))
    pid = references.pid_errors(plants, cells, gains)
    about = references.settings(rigs.about, own.draws(rigs).about())
    zero = np.zeros((*pid.shape, 33))
    return references.Reference(about, gains, 0.1 * pid, 0.1 * pid, 0.0 * pid, pid, zero)


#: Gains of a controller as weights, which a seed may replace.
_WEIGHTS = 'numpy.load(os.path.join(os.path.dirname(__file__), "gains.npy"))'


def test_a_round_is_scored_and_continues(fresh: Path, simulators, monkeypatch) -> None:
    """Two entries, one of which cannot be run; the second time nothing runs again.

    Of the other one's seeds, one is the entry itself, one a PID of half its gains, and one ends.
    """
    monkeypatch.setattr(official_runs, "bounds_of", _pid_bounds)
    attest(fresh)
    baseline = fresh.parent / "submissions/pid_robust"
    code = baseline / "controller.py"
    code.write_text("import os, numpy\n" + code.read_text().replace("(4.0, 8.0, 9.0)", _WEIGHTS))
    np.save(baseline / "gains.npy", [4.0, 8.0, 9.0])
    for seed, gains in (("0", [4.0, 8.0, 9.0]), ("1", [2.0, 8.0, 9.0]), ("2", [1.0])):
        (baseline / "seeds" / seed).mkdir(parents=True)
        np.save(baseline / "seeds" / seed / "gains.npy", gains)
    one = fresh.parent / "submissions/one/controller.py"
    one.write_text("raise ValueError('no')\n" + one.read_text())
    submissions = fresh.parent / "submissions"
    own = rounds.freeze(
        fresh, "r2", submissions, [ask("one", "eve")], simulators.about(), now=FROZEN
    )
    rounds.draw(fresh, "r2", referee.value(SECRET, own.number))
    checkout = shutil.copytree(fresh, fresh.parent / "checkout" / "leaderboard")
    monkeypatch.setattr(official_runs, "DRAWS", 0)  # stress has tests of its own
    ran: list[str] = []
    run = official_runs.run_protocol
    monkeypatch.setattr(
        official_runs,
        "run_protocol",
        lambda entry, *a, **b: ran.append(entry.manifest.name) or run(entry, *a, **b),
    )

    def score():
        with executor() as pool:
            return official_runs.score(
                fresh,
                "r2",
                pool,
                fresh.parent / "work",
                places=[submissions],
                load=lambda: simulators,
                runner=InProcessRunner,
                secret=KEY,
            )

    with monkeypatch.context() as broken:
        broken.setattr(store, "add", lambda *_, **__: 1 / 0)  # as if the machine had gone off
        with pytest.raises(ZeroDivisionError):
            score()
    first, done = list(ran), score()
    assert ran == first, "what was run was kept"
    assert done.state == "scored"
    assert done.result is not None
    assert list(done.result.records) == ["pid_robust (performance)", "pid_robust (robustness)"]
    assert any(key.startswith("one") and "no" in why for key, why in done.result.failed.items())
    with pytest.raises(InputError, match="scored; it is scored once"):
        score()
    report = verify(fresh, lambda: simulators)
    assert report.problems == []
    assert report.replayed == len(done.result.records)
    for record in replay.load(fresh).scores:
        key = f"{record.name} ({record.track})"
        same, other = done.result.seeds[key]
        assert same == pytest.approx(record.figures.ranked_values.mean(), abs=1e-9)
        assert abs(other - same) > 1
        assert len(done.seeds[key]) == 2, "their commands are there"
        assert done.result.failed[f"{key}, seed 2"] == "a cell failed"
    _proposed(fresh.parent / "work", done, checkout, simulators)


def _proposed(work: Path, done: rounds.Round, leaderboard: Path, simulators) -> None:
    """The job that may write takes from each other job what is its own, and commits it."""
    (work / "bounds").mkdir(exist_ok=True)
    shutil.copy(done.folder / rounds.BOUNDS, work / "bounds")

    def added(board: Path, left: Path) -> rounds.Result:
        result = propose.add(left, board, "r2", simulators).result
        assert result is not None
        return result

    forged = shutil.copytree(leaderboard, work.parent / "forged")
    other = shutil.copytree(work, work.parent / "other")
    path = other / "entry-pid_robust/result.json"
    left = json.loads(path.read_bytes())
    for key, sha256 in left["records"].items():
        values = json.loads((path.parent / f"{sha256}.json").read_bytes())
        values["simulators"] = {"manifest_sha256": "9" * 64}
        content = canonical.canonical(values)
        left["records"][key] = canonical.digest(content)
        (path.parent / f"{canonical.digest(content)}.json").write_bytes(content)
    path.write_bytes(canonical.canonical(left))
    shutil.rmtree(other / "entry-one")
    result = added(forged, other)
    assert not store.load(forged).scores
    for key, why in result.failed.items():
        expected = "those of this ventbench are not" if "pid_robust" in key else "No such file"
        assert expected in why
    assert added(leaderboard, work) == done.result
    git = Git(leaderboard.parent)
    git.output("init", "--quiet", "--template=")
    assert propose.commit(leaderboard.parent, "r2", "scored") == "round/r2-scored"
    assert git.text("log", "-1", "--format=%s") == "Round r2 is scored"
    with pytest.raises(InputError, match="no name of a round"):
        propose.commit(leaderboard.parent, "../r2", "scored")


def test_a_job_cannot_leave_the_record_of_another_entry(leaderboard: Path, simulators) -> None:
    """Nor one of other draws, or of other bounds, or one that is no record."""
    folder = leaderboard / "rounds" / ROUND
    result = json.loads((folder / rounds.RESULT).read_bytes())
    (folder / rounds.RESULT).unlink()
    (folder / "result.sig").unlink()
    scored = store.load(leaderboard).scores
    of = {x.name: x.sha256 for x in scored}
    for entry, key, sha256, bounds in (
        ("softer", "softer (performance)", of["harder"], result["bounds"]),
        ("harder", "harder (performance)", of["harder"], "0" * 64),
        ("pid_best", "softer (performance)", of["softer"], result["bounds"]),
        ("robust", "robust (robustness)", of["robust"], result["bounds"]),
    ):
        left = {"bounds": bounds, "records": {key: sha256}, "failed": {}, "seeds": {}}
        path = leaderboard.parent / f"work/entry-{entry}" / rounds.RESULT
        path.parent.mkdir(parents=True)
        path.write_bytes(canonical.canonical(left))
    done = official_runs.close(leaderboard, ROUND, path.parents[1], load=lambda: simulators).result
    assert done is not None
    assert done.records == {"robust (robustness)": of["robust"]}
    assert "is not the record of softer" in done.failed["softer (performance)"]
    assert "is of other draws or bounds" in done.failed["harder (performance)"]
    assert done.failed["pid_best (performance)"] == "its job left no record"
    assert "No such file" in done.failed["new (performance)"]


def _cached(folder: Path) -> Path:
    """Compiled code of another helper, which Python takes without a look at the source."""
    helper, cache = folder / "helper.py", folder / "__pycache__"
    helper.write_text("U_IN = 1.0\n")
    other = folder.parent / "other.py"
    other.write_text("U_IN = 99.0\n")
    compiled = cache / f"helper.{sys.implementation.cache_tag}.pyc"
    unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
    py_compile.compile(str(other), str(compiled), str(helper), invalidation_mode=unchecked)
    return compiled


@pytest.mark.parametrize("kind", ["cache", "link", "compiled"])
def test_what_no_hash_covers_is_not_frozen(fresh: Path, kind: str) -> None:
    entry = fresh.parent / "submissions/one"
    if kind == "cache":
        _cached(entry)
    elif kind == "link":
        (entry / "weights.npz").symlink_to(fresh.parent / "elsewhere.npz")
    else:
        (entry / "helper.pyc").write_bytes(b"\0" * 16)
    own = freeze(fresh, ask("one", "eve"), ask("two", "eve"))
    assert own.frozen is not None
    assert [x.name for x in own.frozen.entries] == ["pid_robust", "two"]
    assert "is in no hash" in own.frozen.left_out["one"]


def test_compiled_code_that_came_after_the_freeze_does_not_run(fresh: Path, tmp_path: Path) -> None:
    entry = fresh.parent / "submissions/one"
    (entry / "helper.py").write_text("U_IN = 1.0\n")
    (entry / "controller.py").write_text(
        "import helper\nclass Controller:\n"
        "    def reset(self, task): pass\n    def act(self, observation): return helper.U_IN\n"
    )
    own = freeze(fresh, ask("one", "eve"))
    assert own.frozen is not None
    sha256 = own.frozen.entries[1].sha256
    _cached(entry)
    assert combined_hash(file_hashes(entry)) == sha256, "control: the hash does not see it"
    rigs = load_rigs("physics")

    def commands(submission: Submission) -> Any:
        return run_protocol(
            submission, protocol_of(rigs, pips=(20.0,)), runner=InProcessRunner()
        ).requested

    assert np.all(commands(open_submission(str(entry))) == 99.0), "control: Python takes it"
    assert np.all(commands(frozen_copy(entry, sha256, tmp_path / "copy")) == 1.0)


def test_a_bad_request_leaves_itself_out(fresh: Path) -> None:
    asked = FROZEN.isoformat()
    given: list[Any] = [
        {"name": "one", "account": "dependabot[bot]", "asked": asked},
        {"name": "O\u202ene/..", "account": "eve", "asked": asked},
        {"name": 3, "asked": asked},
        "nothing",
        {"name": "two", "account": "Eve", "asked": asked},
        {"name": "absent", "account": "eve", "asked": asked},
    ]
    path = fresh.parent / "requests.json"
    path.write_text(json.dumps(given))
    own = freeze(fresh, *rounds.read_requests(path))
    assert own.frozen is not None
    assert [(x.name, x.account) for x in own.frozen.entries] == [("pid_robust", ""), ("two", "eve")]
    left = own.frozen.left_out
    assert left.keys() == {"one", "O\ufffdne/..", "3", "without a name", "absent"}
    assert "there is no folder" in left["absent"]


def test_code_that_changed_after_the_freeze_is_not_scored(fresh: Path, simulators) -> None:
    own = freeze(fresh, ask("one", "eve"))
    rounds.draw(fresh, "r2", referee.value(SECRET, own.number))
    flip(fresh.parent / "submissions/one/controller.py", 5)
    with pytest.raises(InputError, match="the code of one, as it was frozen"):
        official_runs.code_of(rounds.load(fresh, "r2"), [fresh.parent / "submissions"])


@pytest.fixture
def thousand(fresh: Path) -> list[tuple[str, str]]:
    """The plan of a round of 1,000 entries on both tracks."""
    own = freeze(fresh)
    table = msgspec.to_builtins(own.frozen, builtin_types=(datetime,))
    entry = {**table["entries"][0], "account": "eve", "tracks": ["performance", "robustness"]}
    table["entries"] = [{**entry, "name": f"entry_{k}"} for k in range(1000)]
    (own.folder / rounds.FROZEN).write_text(tomli_w.dumps(table))
    own = rounds.load(fresh, "r2")
    rounds.draw(fresh, "r2", referee.value(SECRET, own.number))
    return official_runs.plan(rounds.load(fresh, "r2"))


def test_a_thousand_entries_are_planned(thousand: list[tuple[str, str]], fresh: Path) -> None:
    assert len(thousand) == len(set(thousand)) == 2000
    ended = CliRunner().invoke(
        app, ["round", "score", "r2", "--plan", "--folder", str(fresh), "--json", "-"]
    )
    assert ended.exit_code == 0, ended.output
    table = json.loads(ended.stdout)
    assert [tuple(run) for run in table["runs"]] == thousand
    # 1,000 entries on both tracks, at the cost that docs/speed.md has of 10,000 on each.
    hours = re.search(
        r"10,000 entries take (\d+) core-hours on one track, (\d+)",
        " ".join(SPEED.read_text().split()),
    )
    assert hours is not None
    assert table["processor_s"] / 360 == pytest.approx(sum(map(int, hours.groups())), rel=0.02)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Dask's own, about ports and closing
def test_a_thousand_entries_pass_through_dask(
    thousand: list[tuple[str, str]], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra ventbench[dask] is missing")
    started = distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        dashboard_address=None,
        local_directory=str(tmp_path),
    )
    jobs = {f"{entry}-{track}": (entry, track) for entry, track in thousand}
    with started as cluster, executor(0, cluster.scheduler_address) as pool:
        found = list(results(pool, "{}-{}".format, jobs))
    assert sorted(name for name, _ in found) == sorted(jobs)
    assert all(name == result for name, result in found)


class LookUp:
    """Plays the published optimum of the development cell that looks most like this one."""

    def reset(self, task) -> None:
        rigs = load_rigs()
        lung = [x.id for x in rigs.lungs].index(task.lung)
        _, cells = rigs.cells(rigs.draws(draw_tables.COUNT), protocol.PIPS)
        self.dt, self.target = (np.asarray(x)[lung].ravel() for x in (cells.dt, cells.pip))
        commands = references.published().commands[lung][..., 0, :]
        self.commands = commands.reshape(self.dt.size, -1)

    def act(self, observation) -> float:
        step = round(observation.time / observation.dt)
        if step == 0:
            off = np.abs(self.dt - observation.dt) / 1e-3 + np.abs(self.target - observation.target)
            self.chosen = self.commands[np.argmin(off)]
        return float(self.chosen[min(step, len(self.chosen) - 1)])


def test_a_table_of_public_files_is_worse_than_the_pid_in_a_round(
    entered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And far better than it on the draws that the files are of."""
    monkeypatch.setattr(frozen, "load", OFFICIAL)
    rigs, pips = load_rigs(), (15.0, 30.0)
    seed = rounds.load(entered, ROUND).seed
    means = {}
    for name, drawn in (
        ("development", rigs.draws(2, pips)),
        ("round", rigs.draws(2, pips, seed=seed, name=ROUND)),
    ):
        for entry in (as_submission(LookUp), as_submission("pid_best")):
            result = run_protocol(
                entry,
                protocol_of(rigs, drawn=drawn, pips=pips),
                track="performance",
                runner=InProcessRunner(),
            )
            assert result.failures == ()
            means[name, entry.manifest.name] = result.drawn.mean()
    assert means["development", "lookup"] < means["development", "pid_best"], "control"
    assert means["round", "lookup"] > means["round", "pid_best"]
